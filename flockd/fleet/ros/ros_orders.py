"""Converts orders of ROS 2 to flockd's; the drone decides whether to fly one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flockd.fleet.drone_rows import Row, origin_of
from flockd.fleet.ros.message_trees import Names
from flockd.fleet.ros.ros_frames import MAP, ned_of_enu
from flockd.onboard.telemetry.topics import AboutMessage, OrderMessage


def goal_of(message: Any, names: Names, row: Row, about: AboutMessage | None) -> OrderMessage:
    """The goal of a PoseStamped in `map` or the drone's `odom`. Its orientation is ignored; height 0 keeps the height.

    ``message``: with the fields of rclpy's. Raises ValueError, with a sentence for its sender.
    """
    frame, place = message.header.frame_id.removeprefix("/"), message.pose.position
    north, east, down = ned_of_enu(np.array([place.x, place.y, place.z])).tolist()
    origin = None if about is None else origin_of(about["configuration"])
    if origin is None:
        raise ValueError("the origin of the drone's mission is not known yet; send the goal again in a second")
    if frame == MAP:
        if row["home_ne"] is None:
            raise ValueError(f"the drone's home is not known in `{MAP}`; send the goal in {names.odom!r}")
        north, east = north - row["home_ne"][0], east - row["home_ne"][1]
    elif frame != names.odom:
        raise ValueError(f"a goal is in {MAP!r} or {names.odom!r}, and not in {frame!r}")
    if not all(map(math.isfinite, (north, east, down))):
        raise ValueError("a goal's numbers have to be finite")
    order = OrderMessage(north_m=north - origin[0], east_m=east - origin[1])
    if down:
        order["height_m"] = -down
    return order


def velocity_of(message: Any, names: Names, row: Row, _: AboutMessage | None) -> OrderMessage:
    """The velocity of a TwistStamped in `map`, the drone's `odom` or `level`, or its body. It must be horizontal.

    ``message``: with the fields of rclpy's. Raises ValueError, with a sentence for its sender.
    """
    frame, linear, angular = message.header.frame_id.removeprefix("/"), message.twist.linear, message.twist.angular
    if not all(map(math.isfinite, (linear.x, linear.y, linear.z))):
        raise ValueError("a velocity's numbers have to be finite")
    if any((linear.z, angular.x, angular.y, angular.z)):
        raise ValueError("flockd flies level and keeps its heading: leave `linear.z` and `angular` at 0")
    if frame in {MAP, names.odom, names.level}:
        return OrderMessage(velocity_ne=[linear.y, linear.x])
    if frame != names.base_link:
        known = ", ".join(map(repr, (MAP, names.odom, names.level, names.base_link)))
        raise ValueError(f"a velocity is in one of {known}, and not in {frame!r}")
    if row["yaw_deg"] is None:
        raise ValueError(f"the drone's heading is not known; send the velocity in {names.level!r}")
    yaw = math.radians(row["yaw_deg"])  # level, whatever its roll and pitch
    ahead, right = linear.x, -linear.y
    return OrderMessage(
        velocity_ne=[
            ahead * math.cos(yaw) - right * math.sin(yaw),
            ahead * math.sin(yaw) + right * math.cos(yaw),
        ]
    )
