"""Axes of REP 103 and REP 105, against cases worked out by hand from their texts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.fleet.ros import ros_frames as rf

TOLERANCE = 1e-9


def near(value: object, expected: object) -> None:
    np.testing.assert_allclose(np.asarray(value), np.asarray(expected), rtol=0, atol=TOLERANCE)


def test_world_axes() -> None:
    """REP 103: "X east, Y north, Z up". 1 m north, 2 m east, 3 m down is x 2, y 1, z -3."""
    near(rf.enu_of_ned(np.array([1.0, 2.0, 3.0])), [2.0, 1.0, -3.0])
    near(rf.ned_of_enu(np.array([2.0, 1.0, -3.0])), [1.0, 2.0, 3.0])
    near(rf.enu_of_ned(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -7.0]])), [[0.0, 1.0, 0.0], [0.0, 0.0, 7.0]])


def test_body_axes() -> None:
    """REP 103: "x forward, y left, z up". 1 m ahead, 2 m right, 3 m down is x 1, y -2, z -3."""
    near(rf.flu_of_frd(np.array([1.0, 2.0, 3.0])), [1.0, -2.0, -3.0])
    near(rf.frd_of_flu(np.array([1.0, -2.0, -3.0])), [1.0, 2.0, 3.0])


def yaw_quaternion(degrees: float) -> list[float]:
    half = math.radians(degrees) / 2
    return [0.0, 0.0, math.sin(half), math.cos(half)]


@pytest.mark.parametrize(
    ("heading_deg", "ros_yaw_deg"),
    [(0.0, 90.0), (90.0, 0.0), (180.0, -90.0), (-90.0, 180.0), (30.0, 60.0), (135.0, -45.0)],
)
def test_yaw_counts_from_east_counter_clockwise(heading_deg: float, ros_yaw_deg: float) -> None:
    """REP 103: yaw is zero when pointing east, and grows counter-clockwise, from x east to y north."""
    R = rf.attitude_in_ros(rf.attitude_of_angles(0.0, 0.0, heading_deg))
    angle = math.radians(ros_yaw_deg)
    near(R, [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    near(rf.attitude_of_ros(R), rf.attitude_of_angles(0.0, 0.0, heading_deg))
    if abs(ros_yaw_deg) < 180.0:
        near(rf.quaternion_of(R), yaw_quaternion(ros_yaw_deg))
    near(rf.rotation_of(np.array(yaw_quaternion(ros_yaw_deg))), R)


def test_pitch_and_roll() -> None:
    """Nose up by 30 degrees to the east, then right wing down by 90 to the north: worked out on paper.

    Pitch: forward is cos 30 east and sin 30 up; left stays north; up is -sin 30 east, cos 30 up.
    Roll: forward stays north; left (which was west) points up; up (which was up) points east.
    """
    half, root = 0.5, math.sqrt(3) / 2
    near(rf.attitude_in_ros(rf.attitude_of_angles(0.0, 30.0, 90.0)), [[root, 0, -half], [0, 1, 0], [half, 0, root]])
    near(rf.attitude_in_ros(rf.attitude_of_angles(90.0, 0.0, 0.0)), [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    near(rf.quaternion_of(rf.attitude_in_ros(rf.attitude_of_angles(90.0, 0.0, 0.0))), [0.5, 0.5, 0.5, 0.5])


def test_a_quaternion_that_nobody_filled_in_is_refused() -> None:
    with pytest.raises(ValueError, match="no rotation: a quaternion of length 0; fill it in"):
        rf.rotation_of(np.zeros(4))
    with pytest.raises(ValueError, match="no rotation"):
        rf.rotation_of(np.array([0.0, 0.0, 0.0, math.nan]))


def test_the_rays_of_a_scan() -> None:
    """Of 72 sectors clockwise from north: west is 54, south 36, east 18, north 0; the scan turns the other way."""
    order = rf.scan_order(72)
    assert [order[0], order[18], order[36], order[54]] == [54, 36, 18, 0], "west, south, east, north"
    assert sorted(order) == list(range(72))
    with pytest.raises(ValueError, match="multiple of four"):
        rf.scan_order(10)
