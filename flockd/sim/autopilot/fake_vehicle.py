"""The vehicle under the fake autopilot: a point mass, or whatever else moves to a demand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flockd.core.angles import wrapped
from flockd.core.messages import FloatArray


@dataclass(frozen=True, eq=False)
class Demand:
    """Velocity, height and heading that the flight mode demands of the vehicle."""

    velocity: FloatArray
    """(2,) m/s, north and east."""
    down_m: float
    """Height to go to and hold: down from the origin."""
    yaw_rad: float


@dataclass(frozen=True, eq=False)
class MotionState:
    """Where the vehicle is, in NED with the ground at 0."""

    position: FloatArray
    """(3,) metres."""
    velocity: FloatArray
    """(3,) m/s."""
    R_ned_body: FloatArray
    """(3, 3)"""


Motion = Callable[[Demand, float], MotionState]
"""Advances the vehicle towards a demand by some seconds."""


class PointMass:
    """Follows a demand as a first-order lag of limited acceleration, always level."""

    TIME_CONSTANT_S = 0.25
    MAX_ACCELERATION_M_S2 = 4.0
    MAX_CLIMB_M_S = 3.0

    def __init__(self, position: FloatArray, yaw_rad: float = 0.0) -> None:
        """At rest at `position`, (3,) metres NED."""
        self._position = position.astype(float)
        self._velocity = np.zeros(3)
        self._yaw_rad = yaw_rad

    def __call__(self, demand: Demand, interval_s: float) -> MotionState:
        """Advances it by ``interval_s`` seconds."""
        climb = np.clip(demand.down_m - self._position[2], -self.MAX_CLIMB_M_S, self.MAX_CLIMB_M_S)
        wanted = (np.array([*demand.velocity, climb]) - self._velocity) / self.TIME_CONSTANT_S
        acceleration = wanted * min(1.0, self.MAX_ACCELERATION_M_S2 / max(float(np.linalg.norm(wanted)), 1e-9))
        self._velocity = self._velocity + acceleration * interval_s
        self._position = self._position + self._velocity * interval_s
        if self._position[2] >= 0.0:
            self._position[2], self._velocity[2] = 0.0, min(0.0, self._velocity[2])
        turn = wrapped(demand.yaw_rad - self._yaw_rad)
        self._yaw_rad = wrapped(self._yaw_rad + turn * min(1.0, interval_s / self.TIME_CONSTANT_S))
        cos, sin = math.cos(self._yaw_rad), math.sin(self._yaw_rad)
        R_ned_body = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return MotionState(self._position, self._velocity, R_ned_body)
