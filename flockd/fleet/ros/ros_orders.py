"""Orders as they come from ROS 2, turned into those of flockd; whether one may be flown is the drone's to say."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from flockd.core.messages import FloatArray
from flockd.core.ros_frames import MAP, ned_of_enu
from flockd.onboard.ros.message_trees import Names, Tree
from flockd.onboard.telemetry.topics import OrderMessage


@dataclass(frozen=True, eq=False)
class Whereabouts:
    """What has to be known of a drone for its orders."""

    names: Names
    home_ne: FloatArray | None
    """(2,) metres from the origin of `map` to its home; None where that is not known."""
    origin_ne: FloatArray | None
    """(2,) metres from home to its mission's origin, from which orders count; None where its configuration is not
    known."""
    R_ned_frd: FloatArray | None
    """(3, 3) its attitude; None where that is not known."""


def goal_of(message: Tree, drone: Whereabouts) -> OrderMessage:
    """Of a PoseStamped in `map` or the drone's `odom`. Its orientation says nothing; a height of 0 is as it is now.

    Raises ValueError, with a sentence for its sender.
    """
    frame, place = message["header"]["frame_id"].removeprefix("/"), message["pose"]["position"]
    north, east, down = ned_of_enu(np.array([place["x"], place["y"], place["z"]])).tolist()
    if drone.origin_ne is None:
        raise ValueError("where the drone's mission has its origin is not known yet; send the goal again in a second")
    if frame == MAP:
        if drone.home_ne is None:
            raise ValueError(f"the drone's home is not known in `{MAP}`; send the goal in {drone.names.odom!r}")
        north, east = north - drone.home_ne[0], east - drone.home_ne[1]
    elif frame != drone.names.odom:
        raise ValueError(f"a goal is in {MAP!r} or {drone.names.odom!r}, and not in {frame!r}")
    if not all(map(math.isfinite, (north, east, down))):
        raise ValueError("a goal's numbers have to be finite")
    order = OrderMessage(north_m=north - float(drone.origin_ne[0]), east_m=east - float(drone.origin_ne[1]))
    if down:
        order["height_m"] = -down
    return order


def velocity_of(message: Tree, drone: Whereabouts) -> OrderMessage:
    """Of a TwistStamped in `map`, the drone's `odom` or `level`, or its body. Level: flockd keeps height and heading.

    Raises ValueError, with a sentence for its sender.
    """
    frame, motion = message["header"]["frame_id"].removeprefix("/"), message["twist"]
    linear = np.array([motion["linear"][axis] for axis in "xyz"])
    if not np.isfinite(linear).all():
        raise ValueError("a velocity's numbers have to be finite")
    if linear[2] or any(motion["angular"][axis] for axis in "xyz"):
        raise ValueError("flockd flies level and keeps its heading: leave `linear.z` and `angular` at 0")
    if frame in {MAP, drone.names.odom, drone.names.level}:
        north, east, _ = ned_of_enu(linear).tolist()
    elif frame == drone.names.base_link:
        if drone.R_ned_frd is None:
            raise ValueError(f"the drone's heading is not known; send the velocity in {drone.names.level!r}")
        yaw = math.atan2(drone.R_ned_frd[1, 0], drone.R_ned_frd[0, 0])  # level, whatever its roll and pitch
        ahead, right = float(linear[0]), -float(linear[1])
        north, east = ahead * math.cos(yaw) - right * math.sin(yaw), ahead * math.sin(yaw) + right * math.cos(yaw)
    else:
        known = ", ".join(map(repr, (MAP, drone.names.odom, drone.names.level, drone.names.base_link)))
        raise ValueError(f"a velocity is in one of {known}, and not in {frame!r}")
    return OrderMessage(velocity_ne=[north, east])


class NewestOrder:
    """Orders of one kind to one drone, one at a time: of those that wait the newest counts.

    `offer` returns at once, so that a drone that is gone holds up no other.
    """

    def __init__(self, threads: Executor, take: Callable[[Any], None]) -> None:
        """``take`` may wait; it is called on a thread of ``threads``."""
        self._threads, self._take = threads, take
        self._lock = threading.Lock()
        self._waiting: list[Any] = []
        self._busy = False

    def offer(self, message: Any) -> None:
        """Takes the place of what waits; from any thread."""
        with self._lock:
            self._waiting = [message]
            if self._busy:
                return
            self._busy = True
        self._threads.submit(self._run)

    def _run(self) -> None:
        while (message := self._next()) is not None:
            try:
                self._take(message[0])
            except BaseException:
                with self._lock:
                    self._busy = False  # the next one is passed on all the same
                raise

    def _next(self) -> list[Any] | None:
        """What waits; with nothing, this thread has ended its work."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
            self._busy = bool(waiting)
            return waiting or None
