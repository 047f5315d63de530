"""`flockd fleet` without any drone, and with drones of which some are lost; it is flown in tests/onboard/daemon."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Self

import pytest

from flockd.cli import main
from flockd.cli.fleet import _found
from flockd.fleet.watcher import FleetWatcher
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.sim.sitl.ports import free_endpoint

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


class _Silence:
    """No drone is heard."""

    def __init__(self, *_: object, **__: object) -> None:
        pass

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def drones(self) -> tuple[str, ...]:
        return ()


@pytest.mark.parametrize(
    ("drones", "told"),
    [("all", "no drone was"), ("drone1", "drone1 was not"), ("drone1,drone2", "drone1 and drone2 were not")],
)
def test_a_drone_that_is_not_heard_gets_no_request(
    drones: str, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("flockd.fleet.watcher.FleetWatcher", _Silence)
    monkeypatch.setattr("flockd.cli.fleet.FIND_S", 0.0)
    assert main(["fleet", "hold", drones, "--connect", "tcp/127.0.0.1:1"]) == 69
    sentence = f"{told} found at tcp/127.0.0.1:1; no request was sent; check `flockd status`\n"
    assert capsys.readouterr().err == sentence


def _drone(name: str, endpoint: str, *, lost: bool) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", DRONE, name, endpoint, "lost" if lost else "well"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "up\n"
    return process


@pytest.mark.parametrize("wanted", ["all", "drone1,drone2,drone3,drone4"])
def test_a_hold_reaches_each_whatever_the_others_do(wanted: str) -> None:
    """drone1 and drone2 are lost; drone4 was never there."""
    drones = {f"drone{number}": free_endpoint() for number in (1, 2, 3)}
    processes = [_drone(name, at, lost=name != "drone3") for name, at in drones.items()]
    places = [word for at in drones.values() for word in ("--connect", at)]
    try:
        hold = subprocess.run(
            [sys.executable, "-u", "-c", HOLD, "fleet", "hold", wanted, *places],
            cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False, timeout=60.0,
        )  # fmt: skip
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    first, *rest = hold.stdout.splitlines()
    assert first == "meadow/drone3: it is tried", "before it is known that others do not answer"
    assert sorted(rest[:2]) == [
        f"meadow/{name}: did not answer; this computer may not command it" for name in ("drone1", "drone2")
    ]
    assert [line.partition(" at ")[0] for line in rest[2:]] == ["drone4 was not found"] * (wanted != "all")
    assert hold.returncode == 1


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
