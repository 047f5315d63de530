"""Reads images and vehicle states from messages of ROS 2, of a bag or a node, without ROS."""

from __future__ import annotations

import re
import threading
from bisect import bisect, insort
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.errors import UsageError
from flockd.core.messages import FloatArray, VehicleState
from flockd.fleet.ros.message_trees import IMU, ODOMETRY, POSE
from flockd.fleet.ros.ros_frames import attitude_of_ros, frd_of_flu, ned_of_enu, rotation_of

_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class RosImage:
    """An Image or CompressedImage."""

    stamp_ns: int
    encoding: str
    """`encoding` of an Image, `format` of a CompressedImage."""
    data: bytes
    size: tuple[int, int] | None = None
    """Width, height; None: a CompressedImage."""
    bytes_per_line: int | None = None


def image_of(message: Any) -> RosImage:
    """The image of a message of `rosbags` or rclpy, whose fields have the same names."""
    if not hasattr(message, "encoding"):
        return RosImage(stamp_ns(message), message.format, bytes(message.data))
    size = message.width, message.height
    return RosImage(stamp_ns(message), message.encoding, bytes(message.data), size, message.step)


PX4_ODOMETRY, PX4_ATTITUDE = "px4_msgs/msg/VehicleOdometry", "px4_msgs/msg/VehicleAttitude"
"""PX4's messages, which have no header."""
STATES = (ODOMETRY, PX4_ODOMETRY, POSE, IMU, PX4_ATTITUDE)
"""Types of messages with a vehicle's state, the best first."""
LONGEST_GAP_S = 0.2
"""Longest time between a state and its images."""


def stamp_ns(message: Any) -> int:
    """Stamp of a message with a header, ns."""
    return int(message.header.stamp.sec) * _NS + int(message.header.stamp.nanosec)


def state_stamp_ns(kind: str, message: Any, arrived_ns: int) -> tuple[int, bool]:
    """Time of a state, ns, and whether that is its arrival: PX4's stamps count from its start instead of from 1970."""
    if kind not in {PX4_ODOMETRY, PX4_ATTITUDE}:
        return stamp_ns(message), False
    own_clock = abs((stamp := 1000 * int(message.timestamp)) - arrived_ns) > _NS
    return arrived_ns if own_clock else stamp, own_clock


def check_height(topic: str, kind: str, config: DroneConfig) -> None:
    """Raises UsageError if the configuration needs a height and states of that kind have none."""
    if kind in {IMU, PX4_ATTITUDE} and config.perception.scale == "height":
        raise UsageError(
            f"{topic} has an attitude and no height; set perception.scale to `network`, or name odometry with --vehicle"
        )


def vehicle_state(kind: str, message: Any, time_s: float) -> VehicleState | None:
    """The vehicle's state; None: the message has no orientation or place, or axes that are not ROS's ENU and FLU. The
    height of an attitude alone is 0.

    ``message``: of rclpy or `rosbags`, whose fields have the same names; ``kind``: one of `STATES`.
    """
    if kind in {PX4_ODOMETRY, PX4_ATTITUDE}:
        return _px4_state(kind, message, time_s)
    axes = f"{message.header.frame_id} {getattr(message, 'child_frame_id', '')}".lower()
    if re.search(r"(^|[_/])ned | (.*[_/])?frd$", axes):
        return None  # as MAVROS names PX4's axes
    unknown = {IMU: "orientation_covariance", ODOMETRY: "pose.covariance"}.get(kind)
    if unknown is not None and attrgetter(unknown)(message)[0] < 0:
        return None
    pose = message.pose.pose if kind == ODOMETRY else message.pose if kind == POSE else message
    try:
        R_ned_body = attitude_of_ros(rotation_of(_values(pose.orientation, "xyzw")))
    except ValueError:
        return None
    if kind == IMU:
        return VehicleState(time_s, R_ned_body, 0.0)
    place, velocity = ned_of_enu(_values(pose.position, "xyz")), None
    if not np.isfinite(place).all():
        return None
    if kind == ODOMETRY and message.twist.covariance[0] >= 0:
        velocity = R_ned_body @ frd_of_flu(_values(message.twist.twist.linear, "xyz"))
        velocity = velocity if np.isfinite(velocity).all() else None
    return VehicleState(time_s, R_ned_body, -float(place[2]), velocity, place[:2])


_NED, _BODY_FRD = 1, 3


def _px4_state(kind: str, message: Any, time_s: float) -> VehicleState | None:
    """The state of PX4's messages, which have flockd's axes; None: PX4's estimator had none."""
    try:
        R_ned_body = rotation_of(np.array([*message.q[1:], message.q[0]], np.float64))
    except ValueError:
        return None
    if kind == PX4_ATTITUDE:
        return VehicleState(time_s, R_ned_body, 0.0)
    place, velocity = np.array(message.position, np.float64), np.array(message.velocity, np.float64)
    if message.pose_frame != _NED or not np.isfinite(place).all():
        return None
    velocity = R_ned_body @ velocity if message.velocity_frame == _BODY_FRD else velocity
    known = message.velocity_frame in {_NED, _BODY_FRD} and bool(np.isfinite(velocity).all())
    return VehicleState(time_s, R_ned_body, -float(place[2]), velocity if known else None, place[:2])


class NearestState:
    """Keeps the newest states, from any thread, and finds the one nearest in time."""

    def __init__(self, kept: int | None = 500) -> None:
        """``kept``: number of states that are kept; None: all."""
        self._kept = kept
        self._states: list[VehicleState] = []
        """In the order of their times."""
        self._lock = threading.Lock()

    def add(self, state: VehicleState | None) -> None:
        """Adds a state, unless it is None."""
        if state is not None:
            with self._lock:
                insort(self._states, state, key=_time_s)
                if self._kept is not None:
                    del self._states[: -self._kept]

    def at(self, time_s: float) -> VehicleState | None:
        """The state nearest to a time; None: none is within `LONGEST_GAP_S`."""
        with self._lock:
            after = bisect(self._states, time_s, key=_time_s)
            around = self._states[max(after - 1, 0) : after + 1]
        nearest = min(around, key=lambda state: abs(state.time_s - time_s), default=None)
        return None if nearest is None or abs(nearest.time_s - time_s) > LONGEST_GAP_S else nearest


def _time_s(state: VehicleState) -> float:
    return state.time_s


def _values(message: Any, names: str) -> FloatArray:
    return np.array([getattr(message, name) for name in names], np.float64)
