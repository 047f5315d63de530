"""The vehicle under the fake autopilot: a point mass, or whatever else moves to a demand."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flockd.core.angles import wrapped
from flockd.core.messages import FloatArray
from flockd.flight.geometry.level import limit_norm


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


class DeadTime:
    """A demand's velocity as it was when the vehicle begins to answer it."""

    PX4_S = 0.2

    def __init__(self) -> None:
        self._now_s = 0.0
        self._waiting: deque[tuple[float, FloatArray]] = deque()
        self._obeyed = np.zeros(2)

    def __call__(self, velocity: FloatArray, interval_s: float) -> FloatArray:
        """(2,) m/s, from the one of now and the time since the last."""
        self._waiting.append((self._now_s + self.PX4_S, velocity))
        self._now_s += interval_s
        while self._waiting and self._waiting[0][0] <= self._now_s:
            self._obeyed = self._waiting.popleft()[1]
        return self._obeyed


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
    """Follows a demand as PX4's vehicle in software does, but always level.

    The level velocity answers after a dead time, as a first-order lag of limited acceleration and jerk. The numbers are
    a fit to PX4 1.18's answers to steps of up to 4 m/s (tests/sim/autopilot/px4_steps.csv).
    """

    RESPONSE_S = 0.39
    MAX_ACCELERATION_M_S2 = 7.0
    MAX_JERK_M_S3 = 19.0
    CLIMB_RESPONSE_S = 0.25
    MAX_CLIMB_M_S = 3.0
    SUBSTEP_S = 0.02

    def __init__(self, position: FloatArray, yaw_rad: float = 0.0) -> None:
        """At rest at `position`, (3,) metres NED."""
        self._position = position.astype(float)
        self._velocity, self._acceleration = np.zeros(3), np.zeros(2)
        self._yaw_rad = yaw_rad
        self._dead_time = DeadTime()

    def __call__(self, demand: Demand, interval_s: float) -> MotionState:
        """Advances it by ``interval_s`` seconds."""
        substeps = math.ceil(interval_s / self.SUBSTEP_S)
        for _ in range(substeps):
            self._step(demand, interval_s / substeps)
        cos, sin = math.cos(self._yaw_rad), math.sin(self._yaw_rad)
        R_ned_body = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return MotionState(self._position, self._velocity, R_ned_body)

    def _step(self, demand: Demand, dt: float) -> None:
        velocity = self._velocity[:2]
        wanted = limit_norm(
            (self._dead_time(demand.velocity, dt) - velocity) / self.RESPONSE_S, self.MAX_ACCELERATION_M_S2
        )
        self._acceleration = self._acceleration + limit_norm(wanted - self._acceleration, self.MAX_JERK_M_S3 * dt)
        climb = np.clip(demand.down_m - self._position[2], -self.MAX_CLIMB_M_S, self.MAX_CLIMB_M_S)
        lift = (climb - self._velocity[2]) / self.CLIMB_RESPONSE_S
        self._velocity = self._velocity + np.array([*self._acceleration, lift]) * dt
        self._position = self._position + self._velocity * dt
        if self._position[2] >= 0.0:
            self._position[2], self._velocity[2] = 0.0, min(0.0, self._velocity[2])
        turn = wrapped(demand.yaw_rad - self._yaw_rad)
        self._yaw_rad = wrapped(self._yaw_rad + turn * min(1.0, dt / self.CLIMB_RESPONSE_S))
