"""The fleet's table: who needs to be looked at stands first."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import pytest

from flockd.fleet.drone_rows import status_rows
from flockd.fleet.watcher import Heard, Watched
from flockd.onboard.telemetry.topics import ComputerMessage
from flockd.sim.flock.flock_telemetry import Repeater
from tests.make import flight_message

NOW_S = 1000.0


def _drone(name: str, state: str, *, alive: bool = True, age_s: float = 0.3, **more: Any) -> Watched:
    flight = flight_message(state=state, **more)
    return Watched("meadow", name, alive, {"flight": Heard(NOW_S - age_s, flight)}, announced=True)


def test_the_worst_stands_first() -> None:
    fleet = [
        _drone("a", "normal"),
        _drone("b", "degraded"),
        _drone("c", "idle"),
        _drone("d", "hover"),
        _drone("e", "normal", age_s=2.0),
        _drone("f", "normal", alive=False),
        _drone("g", "ready"),
        _drone("h", "asking"),
        _drone("i", "silent"),
        _drone("j", "normal"),
        _drone("k", "of a later version"),
    ]
    rows = status_rows(fleet, NOW_S)
    assert [(row["drone"], row["state"]) for row in rows] == [
        ("f", "gone"),
        ("e", "quiet"),
        ("k", "quiet"),
        ("h", "asking"),
        ("d", "hover"),
        ("i", "silent"),
        ("b", "degraded"),
        ("c", "idle"),
        ("g", "ready"),
        ("a", "normal"),
        ("j", "normal"),
    ]


def test_drones_in_one_state_stand_in_the_order_of_their_numbers() -> None:
    rows = status_rows([_drone(name, "normal") for name in ("drone10", "kite", "drone2", "drone1b", "drone1")], NOW_S)
    assert [row["drone"] for row in rows] == ["drone1", "drone1b", "drone2", "drone10", "kite"]


def test_a_drone_that_has_published_nothing_yet_is_said_to_start() -> None:
    new, broken = Watched("meadow", "a", True), Watched("meadow", "b", True, malformed={"flight": "no JSON"})
    first, second = status_rows([new, broken], NOW_S)
    assert (first["state"], first["matters"]) == (
        "quiet",
        ["it has published nothing yet: it starts, or loads its networks"],
    )
    assert second["matters"] == ["its message `flight` is malformed: no JSON"]


def test_a_row_tells_what_is_the_matter() -> None:
    drone = _drone("a", "degraded", reasons=[{"event": "hot", "sentence": "the computer is at 90 °C"}])
    computer = ComputerMessage(
        time_s=5.0,
        cameras={
            "front": {"age_s": 0.1, "fault": None, "counts": {}},
            "back": {"age_s": None, "fault": "back: no such device", "counts": {}},
        },
        load=0.8, steps=3, steps_failed=0, network_faults=0, networks_stuck=0, loop_lag_s=0.0, temperature_c=90.0,
        messages_lost=0, recording=None,
    )  # fmt: skip
    neighbours = {"time_s": 5.0, "neighbours": [{"confirmed": True}, {"confirmed": False}, {"confirmed": True}]}
    topics = {**drone.topics, "computer": Heard(NOW_S, {**computer}), "neighbours": Heard(NOW_S, neighbours)}
    (row,) = status_rows([Watched("meadow", "a", alive=True, topics=topics)], NOW_S)
    assert row["matters"] == ["the computer is at 90 °C", "back: no such device"]
    assert (row["neighbours"], row["load"], row["battery_share"], row["height_m"]) == (2, 0.8, 0.5, 4.0)


def test_a_drone_whose_time_passes_slowly_is_not_quiet() -> None:
    """At a speed factor of 0.25 two messages a second come every 2 s, above the 1.5 s after which they are stale."""
    from flockd.fleet.watcher import _heard

    def row(*heard: tuple[float, float], now_s: float) -> str:
        flight = None
        for watcher_s, own_s in heard:
            flight = _heard(flight, watcher_s, {**_drone("a", "normal").topics["flight"].message, "time_s": own_s})
        assert flight is not None
        (row,) = status_rows([Watched("meadow", "a", alive=True, topics={"flight": flight})], now_s)
        return str(row["state"])

    assert row((0.0, 10.0), (2.0, 10.5), now_s=3.9) == "normal"
    assert row((0.0, 10.0), (2.0, 10.5), now_s=8.5) == "quiet", "1.5 s of its own time are 6 s here"
    assert row((0.0, 10.0), (0.5, 10.5), now_s=2.1) == "quiet", "in real time"


def test_newest_messages_are_sent_again_while_the_simulation_computes() -> None:
    sent: list[tuple[str, str, object]] = []
    again = threading.Event()

    class Sink:
        def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
            sent.append((drone, topic, message["time_s"]))
            if sent.count(("drone1", "state", 2)) == 3:
                again.set()

    with Repeater(Sink(), every_s=0.01) as repeater:
        repeater.publish("drone1", "state", {"time_s": 1})
        repeater.publish("drone1", "state", {"time_s": 2})
        assert again.wait(30.0)
    assert sent[0] == ("drone1", "state", 1)
    assert sent[1:].count(("drone1", "state", 1)) <= len(sent) - 4


def test_a_table_is_printed_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    from flockd.cli.output import tables_console
    from flockd.cli.status import _table

    tables_console().print(_table(status_rows([_drone("a", "normal"), _drone("b", "x", alive=False)], NOW_S)))
    heading, first, second = (line.split() for line in capsys.readouterr().out.splitlines())
    assert heading[:5] == ["drone", "state", "mode", "height", "battery"]
    assert first[:2] == ["meadow/b", "gone"]
    assert second == ["meadow/a", "normal", "offboard", "4.0", "m", "50%"]


def test_a_piped_table_is_not_cut_at_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    from flockd.cli.output import tables_console
    from flockd.cli.status import _table

    sentence = "no heartbeat from the autopilot for 12.5 s, and more words than a line of 80 columns has room for"
    drone = _drone("a", "degraded", reasons=[{"event": "link_lost", "sentence": sentence}])
    tables_console().print(_table(status_rows([drone], NOW_S)))
    _, _, row = capsys.readouterr().out.splitlines()
    assert row.rstrip().endswith(sentence)
    assert row == row.rstrip(), "no padding to the width of a terminal that is not there"
