"""How smooth the fleet page stays: publishes a made-up fleet's messages, and prints a headless Chromium's frame times.

python -m tools.measure.bench_fleet_page --drones 50 --seconds 20
python -m tools.measure.bench_fleet_page --drones 5 --pictures out/pages    # and pictures of the page
python -m tools.measure.bench_fleet_page --stuck 24    # how long a hold takes beside pictures that nobody answers

Chromium is /usr/bin/chromium, or what CHROMIUM names.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from playwright.sync_api import Browser, Page, ViewportSize, expect, sync_playwright

from flockd.sim.free_ports import free_endpoint

_RUN = "from flockd.cli import program; program()"
_ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking")
SAMPLER = """seconds => new Promise(done => {
  const [times, began] = [[], performance.now()];
  let before = began;
  const tick = now => {
    times.push(now - before);
    before = now;
    if (now - began < 1000 * seconds) requestAnimationFrame(tick);
    else done(times.slice(1));
  };
  requestAnimationFrame(tick);
})"""
HOLD = """async card => {
  document.querySelector(`${card} [data-command=hold]`).click();
  const answered = new Promise(done => {
    const observer = new MutationObserver(() => {
      if (!document.querySelector("#answers p")) return;
      observer.disconnect();
      done();
    });
    document.querySelectorAll("#answers p").forEach(one => one.remove());
    observer.observe(document.getElementById("answers"), { childList: true });
  });
  const began = performance.now();
  document.querySelector("#confirm .send").click();
  await answered;
  if (!document.querySelector("#answers p").textContent.includes("hold is being tried")) throw new Error("refused");
  return performance.now() - began;
}"""
PATIENCE_MS = 120_000
BROWSERS, CAMERAS = 4, 12
HELD = "article[data-key='made-up/drone1']"
"""The card of the drone that answers."""
WIDE = ViewportSize(width=1440, height=900)
NARROW = ViewportSize(width=390, height=844)


def main() -> int:
    """Measures, and prints."""
    parser = argparse.ArgumentParser(description="Frame times of the fleet page.")
    parser.add_argument("--drones", type=int, default=50)
    parser.add_argument("--rate", type=float, default=2.0, help="messages a second of each topic and drone")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--stuck", type=int, metavar="N", help="time a hold beside N stuck pictures and four browsers")
    parser.add_argument("--pictures", type=Path, help="a folder for pictures of the page")
    args = parser.parse_args()
    if args.stuck is not None:
        return _time_holds(args.stuck)
    endpoint = free_endpoint()
    options = ("--drones", str(args.drones), "--rate", str(args.rate), "--commands", "hold,land,resume,goto")
    with served_page(endpoint) as (address, server), made_up_drones(endpoint, *options), chromium() as browser:
        page = browser.new_page(viewport=WIDE)
        page.goto(address)
        expect(page.locator("article")).to_have_count(args.drones, timeout=PATIENCE_MS)
        expect(page.locator(".plot .js-line").first).to_be_attached(timeout=PATIENCE_MS)
        _wait_for_rate(page, args.rate)
        busy_s, began_s = _processor_s(server), time.monotonic()
        frames_ms = np.array(page.evaluate(SAMPLER, args.seconds))
        share = (_processor_s(server) - busy_s) / (time.monotonic() - began_s)
        idle_ms = np.array(browser.new_page(viewport=WIDE).evaluate(SAMPLER, 5))
        heard_hz = _heard_hz(page)
        for what, times in (
            (f"{args.drones} drones at {heard_hz:.2f} Hz", frames_ms),
            ("an empty page beside it", idle_ms),
        ):
            print(
                f"{what}: {len(times)} frames, median {np.median(times):.1f} ms, 95th percentile "
                f"{np.percentile(times, 95):.1f} ms, longest {times.max():.0f} ms"
            )
        print(f"the server kept {share:.0%} of a processor core busy; load average {os.getloadavg()[0]:.1f}")
        if args.pictures is not None:
            _take_pictures(page, browser, args.pictures)
    return 0


def _time_holds(stuck: int) -> int:
    """A hold on each of four pages, all of which show the cameras of drones that answer nothing; prints seconds."""
    endpoint = free_endpoint()
    silent = -(-stuck // CAMERAS)
    flock = ("--flock", f"{1 + silent}", "--drones")
    with (
        served_page(endpoint) as (address, _),
        made_up_drones(endpoint, *flock, "1", "--commands", "hold,resume"),
        made_up_drones(endpoint, *flock, f"{silent}", "--first", "2", "--mute", f"{CAMERAS}"),
        chromium() as browser,
    ):
        pages = [browser.new_context().new_page() for _ in range(BROWSERS)]
        for page in pages:
            open_page(page, address, 1 + silent)
        free = [hold_s(page) for page in pages]
        for page in pages:
            look_at_silent(page, silent)
        beside = [hold_s(page) for page in pages]
    for what, seconds in (("no pictures", free), (f"{silent * CAMERAS} stuck pictures", beside)):
        each = ", ".join(f"{one:.2f}" for one in seconds)
        print(f"from the confirmed hold to the answer beside {what}, on {BROWSERS} pages: {each} s")
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    return 0


def open_page(page: Page, address: str, drones: int) -> None:
    """Until the first drone may be commanded."""
    page.set_default_timeout(PATIENCE_MS)
    page.goto(address)
    expect(page.locator("article")).to_have_count(drones, timeout=PATIENCE_MS)
    expect(page.locator(f"{HELD} [data-command=hold]")).to_be_enabled(timeout=PATIENCE_MS)
    expect(page.locator(".plot .js-line").first).to_be_attached(timeout=PATIENCE_MS)  # the last that it loads


def look_at_silent(page: Page, silent: int) -> None:
    """Shows the cameras of all drones that answer nothing, until it is told so."""
    for number in range(silent):
        page.locator(f"article[data-key='made-up/drone{2 + number}'] .look").dispatch_event("click")
    none = page.locator(".pictures figcaption", has_text="no picture")
    expect(none.first).to_be_visible(timeout=PATIENCE_MS)


def hold_s(page: Page) -> float:
    """From the confirmed hold to the drone's answer on the page, by the browser's clock."""
    return float(page.evaluate(HOLD, HELD)) / 1000


@contextmanager
def served_page(endpoint: str, *options: str) -> Iterator[tuple[str, int]]:
    """`flockd fleet` to which drones connect at ``endpoint``: its address, with the key, and its process."""
    command = [sys.executable, "-c", _RUN, "fleet", "--port", "0", "--drones-at", endpoint, *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = re.search(r"http://\S+", server.stdout.readline())
            if address is None:
                raise SystemExit("flockd fleet printed no address")
            yield address[0], server.pid
        finally:
            server.kill()


@contextmanager
def made_up_drones(endpoint: str, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """`tools.docs.made_up_fleet`, which connects to ``endpoint``."""
    command = [sys.executable, "-m", "tools.docs.made_up_fleet", "--connect", endpoint, *options]
    with subprocess.Popen(command, cwd=Path(__file__).parents[2]) as drones:
        try:
            yield drones
        finally:
            drones.kill()


@contextmanager
def chromium() -> Iterator[Browser]:
    """The system's, without a window."""
    with sync_playwright() as playwright:
        path = os.environ.get("CHROMIUM", "/usr/bin/chromium")
        yield playwright.chromium.launch(executable_path=path, args=[*_ARGUMENTS])


