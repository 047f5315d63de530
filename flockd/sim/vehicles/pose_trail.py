"""The poses of all drones in the last second: cameras expose at other instants than pilots step."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from flockd.core.messages import FloatArray
from flockd.flight.geometry import rotation_from_vector, vector_from_rotation

KEPT_S = 1.0
"""How long poses are kept: longer than the largest delay of an image."""
_SAME_TIME_S = 1e-9
_BETWEEN_S = 0.01
"""Interval over which motion is measured."""


@dataclass(frozen=True, eq=False)
class FlockPose:
    """Poses of all drones at one time."""

    time_s: float
    position: FloatArray
    """(n, 3) metres NED."""
    R_ned_body: FloatArray
    """(n, 3, 3)"""


@dataclass(frozen=True, eq=False)
class FlockMotion:
    """Motion of all drones at one time."""

    velocity: FloatArray
    """(n, 3) m/s NED."""
    turn: FloatArray
    """(n, 3) rad/s about the body's axes."""


class PoseTrail:
    """The last second of a flock's poses."""

    def __init__(self) -> None:
        self._poses: deque[FlockPose] = deque()

    def add(self, pose: FlockPose) -> None:
        """Adds the newest pose; a pose that is not later than the last is ignored."""
        if self._poses and pose.time_s <= self._poses[-1].time_s:
            return
        self._poses.append(pose)
        while len(self._poses) > 2 and self._poses[1].time_s < pose.time_s - KEPT_S:
            self._poses.popleft()

    def at(self, time_s: float) -> FlockPose:
        """The pose at a time, interpolated between known ones; before the first and after the last: that one.

        Raises IndexError where there is none.
        """
        poses = self._poses
        if abs(time_s - poses[-1].time_s) < _SAME_TIME_S:
            return poses[-1]
        later = next((i for i in range(len(poses) - 1, 0, -1) if poses[i - 1].time_s <= time_s), 0)
        if later == 0 or time_s >= poses[-1].time_s:
            return poses[-1] if time_s >= poses[-1].time_s else poses[0]
        before, after = poses[later - 1], poses[later]
        share = (time_s - before.time_s) / (after.time_s - before.time_s)
        position = before.position + share * (after.position - before.position)
        return FlockPose(time_s, position, before.R_ned_body @ rotation_from_vector(share * _turn(before, after)))

    def motion_at(self, time_s: float) -> FlockMotion:
        """Motion of the flock around a time, or just before the newest pose; at rest if only one pose is known."""
        end_s = min(time_s + _BETWEEN_S / 2, self._poses[-1].time_s)
        before, after = self.at(end_s - _BETWEEN_S), self.at(end_s)
        return FlockMotion((after.position - before.position) / _BETWEEN_S, _turn(before, after) / _BETWEEN_S)


def _turn(before: FlockPose, after: FlockPose) -> FloatArray:
    """(n, 3) rotation vectors in the bodies' axes."""
    return vector_from_rotation(before.R_ned_body.transpose(0, 2, 1) @ after.R_ned_body)
