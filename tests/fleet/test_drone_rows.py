"""What the page shows of a drone follows from what was heard of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from flockd.fleet.drone_rows import HISTORY_COLUMNS, MAX_CAMERAS, Known, drone_rows, history_row
from flockd.fleet.watcher import Heard, Watched
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
    assert row["why"] == ["it can be reached and publishes nothing new; its last message came 10 s ago"]
    (row,) = drone_rows([watched("a", alive=False, state=STATE, flight=FLIGHT)], {}, 240.0).values()
    assert (row["state"], row["height_m"], row["position_ne"]) == ("gone", None, None)
    assert row["why"] == ["its process has ended or cannot be reached; its last message came 2 min ago"]


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
