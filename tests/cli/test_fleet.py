"""`flockd fleet`: requests to drones of which some are lost, and the page's address; flown in tests/onboard/daemon."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import Mock

import pytest

from flockd.cli import main
from flockd.cli.fleet import _found, announce
from flockd.fleet.watcher import FleetWatcher
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.sim.sitl.processes import free_endpoint
from tests.conftest import Told

ROOT = Path(__file__).parents[2]
DRONE = """
import sys, threading, time
from flockd.onboard.telemetry.publisher import ZenohTelemetry

name, endpoint, lost = sys.argv[1:]
with ZenohTelemetry("meadow", listen=[endpoint]) as telemetry:
    if lost == "lost":
        telemetry._tell_time = lambda query: threading.Event().wait()
    answer = {"accepted": True, "sentence": "it is tried"}
    telemetry.announce(name, {}, lambda command, payload: answer, lambda camera: None)
    print("up", flush=True)
    time.sleep(600.0)
"""
"""A lost one says that it is alive, and answers nothing more: as one out of reach does until zenoh notices."""
HOLD = "from flockd.cli import program; program()"


@pytest.mark.parametrize(
    ("drones", "says"),
    [("all", "no drone was"), ("drone1", "drone1 was not"), ("drone1,drone2", "drone1 and drone2 were not")],
)
def test_a_drone_that_is_not_heard_gets_no_request(
    drones: str, says: str, monkeypatch: pytest.MonkeyPatch, told: Told
) -> None:
    monkeypatch.setattr("flockd.fleet.watcher.FleetWatcher", lambda *_, **__: nullcontext(Mock(drones=tuple)))
    monkeypatch.setattr("flockd.cli.fleet.FIND_S", 0.0)
    error = told(69, "fleet", "hold", drones, "--connect", "tcp/127.0.0.1:1")
    assert error.startswith(f"{says} found at tcp/127.0.0.1:1; no request was sent; ")


def _drone(name: str, endpoint: str, *, lost: bool) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", DRONE, name, endpoint, "lost" if lost else "well"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    return process


def test_a_hold_reaches_each_whatever_the_others_do() -> None:
    """drone1 and drone2 are lost; drone4 was never there."""
    drones = {f"drone{number}": free_endpoint() for number in (1, 2, 3)}
    processes = [_drone(name, at, lost=name != "drone3") for name, at in drones.items()]
    places = [word for at in drones.values() for word in ("--connect", at)]
    try:
        hold = subprocess.run(
            [sys.executable, "-u", "-c", HOLD, "fleet", "hold", "drone1,drone2,drone3,drone4", *places],
            cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False, timeout=60.0,
        )  # fmt: skip
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    first, *rest = hold.stdout.splitlines()
    assert first.startswith("meadow/drone3: "), "before it is known that others do not answer"
    assert sorted(rest[:2]) == [
        f"meadow/{name}: did not answer; this computer may not command it" for name in ("drone1", "drone2")
    ]
    assert [line.partition(" at ")[0] for line in rest[2:]] == ["drone4 was not found"]
    assert hold.returncode == 1


def test_an_order_that_is_repeated_says_that_the_flight_has_ended(capsys: pytest.CaptureFixture[str]) -> None:
    endpoint = free_endpoint()
    drone = _drone("drone1", endpoint, lost=False)
    told = capsys.readouterr

    def ended() -> None:
        while "it is tried" not in told().out:
            time.sleep(0.05)
        drone.kill()
        drone.communicate()

    with ThreadPoolExecutor() as threads:
        threads.submit(ended)
        assert main(["fleet", "velocity", "all", "0.5", "0", "--seconds", "6", "--connect", endpoint]) == 1
    assert told().err.splitlines() == ["meadow/drone1: has ended, or cannot be reached any more; see `flockd status`"]


def test_a_drone_is_asked_when_it_is_found_and_not_after_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flockd.cli.fleet.FIND_S", 600.0)
    endpoint = free_endpoint()
    with ZenohTelemetry("meadow", listen=[endpoint]) as telemetry:
        telemetry.show_alive("drone1")
        with FleetWatcher(None, listen=[], connect=[endpoint]) as watcher:
            found = _found(watcher, [])
            assert next(found) == "meadow/drone1"
            telemetry.show_alive("drone2")
            assert next(found) == "meadow/drone2"


def test_a_taken_port_is_reported_in_one_sentence(told: Told) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        error = told(69, "fleet", "--connect", "tcp/127.0.0.1:1", "--port", port)
    assert error.startswith(f"the page cannot use 127.0.0.1 port {port} (")


@pytest.mark.parametrize(
    ("address", "shown", "warns"),
    [
        ("127.0.0.1", "127.0.0.1", False),
        ("::1", "[::1]", False),
        ("0.0.0.0", "127.0.0.1", True),
        ("10.0.0.7", "10.0.0.7", True),
    ],
)
def test_an_address_that_others_reach_comes_with_a_warning(
    address: str, shown: str, warns: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    args = Namespace(server_address=address, connect=["tcp/127.0.0.1:1"], drones_at=None)
    announce(args, "k", 80)
    out, err = capsys.readouterr()
    assert f"http://{shown}:80/?key=k" in out.splitlines()[0]
    assert ("travels unencrypted" in err) == ("on other computers" in out) == warns
