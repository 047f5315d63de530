"""The card of a flight day says what the drone's own configuration says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from flockd.cli import main
from flockd.core.data import data_path
from flockd.flight.safety import Event

QUADROTOR = data_path("config") / "quadrotor.yaml"
Capture = pytest.CaptureFixture[str]


def rows(capsys: Capture, file: Path) -> dict[str, str]:
    """The second cell of each row, by the first."""
    assert main(["config", "card", str(file)]) == 0
    lines = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    return {line[0]: line[1] for line in lines if len(line) > 1}


def test_limits_heights_and_people_are_those_of_the_file(capsys: Capture, tmp_path: Path) -> None:
    card = rows(capsys, QUADROTOR)
    assert card["first flight"] == "yes: layer 1"
    assert card["speed wanted; let through"] == "1; 4 m/s"
    assert card["height above home"] == "1.5 to 10 m"
    assert card["it flies at"].startswith("3 m ")
    assert card["fence"] == "50 m around home"
    assert "nothing" in card["over telemetry"]
    text = QUADROTOR.read_text(encoding="utf-8").replace("fence_radius_m: 50.0", "fence_radius_m: 20.0")
    text = text.replace("first_flight_layer: 1", "first_flight_layer: 2").replace(
        "commands: []", "commands: [hold, land]"
    )
    (tmp_path / "other.yaml").write_text(text, encoding="utf-8")
    card = rows(capsys, tmp_path / "other.yaml")
    assert (card["it flies at"][:4], card["fence"]) == ("7 m ", "20 m around home")
    assert "hold, land" in card["over telemetry"]


def test_cameras_that_one_device_takes_with_it_are_named(capsys: Capture, tmp_path: Path) -> None:
    """Four in one image of 1920 x 640."""
    assert "cameras that fail together" not in rows(capsys, QUADROTOR)
    drone = yaml.safe_load(QUADROTOR.read_text(encoding="utf-8"))
    for number, camera in enumerate(drone["source"]["cameras"]):
        camera |= {"device": "/dev/video0", "crop": [480 * number, 0, 480, 640], "turn_deg": 0, "reduce": 1}
    (tmp_path / "board.yaml").write_text(json.dumps(drone), encoding="utf-8")
    told = rows(capsys, tmp_path / "board.yaml")["cameras that fail together"]
    assert told == "front, right, back, left: all of /dev/video0"


def test_every_fault_stands_there_with_what_it_does(capsys: Capture) -> None:
    """The words of `docs/safety.md`; the file holds on a low battery."""
    card = rows(capsys, QUADROTOR)
    named = " ".join(card.values())
    assert all(f"`{event.value}`" in named for event in Event if event.value not in {"started", "no_answer"})
    assert "`camera_lost`" in card["flies slower"]
    assert "`battery_low`" in card["asks PX4 for Hold"]
    assert "`link_lost`" in card["sends nothing; PX4's own failsafe acts"]
    assert "`neighbours_lost`" in card["asks PX4 for Hold after 10 s"]
