"""Orders from ROS 2, worked out by hand: where they lead in flockd's axes, and why some are none."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flockd.fleet.ros.fleet_bridge import DroneNames
from flockd.fleet.ros.message_trees import Names
from flockd.fleet.ros.ros_orders import goal_of, velocity_of
from flockd.onboard.telemetry.topics import AboutMessage

NAMES = Names("drone1")
ROW = {"home_ne": [100.0, 50.0], "yaw_deg": 90.0, "roll_deg": 5.0, "pitch_deg": -10.0}
ABOUT = AboutMessage(version="1", configuration={"mission": {"origin_m": [3.0, -4.0]}}, commands=[])


def stamped(frame: str, **fields: Any) -> Any:
    return SimpleNamespace(header=SimpleNamespace(frame_id=frame), **fields)


def three(values: tuple[float, ...]) -> SimpleNamespace:
    return SimpleNamespace(**dict(zip("xyz", values, strict=True)))


def goal(frame: str, *place: float) -> Any:
    return stamped(frame, pose=SimpleNamespace(position=three(place)))


def motion(frame: str, linear: tuple[float, ...], angular: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Any:
    return stamped(frame, twist=SimpleNamespace(linear=three(linear), angular=three(angular)))


def test_a_goal_counts_from_the_missions_origin() -> None:
    """11 m east and 7 m north of home; the origin is 3 m north and 4 m west of it."""
    expected = {"north_m": 4.0, "east_m": 15.0, "height_m": 2.5}
    assert goal_of(goal("drone1/odom", 11.0, 7.0, 2.5), NAMES, ROW, ABOUT) == expected
    assert goal_of(goal("map", 61.0, 107.0, 2.5), NAMES, ROW, ABOUT) == expected, "from home, 100 m north and 50 m east"
    assert "height_m" not in goal_of(goal("map", 61.0, 107.0, 0.0), NAMES, ROW, ABOUT), "as RViz sends it"


@pytest.mark.parametrize(
    ("frame", "place", "row", "about", "sentence"),
    [
        ("base_link", (1.0, 0.0, 0.0), ROW, ABOUT, "a goal is in 'map' or 'drone1/odom', and not in 'base_link'"),
        ("", (1.0, 0.0, 0.0), ROW, ABOUT, "and not in ''"),
        ("map", (np.nan, 0.0, 0.0), ROW, ABOUT, "finite"),
        ("map", (1.0, 0.0, 0.0), {**ROW, "home_ne": None}, ABOUT, "home is not known in `map`"),
        ("drone1/odom", (1.0, 0.0, 0.0), ROW, None, "mission is not known yet"),
    ],
)
def test_goals_that_are_none(frame: str, place: tuple[float, ...], row: Any, about: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        goal_of(goal(frame, *place), NAMES, row, about)


def test_a_velocity_in_the_body_is_level() -> None:
    """Facing east: 0.5 m/s ahead is east, 0.25 to the left is north; roll and pitch do not matter."""
    found = velocity_of(motion("drone1/base_link", (0.5, 0.25, 0.0)), NAMES, ROW, ABOUT)["velocity_ne"]
    np.testing.assert_allclose(found, [0.25, 0.5], atol=1e-9)
    assert velocity_of(motion("drone1/level", (0.5, 0.25, 0.0)), NAMES, ROW, ABOUT)["velocity_ne"] == [0.25, 0.5]


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (motion("map", (0.0, 0.0, 0.1)), "leave `linear.z` and `angular` at 0"),
        (motion("map", (0.1, 0.0, 0.0), (0.0, 0.0, 1.0)), "leave `linear.z` and `angular` at 0"),
        (motion("map", (np.inf, 0.0, 0.0)), "finite"),
        (motion("odom", (0.1, 0.0, 0.0)), "and not in 'odom'"),
    ],
)
def test_velocities_that_are_none(message: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        velocity_of(message, NAMES, ROW, ABOUT)


def test_every_drone_has_a_name_that_ros_takes_and_keeps_it() -> None:
    names = DroneNames()
    assert names.of("a/drone.1-x") == "drone_1_x"
    assert names.of("b/drone_1_x") == "b_drone_1_x", "the same name in ROS"
    assert names.of("b/drone-1-x") == "b_drone_1_x_2", "and its fleet's too"
    assert names.of("a/1st") == "d1st"
    assert names.of("a/drone.1-x") == "drone_1_x"
