"""The fleet page in a real Chromium, with drones that are processes of their own: run with `make browser`.

The times that it takes are printed, not checked: the computer may be busy.
"""

from __future__ import annotations

import os
import re
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from signal import SIGINT
from subprocess import PIPE, Popen
from typing import NamedTuple

import pytest
from playwright.sync_api import Page, expect

from flockd.sim.sitl.processes import free_endpoint, free_port
from tests.fleet.page.chromium import (
    NARROW,
    PATIENCE_MS,
    WIDE,
    chromium,
    hold_s,
    made_up_drones,
    served_page,
)

pytestmark = [pytest.mark.browser, pytest.mark.slow]
expect.set_options(timeout=PATIENCE_MS)


class Flock(NamedTuple):
    """Five drones: three that take commands, one that takes none, one that will be killed."""

    page: Page
    address: str
    doomed: Popen[bytes]
    errors: list[str]
    requests: list[str]


@pytest.fixture(scope="module")
def flock() -> Iterator[Flock]:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        address, _ = stack.enter_context(served_page(endpoint))
        of_five = ("--flock", "5", "--drones")
        stack.enter_context(made_up_drones(endpoint, *of_five, "3", "--commands", "hold,resume"))
        stack.enter_context(made_up_drones(endpoint, *of_five, "1", "--first", "4"))
        doomed = stack.enter_context(made_up_drones(endpoint, *of_five, "1", "--first", "5", "--commands", "hold"))
        page = stack.enter_context(chromium()).new_context().new_page()
        page.set_default_timeout(PATIENCE_MS)
        errors: list[str] = []
        requests: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.on("request", lambda request: requests.append(request.url))
        page.goto(address)
        expect(page.locator("article")).to_have_count(5)
        yield Flock(page, address, doomed, errors, requests)


def card(page: Page, drone: str) -> str:
    """The card of one drone."""
    return f"article[data-key='made-up/{drone}']"


def told(what: str, began_s: float) -> None:
    took_s, load = time.monotonic() - began_s, os.getloadavg()[0]
    sys.stdout.write(f"{what}: {took_s:.2f} s (load average {load:.1f} on {os.cpu_count()} cores)\n")


def test_five_drones_appear(flock: Flock) -> None:
    began_s = time.monotonic()
    flock.page.goto(flock.address)
    expect(flock.page.locator("article[data-tone=good], article[data-tone=fair]")).to_have_count(5)
    told("from opening the page until five drones fly on it", began_s)
    expect(flock.page.locator("#summary")).to_have_text("5 drones: 1 degraded, 4 normal")
    expect(flock.page.locator(card(flock.page, "drone3"))).to_contain_text("camera back delivers no frames")
    expect(flock.page.locator(".plot .js-line")).to_have_count(5)
    marked = "c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some(value => value > 0)"
    assert flock.page.locator("#map canvas").evaluate(marked)
    expect(flock.page).to_have_title("made-up - flockd")


def test_a_hold_is_confirmed_by_the_drone_and_resumed(flock: Flock) -> None:
    page, of = flock.page, card(flock.page, "drone2")
    page.locator(f"{of} [data-command=hold]").click()
    expect(page.locator("#confirm h2")).to_have_text("Hold drone2?")
    page.locator("#confirm [value=cancel]").click()
    expect(page.locator("#confirm")).to_be_hidden()
    expect(page.locator(f"{of} .state")).to_have_text("normal")
    page.locator(f"{of} [data-command=hold]").click()
    began_s = time.monotonic()
    page.locator("#confirm .send").click()
    expect(page.locator("#answers p")).to_have_text("drone2: hold is being tried; the drone's state shows the result")
    told("from the confirmed hold to the drone's answer", began_s)
    expect(page.locator(f"{of} .state")).to_have_text("asking")
    expect(page.locator(of)).to_contain_text("an operator asked for Hold")
    told("and until its card shows it", began_s)
    expect(page.locator("#events")).to_contain_text("an operator asked for hold")
    for _ in range(2):
        page.locator(f"{of} [data-command=hold]").click()
        page.locator("#confirm .send").click()
    expect(page.locator("#events")).to_contain_text(re.compile(r"operator asked for hold: .*, order \d+ \(2 times\)"))
    expect(page.locator(f"{of} .orders")).to_contain_text(re.compile(r"last order: hold, by \S+@\S+, page \w+"))
    page.locator(f"{of} [data-command=resume]").click()
    page.locator("#confirm .send").click()
    expect(page.locator(f"{of} .state")).to_have_text("normal")


