"""The vehicle under the fake autopilot: a point mass, or whatever else moves to a demand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flockd.core.messages import FloatArray
from flockd.core.navigation import wrapped
from flockd.flight.geometry import rotation_from_euler
from flockd.sim.scenario import VehicleConfig
from flockd.sim.vehicles import vehicles


@dataclass(frozen=True, eq=False)
class Demand:
    """Velocity, height and heading that the flight mode demands of the vehicle."""

    velocity: FloatArray
    """(2,) m/s, north and east."""
    down_m: float
    """Height to go to and hold: down from the origin."""
    yaw_rad: float


@dataclass(frozen=True, eq=False)
class Asked:
    """What a setpoint asks for."""

    velocity: FloatArray
    """(2,) m/s, north and east."""
    sink_m_s: float
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


class Drift:
    """How the autopilot's estimate wanders off the truth in flight, level: first-order Gauss-Markov processes.

    Standard deviations of each axis and times as seen of PX4 1.18 in software: 0.15 m/s and 0.15 m in all, for seconds.
    """

    VELOCITY_M_S, VELOCITY_S = 0.1, 2.0
    POSITION_M, POSITION_S = 0.1, 5.0

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self.velocity, self.position = np.zeros(2), np.zeros(2)
        """(2,) m/s and m, north and east."""

    def step(self, interval_s: float) -> None:
        """Some seconds on."""
        self.velocity = self._stepped(self.velocity, self.VELOCITY_M_S, interval_s / self.VELOCITY_S)
        self.position = self._stepped(self.position, self.POSITION_M, interval_s / self.POSITION_S)

    def _stepped(self, error: FloatArray, sigma: float, times: float) -> FloatArray:
        kick: FloatArray = self._random.normal(scale=sigma * math.sqrt(-math.expm1(-2 * times)), size=2)
        return math.exp(-times) * error + kick


class PointMass:
    """Follows a demand as PX4's vehicle in software does, but always level: the simulator's, without its lean."""

    TURN_S = 0.25
    MAX_CLIMB_M_S = 3.0
    SUBSTEP_S = 0.02

    def __init__(self, position: FloatArray, yaw_rad: float = 0.0) -> None:
        """At rest at `position`, (3,) metres NED."""
        self._place, self._velocity = position.astype(float)[None], np.zeros((1, 3))
        self._level, self._now_s, self._yaw_rad = vehicles.Motion(VehicleConfig(), 0, 1), 0.0, yaw_rad

    def __call__(self, demand: Demand, interval_s: float) -> MotionState:
        """Advances it by ``interval_s`` seconds."""
        place, velocity, substeps = self._place, self._velocity, math.ceil(interval_s / self.SUBSTEP_S)
        for _ in range(substeps):
            dt_s = interval_s / substeps
            self._level.step(self._now_s, dt_s, place, velocity, demand.velocity[None])
            vehicles.climb(dt_s, place[:, 2], velocity[:, 2], -np.array([demand.down_m]), self.MAX_CLIMB_M_S)
            self._now_s += dt_s
            turn = wrapped(demand.yaw_rad - self._yaw_rad)
            self._yaw_rad = wrapped(self._yaw_rad + turn * min(1.0, dt_s / self.TURN_S))
        return MotionState(place[0].copy(), velocity[0].copy(), rotation_from_euler(0.0, 0.0, self._yaw_rad))
