"""The card of a flight day says what the drone's own configuration says."""

from __future__ import annotations

from pathlib import Path

import pytest

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


def test_every_fault_stands_there_with_what_it_does(capsys: Capture) -> None:
    """The words of `docs/safety.md`; the file holds on a low battery."""
    card = rows(capsys, QUADROTOR)
    named = " ".join(card.values())
    assert all(f"`{event.value}`" in named for event in Event if event.value not in {"started", "no_answer"})
    assert "`camera_lost`" in card["flies slower"]
    assert "`battery_low`" in card["asks PX4 for Hold"]
    assert "`link_lost`" in card["sends nothing; PX4's own failsafe acts"]
    assert "`neighbours_lost`" in card["asks PX4 for Hold after 10 s"]
