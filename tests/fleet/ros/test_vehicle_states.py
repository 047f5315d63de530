"""The vehicle's state from ROS 2, by hand from REP 103: ENU and FLU become NED and FRD."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flockd.fleet.ros.message_trees import IMU, ODOMETRY, POSE
from flockd.fleet.ros.ros_input import LONGEST_GAP_S, PX4_ATTITUDE, NearestState, state_stamp_ns, vehicle_state
from tests.make import vehicle


def _three(x: float, y: float, z: float) -> SimpleNamespace:
    return SimpleNamespace(x=x, y=y, z=z)


def _message(kind: str, covariance: float = 0.0, w: float = math.cos(math.pi / 4), frame: str = "odom") -> Any:
    """Facing north in ENU, 3 m east, 4 m north and 5 m up; ahead at 2 m/s, to the left at 1, up at 0.5."""
    turn = SimpleNamespace(x=0.0, y=0.0, z=math.sin(math.pi / 4) if w else 0.0, w=w)
    header = SimpleNamespace(frame_id=frame)
    pose = SimpleNamespace(orientation=turn, position=_three(3.0, 4.0, 5.0), header=header)
    pose.orientation_covariance = [covariance]
    if kind == IMU:
        return pose
    if kind == POSE:
        return SimpleNamespace(pose=pose, header=header)
    twist = SimpleNamespace(twist=SimpleNamespace(linear=_three(2.0, 1.0, 0.5)), covariance=[covariance])
    return SimpleNamespace(pose=SimpleNamespace(pose=pose, covariance=[0.0]), twist=twist, header=header)


def test_an_odometry_is_the_whole_state() -> None:
    state = vehicle_state(ODOMETRY, _message(ODOMETRY), 7.0)
    assert state is not None and state.position is not None and state.velocity_ned is not None
    assert (state.time_s, state.height_m) == (7.0, 5.0)
    np.testing.assert_allclose(state.position, [4.0, 3.0])
    np.testing.assert_allclose(state.R_ned_body, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(state.velocity_ned, [2.0, -1.0, -0.5], atol=1e-12)


@pytest.mark.parametrize(("kind", "height_m"), [(POSE, 5.0), (IMU, 0.0)])
def test_a_pose_has_no_velocity_and_an_imu_no_height(kind: str, height_m: float) -> None:
    state = vehicle_state(kind, _message(kind), 7.0)
    assert state is not None
    assert (state.height_m, state.velocity_ned) == (height_m, None)


def test_what_nobody_filled_in_is_not_taken() -> None:
    unknown = vehicle_state(ODOMETRY, _message(ODOMETRY, covariance=-1.0), 7.0)
    assert unknown is not None
    assert unknown.velocity_ned is None
    assert vehicle_state(IMU, _message(IMU, covariance=-1.0), 7.0) is None
    assert vehicle_state(POSE, _message(POSE, w=0.0), 7.0) is None
    assert vehicle_state(POSE, _message(POSE, frame="odom_ned"), 7.0) is None, "PX4's axes, as MAVROS names them"


@pytest.mark.parametrize(("stamp_us", "true_ns"), [(1_000_000_200_000, 1_000_000_200_000_000), (7_000_000, 10**15)])
def test_px4_stamps_by_the_computers_clock_or_since_its_own_start(stamp_us: int, true_ns: int) -> None:
    """By the second one a state was true when it arrived: here 0.2 s before its stamp, and long after it."""
    message = SimpleNamespace(timestamp=stamp_us, q=[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])
    assert state_stamp_ns(PX4_ATTITUDE, message, 10**15) == (true_ns, true_ns == 10**15)
    state = vehicle_state(PX4_ATTITUDE, message, 7.0)
    assert state is not None
    np.testing.assert_allclose(state.R_ned_body[:, 0], [0.0, 1.0, 0.0], atol=1e-12)  # it faces east


def test_the_nearest_state_is_the_nearest_on_either_side_and_none_is_far() -> None:
    states = NearestState(kept=2)
    for time_s in (3.0, 1.0, 2.0):
        states.add(vehicle(time_s))
    found = [states.at(t) for t in (2.1, 2.9, 2.0 - LONGEST_GAP_S + 0.01, 2.5, 1.0)]
    assert [state and state.time_s for state in found] == [2.0, 3.0, 2.0, None, None]
