"""What the page and `flockd status` show of a drone follows from what was heard of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from flockd.cli.output import tables_console
from flockd.cli.status import _table
from flockd.fleet.drone_rows import HISTORY_COLUMNS, MAX_CAMERAS, Known, drone_rows, history_row, status_rows
from flockd.fleet.watcher import Heard, Watched, _heard
from flockd.onboard.telemetry.topics import AboutMessage
from tests.make import flight_message

STATE: dict[str, Any] = {
    "time_s": 4.0, "height_m": 5.0, "roll_deg": 0.0, "pitch_deg": 0.0, "yaw_deg": 90.0,
    "velocity_ned": [3.0, -4.0, 0.0], "position_ne": [10.0, 20.0], "home_deg": [47.0, 8.0],
}  # fmt: skip
FLIGHT = flight_message(
    state="degraded", reasons=[{"event": "x", "sentence": "the battery is low"}], battery_share=0.4, height_m=5.1
)


def watched(name: str, *, alive: bool = True, **topics: dict[str, Any]) -> Watched:
    """A drone all of whose messages came at 100 s."""
    return Watched("f", name, alive, {topic: Heard(100.0, message) for topic, message in topics.items()}, seen=True)


def test_homes_are_put_on_one_map_in_metres() -> None:
    """A degree is 111.2 km of latitude, and cos 47 of 111.6 km of longitude (WGS 84, to a metre at these offsets)."""
    there = {**STATE, "home_deg": [47.001, 8.001]}
    rows = drone_rows([watched("b", state=there, flight=FLIGHT), watched("a", state=STATE, flight=FLIGHT)], {}, 100.5)
    assert rows["f/a"]["home_ne"] == [0.0, 0.0]
    assert rows["f/b"]["home_ne"] == pytest.approx([111.2, 76.1], abs=0.3)
    point = dict(zip(HISTORY_COLUMNS, history_row(rows["f/b"], 7.0), strict=True))
    assert (point["north"], point["east"]) == pytest.approx((121.2, 96.1), abs=0.3)
    assert (point["time"], point["speed"], point["battery"]) == (7.0, 5.0, 0.4)


def test_the_map_goes_on_across_the_date_line() -> None:
    """Fiji: homes 0.002 degrees apart, of 111.32 cos 18 km each (WGS 84, to a metre), not 359.998."""
    west, east = ({**STATE, "home_deg": [-18.0, degrees]} for degrees in (179.999, -179.999))
    rows = drone_rows([watched("a", state=west, flight=FLIGHT), watched("b", state=east, flight=FLIGHT)], {}, 100.5)
    assert rows["f/b"]["home_ne"] == pytest.approx([0.0, 211.8], abs=0.5)
    rows = drone_rows([watched("a", state=east, flight=FLIGHT), watched("b", state=west, flight=FLIGHT)], {}, 100.5)
    assert rows["f/b"]["home_ne"] == pytest.approx([0.0, -211.8], abs=0.5)


def test_who_commands_it_is_told_and_two_at_once_are_a_matter() -> None:
    orders = [
        {"operator": "bert", "command": "goto", "sequence": 3, "age_s": 1.0},
        {"operator": "anna", "command": "hold", "sequence": 9, "age_s": 20.0},
    ]
    (row,) = drone_rows([watched("a", state=STATE, flight={**FLIGHT, "orders": orders[:1]})], {}, 100.5).values()
    assert (row["orders"], row["why"]) == (orders[:1], ["the battery is low"])
    (row,) = drone_rows([watched("a", state=STATE, flight={**FLIGHT, "orders": orders})], {}, 100.5).values()
    told = "2 operators commanded it within a minute, the last one first: bert (goto), anna (hold); agree on one"
    assert row["why"] == [told, "the battery is low"]


def test_only_cameras_that_can_be_asked_are_offered() -> None:
    cameras: dict[str, Any] = {
        name: {"age_s": 0.1, "fault": None, "counts": {}} for name in ("front", "*", "a/b", "x" * 300)
    }
    many = {f"c{number}": cameras["front"] for number in range(100)}
    computer = {"time_s": 4.0, "cameras": {**cameras, **many}, "load": 0.1}
    (row,) = drone_rows([watched("a", computer=computer)], {}, 100.5).values()
    assert list(row["cameras"]) == ["front", *(f"c{number}" for number in range(MAX_CAMERAS - 1))]


def test_a_drone_says_what_is_wrong_with_it() -> None:
    (row,) = drone_rows([watched("a", state=STATE, flight=FLIGHT)], {}, 100.5).values()
    assert (row["state"], row["why"]) == ("degraded", ["the battery is low"])
    (row,) = drone_rows([watched("a", state=STATE, flight=FLIGHT)], {}, 114.0).values()
    assert row["state"] == "quiet"
    assert "10 s ago" in row["why"][0]
    (row,) = drone_rows([watched("a", alive=False, state=STATE, flight=FLIGHT)], {}, 240.0).values()
    assert (row["state"], row["height_m"], row["position_ne"]) == ("gone", None, None)
    assert "2 min ago" in row["why"][0]


def test_the_rate_is_of_new_messages_and_ends_with_them() -> None:
    drone = watched("a", flight=FLIGHT, state=STATE)
    slow = replace(drone, topics={**drone.topics, "state": Heard(100.0, STATE, 1.0, period_s=0.5, new_s=100.0)})
    assert drone_rows([slow], {}, 100.2)["f/a"]["rate_hz"] == 2.0
    assert drone_rows([slow], {}, 101.6)["f/a"]["rate_hz"] is None
    assert drone_rows([drone], {}, 100.2)["f/a"]["rate_hz"] is None, "one message has no rate"


def test_the_fence_comes_from_the_drones_configuration_and_nonsense_draws_none() -> None:
    def fence_of(configuration: dict[str, object]) -> object:
        about = AboutMessage(version="1", configuration=configuration, commands=["hold"])
        return drone_rows([watched("a", state=STATE, flight=FLIGHT)], {"f/a": Known(about)}, 100.5)["f/a"]["fence"]

    gate = {"fence_radius_m": 30.0, "fence_corners_m": [[0, 0], [0, 9], [9, "x"], [9, float("nan")]]}
    assert fence_of({"safety": {"gate": gate}}) == {"radius_m": 30.0, "corners_m": [[0.0, 0.0], [0.0, 9.0]]}
    nonsense: tuple[dict[str, object], ...] = ({}, {"safety": 3}, {"safety": {"gate": []}})
    assert [fence_of(one) for one in nonsense] == [None] * 3
    assert fence_of({"safety": {"gate": {"fence_radius_m": float("inf")}}}) == {"radius_m": None, "corners_m": []}


def stating(name: str, state: str, *, alive: bool = True, **flight: Any) -> Watched:
    drone = watched(name, alive=alive, flight=flight_message(state=state, **flight))
    return replace(drone, announced=True, seen=False)


def test_the_worst_stands_first_and_drones_in_one_state_in_the_order_of_their_numbers() -> None:
    states = "normal", "degraded", "idle", "hover", "normal", "ready", "asking", "silent", "of a later version"
    names = ("drone10", "b", "c", "d", "drone2", "g", "h", "i", "k")
    late = replace(stating("e", "normal"), topics={"flight": Heard(98.0, flight_message(state="normal"))})
    fleet = [*map(stating, names, states), late, stating("f", "normal", alive=False)]
    assert [(row["drone"], row["state"]) for row in status_rows(fleet, 100.3)] == [
        ("f", "gone"), ("e", "quiet"), ("k", "quiet"), ("h", "asking"), ("d", "hover"), ("i", "silent"),
        ("b", "degraded"), ("c", "idle"), ("g", "ready"), ("drone2", "normal"), ("drone10", "normal"),
    ]  # fmt: skip


def test_a_drone_that_has_published_nothing_yet_is_said_to_start() -> None:
    new, broken = Watched("f", "a", True), Watched("f", "b", True, malformed={"flight": "no JSON"})
    first, second = status_rows([new, broken], 100.3)
    assert first["state"] == "quiet"
    assert "it starts, or loads its networks" in first["matters"][0]
    assert second["matters"][0].endswith("malformed: no JSON")


def test_a_row_tells_what_is_the_matter() -> None:
    cameras = {
        "front": {"age_s": 0.1, "fault": None, "counts": {}},
        "back": {"age_s": None, "fault": "back: no such device", "counts": {}},
    }
    neighbours = {"time_s": 5.0, "neighbours": [{"confirmed": True}, {"confirmed": False}, {"confirmed": True}]}
    computer = {"time_s": 5.0, "cameras": cameras, "load": 0.8}
    (row,) = status_rows([watched("a", flight=FLIGHT, computer=computer, neighbours=neighbours)], 100.0)
    assert row["matters"] == ["the battery is low", "back: no such device"]
    assert (row["neighbours"], row["load"], row["battery_share"], row["height_m"]) == (2, 0.8, 0.4, 5.1)


def test_a_drone_whose_time_passes_slowly_is_not_quiet() -> None:
    """At a speed factor of 0.25 two messages a second come every 2 s, above the 1.5 s after which they are stale."""

    def state(*heard: tuple[float, float], now_s: float) -> str:
        flight = None
        for watcher_s, own_s in heard:
            flight = _heard(flight, watcher_s, flight_message(state="normal", time_s=own_s))
        assert flight is not None
        (row,) = status_rows([Watched("f", "a", alive=True, topics={"flight": flight})], now_s)
        return str(row["state"])

    assert state((0.0, 10.0), (2.0, 10.5), now_s=3.9) == "normal"
    assert state((0.0, 10.0), (2.0, 10.5), now_s=8.5) == "quiet", "1.5 s of its own time are 6 s here"
    assert state((0.0, 10.0), (0.5, 10.5), now_s=2.1) == "quiet", "in real time"


def test_a_table_is_printed_for_people_and_not_cut_at_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    sentence = "no heartbeat from the autopilot for 12.5 s, and more words than a line of 80 columns has room for"
    late = stating("a", "normal", reasons=[{"event": "link_lost", "sentence": sentence}])
    tables_console().print(_table(status_rows([late, stating("b", "x", alive=False)], 100.3)))
    heading, first, second, matter = capsys.readouterr().out.splitlines()
    assert heading.split()[:5] == ["drone", "state", "mode", "height", "battery"]
    assert first.split()[:2] == ["f/b", "gone"]
    assert second.split() == ["f/a", "normal", "offboard", "4.0", "m", "50%"]
    assert matter.endswith(sentence), "no padding to the width of a terminal that is not there"
