"""Two simulations on one computer: each publishes where it is told to."""

from __future__ import annotations

from pathlib import Path

import pytest

from flockd.cli import main
from flockd.core.config import DroneConfig
from flockd.core.errors import UnavailableError


def test_the_daemons_of_a_simulation_connect_where_they_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    connected: list[tuple[str, ...]] = []

    def fly_fleet(scenario: object, sitl: DroneConfig, **_: object) -> None:
        connected.append(sitl.telemetry.connect)
        raise UnavailableError("no autopilot for this test; end here")

    monkeypatch.setattr("flockd.sim.fleet.fly_fleet", fly_fleet)
    flight = ["sim", "--autopilot", "standin", "--drones", "2", "--out"]
    assert main([*flight, str(tmp_path / "one")]) == 69
    assert main([*flight, str(tmp_path / "two"), "--telemetry-at", "tcp/127.0.0.1:7999"]) == 69
    assert connected == [("tcp/127.0.0.1:7447",), ("tcp/127.0.0.1:7999",)]
    capsys.readouterr()
    assert main(["sim", "--telemetry-at", "tcp/127.0.0.1:7999", "--out", str(tmp_path / "three")]) == 2
    assert "--telemetry-at is for --telemetry and for --autopilot" in capsys.readouterr().err