def _heard_hz(page: Page) -> float:
    """Steps a second, the mean of all cards."""
    texts = page.locator("article dd:has-text('/s'):not(:has-text('m/s'))").all_text_contents()
    return float(np.mean([float(text.split()[0]) for text in texts])) if texts else 0.0


def _wait_for_rate(page: Page, wanted_hz: float) -> None:
    """Until the drones publish as fast as they should, or a minute is over: loading the page takes processor time."""
    until_s = time.monotonic() + 60.0
    while _heard_hz(page) < 0.95 * wanted_hz and time.monotonic() < until_s:
        time.sleep(1.0)


def _processor_s(process: int) -> float:
    """That a process has used."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _take_pictures(page: Page, browser: Browser, folder: Path) -> None:
    """Wide and narrow, light and dark."""
    folder.mkdir(parents=True, exist_ok=True)
    page.locator("article .name").nth(1).click()
    page.locator("article .look:enabled").first.click()
    expect(page.locator(".pictures img").first).to_have_js_property("naturalWidth", 320, timeout=PATIENCE_MS)
    page.screenshot(path=folder / "wide.png")
    page.emulate_media(color_scheme="dark")
    page.screenshot(path=folder / "wide-dark.png")
    page.emulate_media(color_scheme="light")
    page.set_viewport_size(NARROW)
    page.screenshot(path=folder / "narrow.png")
    page.screenshot(path=folder / "narrow-whole.png", full_page=True)
    page.locator("#all [data-command=hold]").click()
    page.screenshot(path=folder / "confirm.png")


if __name__ == "__main__":
    raise SystemExit(main())