def test_a_drone_that_allows_no_command_refuses(flock: Flock) -> None:
    page, of = flock.page, card(flock.page, "drone4")
    expect(page.locator(of)).to_contain_text("takes no commands: its telemetry.commands allows none")
    for button in page.locator(f"{of} [data-command]").all():
        expect(button).to_be_disabled()
    answer = page.evaluate("""async () => (await fetch("ask", {method: "POST",
        headers: {"X-Flockd-Token": document.querySelector("meta[name=token]").content},
        body: JSON.stringify({drones: ["made-up/drone4"], command: "hold"})})).json()""")
    refusal = {"accepted": False, "sentence": "'hold' is not allowed here; telemetry.commands allows none"}
    assert answer == {"made-up/drone4": refusal}


def opened_beside(flock: Flock) -> Page:
    """A page of a browser of its own."""
    browser = flock.page.context.browser
    assert browser is not None
    return browser.new_context().new_page()


def test_an_open_page_goes_on_when_the_server_is_started_again(flock: Flock, tmp_path: Path) -> None:
    """With a key that lasts by itself; with another key it says what to do."""
    endpoint, key_file, port = free_endpoint(), tmp_path / "key", str(free_port(socket.SOCK_STREAM))
    lasting = ("--port", port, "--key-file", str(key_file))
    page = opened_beside(flock)
    trouble = page.locator("#trouble")
    with made_up_drones(endpoint, "--drones", "2", "--commands", "hold"):
        with served_page(endpoint, *lasting) as (address, _):
            page.goto(address)
            expect(page.locator("article")).to_have_count(2)
        expect(trouble).to_contain_text("The server cannot be reached, and is asked again every second")
        with served_page(endpoint, *lasting) as (again, _):
            assert again == address
            expect(trouble).to_be_hidden()
            expect(page.locator(f"{card(page, 'drone1')} [data-command=hold]")).to_be_enabled()
            hold_s(page)
        with served_page(endpoint, "--port", port) as (other, _):
            assert other != address
            expect(trouble).to_contain_text("open the address that it printed. Started with --key-file")
        expect(trouble).to_contain_text("The server cannot be reached")
        with served_page(endpoint, *lasting):
            expect(trouble).to_be_hidden()


def test_on_a_phone_nothing_is_wider_than_the_screen(flock: Flock) -> None:
    flock.page.set_viewport_size(NARROW)
    assert flock.page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"]
    expect(flock.page.locator("#map canvas")).to_be_visible()


def test_a_killed_drone_is_shown_with_the_reason(flock: Flock) -> None:
    of = card(flock.page, "drone5")
    began_s = time.monotonic()
    flock.doomed.kill()
    expect(flock.page.locator(f"{of} .state")).to_have_text("gone")
    told("from the kill until the drone is shown as gone", began_s)
    expect(flock.page.locator(f"{of} .why")).to_contain_text("its process has ended or cannot be reached")
    expect(flock.page.locator("#summary")).to_contain_text("1 gone")


@contextmanager
def flown_live(flock: Flock, *options: str) -> Iterator[tuple[Page, float]]:
    """`flockd sim --live` on a page of its own, and when the command was given. No script on the page may fail."""
    run = [sys.executable, "-c", "from flockd.cli import program; program()", "sim", "--live", "--port", "0"]
    began_s = time.monotonic()
    with Popen([*run, "--telemetry-at", free_endpoint(), *options], stdout=PIPE, text=True) as flight:
        try:
            assert flight.stdout is not None
            address = re.search(r"http://\S+", flight.stdout.readline())
            assert address is not None
            page = opened_beside(flock)
            page.set_viewport_size(WIDE)
            page.set_default_timeout(PATIENCE_MS)
            errors: list[str] = []
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.goto(address[0])
            yield page, began_s
            page.set_viewport_size(NARROW)
            assert page.evaluate("document.documentElement.scrollWidth") <= NARROW["width"]
            assert errors == []
            page.close()
        finally:
            flight.send_signal(SIGINT)
            assert flight.wait(PATIENCE_MS / 1000) == 0


