"""The vehicle under the fake autopilot: a point mass, or whatever else moves to a demand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flockd.core.angles import wrapped
from flockd.core.messages import FloatArray
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

    CLIMB_RESPONSE_S = 0.25
    MAX_CLIMB_M_S = 3.0
    SUBSTEP_S = 0.02

    def __init__(self, position: FloatArray, yaw_rad: float = 0.0) -> None:
        """At rest at `position`, (3,) metres NED."""
        self._place, self._velocity = position.astype(float)[None], np.zeros((1, 3))
        self._level, self._now_s, self._yaw_rad = vehicles.Motion(VehicleConfig(), [0], 1), 0.0, yaw_rad

    def __call__(self, demand: Demand, interval_s: float) -> MotionState:
        """Advances it by ``interval_s`` seconds."""
        substeps = math.ceil(interval_s / self.SUBSTEP_S)
        for _ in range(substeps):
            self._step(demand, interval_s / substeps)
        R_ned_body = rotation_from_euler(0.0, 0.0, self._yaw_rad)
        return MotionState(self._place[0].copy(), self._velocity[0].copy(), R_ned_body)

    def _step(self, demand: Demand, dt: float) -> None:
        self._level.step(self._now_s, dt, self._place, self._velocity, demand.velocity[None])
        self._now_s += dt
        place, velocity = self._place[0], self._velocity[0]
        climb = np.clip(demand.down_m - place[2], -self.MAX_CLIMB_M_S, self.MAX_CLIMB_M_S)
        velocity[2] += (climb - velocity[2]) / self.CLIMB_RESPONSE_S * dt
        place[2] += velocity[2] * dt
        if place[2] >= 0.0:
            place[2], velocity[2] = 0.0, min(0.0, velocity[2])
        turn = wrapped(demand.yaw_rad - self._yaw_rad)
        self._yaw_rad = wrapped(self._yaw_rad + turn * min(1.0, dt / self.CLIMB_RESPONSE_S))
