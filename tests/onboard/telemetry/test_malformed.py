"""Peers that publish what is no message: counted, shown as malformed, and never a terminal's master."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from flockd.core.config import load_drone
from flockd.core.errors import ConfigError
from flockd.core.printable import printable
from flockd.fleet.drone_rows import status_rows
from flockd.fleet.watcher import MAX_BYTES, MAX_DRONES, MAX_EVENTS_OF_ONE, FleetWatcher, Heard, Watched
from flockd.flight.safety import State
from flockd.onboard.daemon.operator_orders import OperatorCommands, OperatorRequests
from flockd.onboard.message_json import from_json
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.topics import (
    TOPICS,
    AboutMessage,
    ComputerMessage,
    FlightMessage,
    NeighboursMessage,
    StateMessage,
)
from flockd.onboard.telemetry.zenoh_session import close_session, open_session
from flockd.sim.sitl.processes import free_endpoint
from tests.calm import until
from tests.make import flight_message

pytestmark = [pytest.mark.fault("wrong-types-of-a-peer"), pytest.mark.fault("hostile-peers")]

ROOT = Path(__file__).parents[3]


def fault(message: object, kind: type) -> str | None:
    """What `from_json` says of a message; None: it is one."""
    try:
        from_json(kind, message)
    except ValueError as error:
        return str(error)
    return None


FLIGHT = flight_message()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({}, None),
        ({"height_m": None, "battery_share": 1, "later": "version"}, None),
        ({"height_m": "4.0"}, "height_m is no finite number"),
        ({"height_m": True}, "height_m is no finite number"),
        ({"height_m": float("inf")}, "height_m is no finite number"),
        ({"height_m": 1.5e308}, "height_m is beyond 1e+06"),
        ({"velocity_trim": [0.0, -1.5e308]}, "velocity_trim[1] is beyond 1e+10"),
        ({"state": "half \ud800"}, "state is no text"),
        ({"silence": "x" * 5000}, "silence is no text"),
        ({"velocity_trim": [0.0] * 1001}, "velocity_trim has more than 1000 entries"),
        ({"orders_refused": 10**17}, "orders_refused is no whole number"),
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
    assert (fault(computer, ComputerMessage) or "").startswith("cameras.front.counts.used ")
    assert (fault({**computer, "cameras": [camera]}, ComputerMessage) or "").startswith("cameras ")
    assert (fault({"time_s": 0.0, "neighbours": [3]}, NeighboursMessage) or "").startswith("neighbours[0] ")
    assert (fault({**computer, "cameras": {"\ud800": camera}}, ComputerMessage) or "").startswith("a name in cameras ")
    state = {**dict.fromkeys(StateMessage.__annotations__, 0.0), "velocity_ned": None, "position_ne": None}
    assert (fault({**state, "home_deg": [1e308, 8.0]}, StateMessage) or "").startswith("home_deg[0] ")
    assert fault({**state, "home_deg": [47.0, -180.0]}, StateMessage) is None
    assert (fault([], NeighboursMessage) or "").startswith("it ")


def test_a_drone_of_an_earlier_version_is_shown_without_what_it_lacks() -> None:
    """Its `state` has neither position nor home; a camera of its `computer` has no fault."""
    old: dict[str, Any] = {
        "time_s": 5.0, "height_m": 4.0, "roll_deg": 0.0, "pitch_deg": 0.0, "yaw_deg": 90.0, "velocity_ned": None
    }  # fmt: skip
    assert from_json(StateMessage, old) == {**old, "position_ne": None, "home_deg": None}
    computer: dict[str, Any] = dict.fromkeys(ComputerMessage.__annotations__, 0)
    computer |= {"cameras": {"front": {"counts": {}}}, "later": {}}
    known = from_json(ComputerMessage, {**computer, "recording": None})
    assert known["cameras"] == {"front": {"counts": {}, "age_s": None, "fault": None}}
    assert known["later"] == {}
    del computer["load"]
    assert fault(computer, ComputerMessage) == "load is missing", "what cannot be null has to be there"
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
        (b"[" * 10_000, [f"{malformed}it is not JSON"]),
        (json.dumps({**FLIGHT, "reasons": 7}).encode(), [f"{malformed}reasons is no list"]),
        (b" " * (MAX_BYTES + 1), [f"{malformed}it is longer than 32 KiB"]),
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


Take = Callable[[str, object], None]


@pytest.fixture
def take() -> Iterator[tuple[FleetWatcher, Take]]:
    """A watcher that is connected to nobody, and what hands it a message as zenoh does."""
    with FleetWatcher(None, listen=[], connect=[]) as watcher:

        def message(key: str, value: object) -> None:
            payload = SimpleNamespace(to_bytes=lambda: json.dumps(value).encode())
            watcher._take_message(cast("Any", SimpleNamespace(key_expr=f"flockd/v1/f/{key}", payload=payload)))

        yield watcher, message


def test_ten_thousand_invented_names_hide_no_drone(take: tuple[FleetWatcher, Take]) -> None:
    """Malformed messages are no drone; of drones that say one thing once, those are forgotten, not those that fly."""
    watcher, message = take
    for number in range(10_000):
        message(f"malformed{number}/flight", {})
    assert (watcher.drones(), watcher.malformed) == ((), 10_000)
    for number in range(10_000):
        message(f"invented{number}/flight", FLIGHT)
        if number % 50 == 0:  # it came after 5,000 of them
            message("real/flight", FLIGHT if number >= 5000 else None)
            message("real/events", {"time_s": 1.0, "event": f"event {number}"})
    drones = {drone.drone: drone for drone in watcher.drones()}
    assert len(drones) <= MAX_DRONES
    assert drones["real"].messages > 100
    assert watcher.forgotten > 9000
    message("fleet\x1b[2J/flight", FLIGHT)
    assert not [drone for drone in watcher.drones() if "\x1b" in drone.drone]


def test_who_has_announced_itself_stands_before_names_that_nobody_stands_behind() -> None:
    invented = Watched("f", "invented", topics={"flight": Heard(0.0, FLIGHT)}, seen=True)
    drone = Watched("f", "real", alive=True, announced=True, topics={"flight": Heard(0.0, FLIGHT)}, seen=True)
    gone = Watched("f", "gone", announced=True, seen=True)
    two = replace(drone, drone="two", identities=frozenset({"1", "2"}))
    shown = [row["drone"] for row in status_rows([invented, drone, gone, two], 0.1)]
    assert shown == ["two", "gone", "real", "invented"]


def test_one_that_says_much_displaces_none_of_the_others_events(take: tuple[FleetWatcher, Take]) -> None:
    watcher, message = take
    message("quiet/events", {"time_s": 1.0, "event": "the pilot selected offboard"})
    for number in range(5000):
        message("loud/events", {"time_s": 1.0, "event": f"{number}"})
    heard = [(event.drone, event.sentence) for event in watcher.events()]
    assert heard[0] == ("quiet", "the pilot selected offboard")
    assert heard[1:] == [("loud", f"{number}") for number in range(5000 - MAX_EVENTS_OF_ONE, 5000)]


@pytest.mark.fault("one-name-twice")
def test_two_drones_of_one_name_are_told_apart_by_identity_and_neither_gets_an_order() -> None:
    """Each answers for itself while it is alone; the order names the identity, which the other refuses."""
    endpoint, asked = free_endpoint(), list[str]()

    def commands(telemetry: ZenohTelemetry, loop: asyncio.AbstractEventLoop) -> None:
        handler = OperatorCommands(
            ["hold"], OperatorRequests(), loop, asked.append, order_fault=str, fly=print, state=lambda: State.NORMAL,
            identity=telemetry.identity,
        )  # fmt: skip
        about = AboutMessage(version="1", configuration={}, commands=["hold"])
        telemetry.announce("d", about, handler.handle, lambda camera: None)

    def identities() -> list[str]:
        return [identity for row in status_rows(watcher.drones(), time.monotonic()) for identity in row["identities"]]

    loop = asyncio.new_event_loop()
    with (
        FleetWatcher(None, listen=[endpoint], connect=[]) as watcher,
        ZenohTelemetry("f", listen=[], connect=[endpoint]) as one,
    ):
        commands(one, loop)
        until(lambda: identities() == [one.identity])
        until(lambda: watcher.ask("f/d", "hold", "anna") is not None)
        with ZenohTelemetry("f", listen=[], connect=[endpoint]) as other:
            commands(other, loop)
            until(lambda: identities() == sorted({one.identity, other.identity}))
            taken = len(asked)
            refused = watcher.ask("f/d", "hold", "anna")
            assert refused is not None and not refused["accepted"]
            assert refused["sentence"].startswith("nothing was sent: 2 drones call themselves d")
            assert len(asked) == taken
            (row,) = status_rows(watcher.drones(), time.monotonic())
            assert row["matters"][0].endswith("give each its own `name` in its configuration")
            # An order on its way when the second one appeared reaches both, and only whose identity it names obeys.
            watcher.queries.ask("f/d", one.identity, "hold", "anna")
            until(lambda: len(asked) == taken + 2)
            assert sorted("another drone of this name" in event for event in asked[taken:]) == [False, True]
        until(lambda: identities() == [one.identity])
        answer = watcher.ask("f/d", "hold", "anna")
        assert answer is not None and answer["accepted"]
    loop.close()


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("größer als 3 m – gut", "größer als 3 m – gut"),
        ("\x1b[2Jgone", "\\u001b[2Jgone"),
        ("\x9b31m", "\\u009b31m"),
        ("a\u202eb", "a\\u202eb"),
        ("half \ud800", "half \\ud800"),
        ("tag \U000e0041", "tag \\udb40\\udc41"),
        ("two\nlines\r", "two\nlines\\r"),
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
    run = "from flockd.cli import program; program()"
    for options in (["config", "check"], ["run", "--config"]):
        ended = subprocess.run(
            [sys.executable, "-c", run, *options, str(path)], cwd=ROOT, capture_output=True, check=False
        )
        assert ended.returncode == 78
        printed = (ended.stdout + ended.stderr).decode("utf-8")
        assert not {c for c in printed if not c.isprintable()} - {"\n"}
        assert "\\u001b[31mred" in printed