def test_a_simulated_flock_is_flown_and_disturbed_by_hand(flock: Flock) -> None:
    """On exact states: a goal by a click on the map, and every control of the simulation."""
    with flown_live(flock, "--perception", "truth", "--drones", "3") as (page, began_s):
        expect(page.locator("article[data-tone=good]")).to_have_count(3)
        expect(page.locator("#simulation output")).to_contain_text("× real time")
        told("from the command until the flock moves on the page", began_s)
        fly_by_hand(page)


def test_by_sight_the_page_shows_what_a_drone_sees_beside_the_map(flock: Flock) -> None:
    """Large, of the drone that is chosen, with a camera that is switched off."""
    with flown_live(flock, "--drones", "2") as (page, began_s):
        output, sight = page.locator("#simulation output"), page.locator("#sight")
        expect(output).to_contain_text("loads networks and builds the world")
        expect(output).to_contain_text("× real time")
        told("from the command until the flock flies by sight on the page", began_s)
        expect(sight.locator("[aria-pressed=true]")).to_have_text("drone1")
        expect(sight.locator("figure[data-came]")).to_have_count(4)
        sizes = sight.locator("img").evaluate_all("all => all.map(one => [one.naturalWidth, one.naturalHeight])")
        assert sizes == [[240, 320]] * 4, "480 x 640 pixels, the longer side 320"
        sight.get_by_text("drone2").click()
        expect(page.locator("article.chosen")).to_contain_text("drone2")
        sight.locator("figure[data-camera=left] button").click()
        expect(sight.locator("figure.off")).to_contain_text("no newer one has come")
        map_box, sight_box = page.locator("#map").bounding_box(), sight.bounding_box()
        assert map_box is not None
        assert sight_box is not None
        assert (map_box["y"], map_box["height"]) == (sight_box["y"], sight_box["height"]), "beside each other"


def fly_by_hand(page: Page) -> None:
    """What a person does with the controls, one after the other."""
    simulation, answers = page.locator("#simulation"), page.locator("#answers")
    page.locator("#curves select").select_option("battery")
    expect(page.locator("#curves")).to_contain_text("No drone has sent this yet.")
    page.locator("#map [name=goal]").check()
    page.locator("#map canvas").click(position={"x": 60, "y": 60})
    expect(page.locator("#confirm h2")).to_have_text("Send 3 drones to a place?")
    expect(page.locator("#confirm [name=north]")).not_to_have_value("")
    page.locator("#confirm .send").click()
    expect(answers).to_contain_text("goto is being tried")
    expect(page.locator("article .meaning").first).to_contain_text("mission: ")
    expect(page.locator("article .meaning").first).not_to_contain_text("on the circle")
    page.locator("header [data-command=velocity]").click()
    page.locator("#confirm [name=v_north]").fill("0.5")
    page.locator("#confirm [name=v_east]").fill("0")
    page.locator("#confirm .send").click()
    expect(answers).to_contain_text("velocity is being tried")
    expect(page.locator("article .meaning").first).to_contain_text("flies an operator's velocity")
    of = "article[data-key$=drone3]"
    page.locator(f"{of} .look").click()
    page.locator(f"{of} figure button").first.click()
    expect(answers).to_contain_text("delivers no images any more")
    expect(page.locator(of)).to_contain_text("a camera is lost: front unplugged")
    expect(page.locator(f"{of} figure button").first).to_have_text("Switch on")
    simulation.locator("[name=gusts]").fill("0.3")
    expect(answers).to_contain_text("gusts of 0.3 m/s")
    simulation.locator("[name=speed]").select_option("5")
    expect(answers).to_contain_text("5 times as fast")
    page.locator(f"{of} .remove").click()
    expect(page.locator(of)).to_contain_text("was taken out of the simulation")
    simulation.locator("[name=pause]").click()
    expect(simulation.locator("output")).to_contain_text("stands still")
    expect(page.locator("#summary")).to_contain_text("1 gone")
    simulation.locator("[name=pause]").click()
    expect(simulation.locator("output")).to_contain_text("× real time")
    simulation.locator("[name=restart]").click()
    expect(answers).to_contain_text("the flight begins again")
    expect(page.locator(f"{of} .state")).to_have_text("normal")
    expect(page.locator("#summary")).to_have_text("3 drones: 3 normal")
    expect(page.locator("article .meaning").first).to_contain_text("on the circle")


def test_nothing_was_loaded_from_elsewhere_and_nothing_failed(flock: Flock) -> None:
    own = flock.address.split("?")[0]
    assert [url for url in flock.requests if not url.startswith((own, "blob:", "data:"))] == []
    assert flock.errors == []
