"""Orders from ROS 2, worked out by hand: where they lead in flockd's axes, and why some are none."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flockd.core.ros_frames import attitude_of_angles
from flockd.fleet.ros.fleet_bridge import DroneNames
from flockd.fleet.ros.ros_orders import NewestOrder, Whereabouts, goal_of, velocity_of
from flockd.onboard.ros.message_trees import Names
from tests.calm import until

HOME, ORIGIN = np.array([100.0, 50.0]), np.array([3.0, -4.0])
DRONE = Whereabouts(Names("drone1"), HOME, ORIGIN, attitude_of_angles(5.0, -10.0, 90.0))


def goal(frame: str, *place: float) -> dict[str, Any]:
    return {"header": {"frame_id": frame}, "pose": {"position": dict(zip("xyz", place, strict=True))}}


def motion(frame: str, linear: tuple[float, ...], angular: tuple[float, ...] = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    parts = {"linear": dict(zip("xyz", linear, strict=True)), "angular": dict(zip("xyz", angular, strict=True))}
    return {"header": {"frame_id": frame}, "twist": parts}


def test_a_goal_counts_from_the_missions_origin() -> None:
    """11 m east and 7 m north of home; the origin is 3 m north and 4 m west of it."""
    expected = {"north_m": 4.0, "east_m": 15.0, "height_m": 2.5}
    assert goal_of(goal("drone1/odom", 11.0, 7.0, 2.5), DRONE) == expected
    assert goal_of(goal("map", 61.0, 107.0, 2.5), DRONE) == expected, "home is 100 m north and 50 m east in the map"
    assert "height_m" not in goal_of(goal("map", 61.0, 107.0, 0.0), DRONE), "as RViz sends it: the height stays"


@pytest.mark.parametrize(
    ("frame", "place", "drone", "sentence"),
    [
        ("base_link", (1.0, 0.0, 0.0), DRONE, "a goal is in 'map' or 'drone1/odom', and not in 'base_link'"),
        ("", (1.0, 0.0, 0.0), DRONE, "and not in ''"),
        ("map", (np.nan, 0.0, 0.0), DRONE, "finite"),
        ("map", (1.0, 0.0, 0.0), replace(DRONE, home_ne=None), "home is not known in `map`"),
        ("drone1/odom", (1.0, 0.0, 0.0), replace(DRONE, origin_ne=None), "origin is not known yet"),
    ],
)
def test_goals_that_are_none(frame: str, place: tuple[float, ...], drone: Whereabouts, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        goal_of(goal(frame, *place), drone)


def test_a_velocity_in_the_body_is_level() -> None:
    """Facing east: 0.5 m/s ahead is east, 0.25 to the left is north; roll and pitch do not matter."""
    found = velocity_of(motion("drone1/base_link", (0.5, 0.25, 0.0)), DRONE)["velocity_ne"]
    np.testing.assert_allclose(found, [0.25, 0.5], atol=1e-9)
    assert velocity_of(motion("drone1/level", (0.5, 0.25, 0.0)), DRONE)["velocity_ne"] == [0.25, 0.5]


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (motion("map", (0.0, 0.0, 0.1)), "leave `linear.z` and `angular` at 0"),
        (motion("map", (0.1, 0.0, 0.0), (0.0, 0.0, 1.0)), "leave `linear.z` and `angular` at 0"),
        (motion("map", (np.inf, 0.0, 0.0)), "finite"),
        (motion("odom", (0.1, 0.0, 0.0)), "and not in 'odom'"),
    ],
)
def test_velocities_that_are_none(message: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        velocity_of(message, DRONE)


def test_every_drone_has_a_name_that_ros_takes_and_keeps_it() -> None:
    names = DroneNames()
    assert names.of("a/drone.1-x") == "drone_1_x"
    assert names.of("b/drone_1_x") == "b_drone_1_x", "the same name in ROS"
    assert names.of("b/drone-1-x") == "b_drone_1_x_2", "and its fleet's too"
    assert names.of("a/1st") == "d1st"
    assert names.of("a/drone.1-x") == "drone_1_x"


def test_of_orders_that_wait_the_newest_counts() -> None:
    taken: list[int] = []
    answered, over = threading.Event(), threading.Event()

    def take(order: int) -> None:
        taken.append(order)
        if order == 1:
            answered.wait(60.0)
        if order == 50:
            over.set()

    with ThreadPoolExecutor(2) as threads:
        slow, other = NewestOrder(threads, take), NewestOrder(threads, lambda order: taken.append(-order))
        slow.offer(1)
        until(lambda: taken == [1])
        for order in range(2, 51):
            slow.offer(order)  # returns at once, though the drone is silent
        other.offer(1)
        until(lambda: -1 in taken)
        answered.set()
        assert over.wait(60.0)
        slow.offer(51)
        until(lambda: 51 in taken)
    assert taken == [1, -1, 50, 51]
