"""Peers that publish what is no message: counted, shown as malformed, and never a terminal's master."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from flockd.core.config import load_drone
from flockd.core.errors import ConfigError
from flockd.core.printable import printable
from flockd.fleet.fleet_status import status_rows
from flockd.fleet.watcher import MAX_BYTES, MAX_DRONES, FleetWatcher, Watched
from flockd.onboard.telemetry.schema import completed, fault
from flockd.onboard.telemetry.topics import TOPICS, ComputerMessage, FlightMessage, NeighboursMessage, StateMessage
from flockd.onboard.telemetry.zenoh_session import close_session, open_session
from flockd.sim.free_ports import free_endpoint

ROOT = Path(__file__).parents[3]
FLIGHT = {
    "time_s": 5.0, "state": "normal", "reasons": [], "flight_mode": "offboard", "armed": True, "in_air": True,
    "heartbeat_age_s": 0.1, "heartbeats_lost": 0,
    "battery_share": 0.5, "height_m": 4.0, "velocity_trim": [0.0, 0.0], "gusts_m_s": 0.1,
    "silence": None,
    "setpoints_sent": 1, "setpoints_missed": 0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({}, None),
        ({"height_m": None, "battery_share": 1, "later": "version"}, None),
        ({"height_m": "4.0"}, "height_m is no finite number"),
        ({"height_m": True}, "height_m is no finite number"),
        ({"height_m": float("inf")}, "height_m is no finite number"),
        ({"setpoints_sent": 0.5}, "setpoints_sent is no whole number"),
        ({"setpoints_sent": 10**400}, "setpoints_sent is no whole number"),
        ({"armed": 1}, "armed is no true or false"),
        ({"state": ["normal"]}, "state is no text"),
        ({"reasons": {}}, "reasons is no list"),
        ({"reasons": [{"event": "hot"}]}, "reasons[0].sentence is missing"),
        ({"reasons": [{"event": "hot", "sentence": 3}]}, "reasons[0].sentence is no text"),
        ({"reasons": ["hot"]}, "reasons[0] is no object"),
        ({"time_s": None}, "time_s is null"),
    ],
)
def test_every_field_is_of_its_type(change: dict[str, Any], told: str | None) -> None:
    assert fault({**FLIGHT, **change}, FlightMessage) == told


def test_what_is_nested_is_looked_into() -> None:
    camera = {"age_s": None, "fault": None, "counts": {"used": "many"}}
    computer = dict.fromkeys(ComputerMessage.__annotations__, 0) | {
        "cameras": {"front": camera}, "temperature_c": None, "recording": None
    }  # fmt: skip
    assert fault(computer, ComputerMessage) == "cameras.front.counts.used is no whole number"
    assert fault({**computer, "cameras": [camera]}, ComputerMessage) == "cameras is no object"
    assert fault({"time_s": 0.0, "neighbours": [3]}, NeighboursMessage) == "neighbours[0] is no object"
    assert fault([], NeighboursMessage) == "it is no object"


def test_a_drone_of_an_earlier_version_is_shown_without_what_it_lacks() -> None:
    """Its `state` has neither position nor home; a camera of its `computer` has no fault."""
    old: dict[str, Any] = {
        "time_s": 5.0, "height_m": 4.0, "roll_deg": 0.0, "pitch_deg": 0.0, "yaw_deg": 90.0, "velocity_ned": None
    }  # fmt: skip
    state, places = completed(old, StateMessage), {"position_ne": None, "home_deg": None}
    assert state == {**old, **places}
    assert fault(state, StateMessage) is None
    computer = completed({"cameras": {"front": {"counts": {}}}, "steps": 3}, ComputerMessage)
    assert computer["cameras"] == {"front": {"counts": {}, "age_s": None, "fault": None}}
    assert fault(computer, ComputerMessage) == "time_s is missing", "what cannot be null has to be there"
    assert completed([], StateMessage) == []
    assert completed({"cameras": 3}, ComputerMessage)["cameras"] == 3
    drone = Watched("f", "d", alive=True, malformed={"computer": "load is missing"}, seen=True)
    (row,) = status_rows([drone], 0.0)
    told = "its message `computer` is malformed: load is missing; it may run another version of flockd"
    assert row["matters"] == [told]


def test_every_topic_can_be_checked() -> None:
    for topic in TOPICS.values():
        assert fault({}, topic.type) == "time_s is missing"


def test_a_drone_is_shown_with_what_is_wrong_until_its_message_is_right_again() -> None:
    good, malformed = json.dumps(FLIGHT).encode(), "its message `flight` is malformed: "
    published: tuple[tuple[bytes, list[str]], ...] = (
        (good, []),
        (b"[" * 100_000, [f"{malformed}it is not JSON"]),
        (json.dumps({**FLIGHT, "reasons": 7}).encode(), [f"{malformed}reasons is no list"]),
        (b" " * (MAX_BYTES + 1), [f"{malformed}it is longer than 1024 KiB"]),
        (good, []),
    )
    endpoint = free_endpoint()
    with FleetWatcher(None, listen=[endpoint], connect=[]) as watcher:
        session = open_session("a test", [], [endpoint])
        for payload, matters in published:
            until_s, shown = time.monotonic() + 60.0, None
            while shown != matters and time.monotonic() < until_s:
                session.put("flockd/v1/f/d/flight", payload)
                time.sleep(0.05)
                shown = [row["matters"] for row in status_rows(watcher.drones(), time.monotonic())][-1:]
                shown = shown[0] if shown else None
            assert shown == matters
        close_session(session)


def test_invented_drones_do_not_fill_the_memory() -> None:
    with FleetWatcher(None, listen=[], connect=[]) as watcher:
        watcher._drones.update({("fleet", f"drone{i}"): Watched("fleet", f"drone{i}") for i in range(MAX_DRONES)})
        assert watcher._watched("fleet", "drone7") is not None
        assert watcher._watched("fleet", "one-more") is None
        watcher._drones.clear()
        assert watcher._watched("fleet\x1b[2J", "drone0") is None


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("größer als 3 m – gut", "größer als 3 m – gut"),
        ("\x1b[2Jgone", "\\u001b[2Jgone"),
        ("\x9b31m", "\\u009b31m"),
        ("a\u202eb", "a\\u202eb"),
        ("half \ud800", "half \\ud800"),
        ("tag \U000e0041", "tag \\udb40\\udc41"),
        ("two\nlines\r", "two\nlines\\u000d"),
    ],
)
def test_what_would_steer_a_terminal_is_written_as_an_escape(text: str, shown: str) -> None:
    assert printable(text) == shown
    assert "\n" not in printable(text, lines=False)
    assert json.loads(f'"{shown}"'.replace("\n", "\\n")) == text, "as in JSON"


def test_a_configurations_control_codes_do_not_reach_the_terminal(tmp_path: Path) -> None:
    """YAML can write them as escapes in a quoted key or value."""
    path = tmp_path / "drone.yaml"
    path.write_text('name: "\\e[2J\\e]0;owned\\a"\n"\\e[31mred": 1\nrig: {cameras: "\\x9b5m"}\n', encoding="utf-8")
    with pytest.raises(ConfigError):
        load_drone(path)
    run = "import sys; from flockd.cli import main; sys.exit(main(sys.argv[1:]))"
    for options in (["config", "check"], ["run", "--config"]):
        ended = subprocess.run(
            [sys.executable, "-c", run, *options, str(path)], cwd=ROOT, capture_output=True, check=False
        )
        assert ended.returncode == 78
        printed = (ended.stdout + ended.stderr).decode("utf-8")
        assert not {c for c in printed if not c.isprintable()} - {"\n"}
        assert "\\u001b[31mred" in printed
