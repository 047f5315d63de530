"""Simulations that others watch: each publishes where it is told to, and flies what it is ordered."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockd.cli import main
from flockd.core.config import DroneConfig
from flockd.core.errors import UnavailableError
from flockd.fleet.watcher import FleetWatcher
from flockd.review.flight_log.log import FlightLog
from flockd.sim.sitl.ports import free_endpoint

ROOT = Path(__file__).parents[2]
RUN = "from flockd.cli import program; program()"


def test_the_daemons_of_a_simulation_connect_where_they_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connected: list[tuple[str, ...]] = []

    def fly_fleet(scenario: object, sitl: DroneConfig, **_: object) -> None:
        connected.append(sitl.telemetry.connect)
        raise UnavailableError("no autopilot for this test; end here")

    monkeypatch.setattr("flockd.sim.sitl.fleet.fly_fleet", fly_fleet)
    flight = ["sim", "--autopilot", "fake", "--drones", "2", "--out"]
    assert main([*flight, str(tmp_path / "one")]) == 69
    assert main([*flight, str(tmp_path / "two"), "--telemetry-at", "tcp/127.0.0.1:7999"]) == 69
    assert connected == [("tcp/127.0.0.1:7447",), ("tcp/127.0.0.1:7999",)]


GOAL_NE = (-4.5, -4.0)
"""Behind two drones that set out to the north on a circle to the right."""
SECONDS_TO_FAIL = 240.0


@pytest.mark.slow
@pytest.mark.whole_flight
def test_an_order_is_flown_by_sight(tmp_path: Path) -> None:
    """The command as a process: drones that see take an order over telemetry and fly there; Ctrl-C ends it in order."""
    endpoint, out = free_endpoint(), tmp_path / "out"
    options = ["--duration", "60", "--drones", "2", "--out", str(out), "--telemetry-at", endpoint]
    options += ["--set", "drone.perception.flow=dis"]
    command = [sys.executable, "-c", RUN, "sim", "--telemetry", *options]
    drones = ("paper_flight/drone1", "paper_flight/drone2")
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as flight:
        try:
            with FleetWatcher(None, listen=[], connect=[endpoint]) as watcher:

                def arrived(drone: str) -> bool:
                    return bool(_newest(watcher, drone, "mission").get("arrived"))

                _until(lambda: all(_newest(watcher, drone, "command") for drone in drones), flight)
                assert not any(arrived(drone) for drone in drones), "nobody has sent them anywhere"
                north, east = (str(metres) for metres in GOAL_NE)
                order = ["fleet", "goto", "drone1,drone2", north, east, "--speed", "1.5", "--connect", endpoint]
                assert main(order) == 0
                _until(lambda: _newest(watcher, drones[0], "mission").get("goal_ne") == list(GOAL_NE), flight)
                assert watcher.queries.image(drones[1], "front"), "pictures of what they fly by"
                _until(lambda: all(arrived(drone) for drone in drones), flight)
            flight.send_signal(signal.SIGINT)
            told = flight.communicate(timeout=SECONDS_TO_FAIL)[1]
        finally:
            flight.kill()
    assert flight.returncode == 130, told
    assert "interrupted after" in told
    flown = FlightLog.load(out / "flight.npz")
    assert flown.metadata.perception == "learned"
    middle = flown.position[:, :, :2].mean(axis=1)
    to_goal_m = np.linalg.norm(middle - GOAL_NE, axis=1)
    assert to_goal_m[0] > 5.0
    assert to_goal_m[-1] < 1.5, "`reached_m`, and what the flock's middle as they see it may be off"


def _newest(watcher: FleetWatcher, drone: str, topic: str) -> Mapping[str, Any]:
    found = {f"{one.fleet}/{one.drone}": one.topics.get(topic) for one in watcher.drones()}.get(drone)
    return {} if found is None else found.message


def _until(true: Callable[[], bool], flight: subprocess.Popen[str]) -> None:
    """Waits for it while the flight goes on."""
    end_s = time.monotonic() + SECONDS_TO_FAIL
    while not true():
        assert flight.poll() is None, flight.communicate()[1]
        assert time.monotonic() < end_s
        time.sleep(0.05)
