"""The vehicle of the fake autopilot, and the sticks of its pilot."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry import rotation_from_euler
from flockd.sim.scenario import StartConfig, VehicleConfig
from flockd.sim.vehicles.vehicles import Vehicles


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
    """A setpoint."""

    velocity: FloatArray
    """(2,) m/s, north and east."""
    sink_m_s: float
    yaw_rad: float


@dataclass(frozen=True, eq=False)
class MotionState:
    """The true state of the vehicle, NED with the ground at 0."""

    position: FloatArray
    """(3,) metres."""
    velocity: FloatArray
    """(3,) m/s."""
    R_ned_body: FloatArray
    """(3, 3)"""


Motion = Callable[[Demand, float], MotionState]
"""Advances the vehicle towards a demand by some seconds."""


class Flown:
    """One of the simulator's vehicles, which follows a demand as PX4's vehicle in software does."""

    def __init__(
        self,
        position: FloatArray,
        yaw_rad: float = 0.0,
        *,
        config: VehicleConfig | None = None,
        seed: int = 0,
        leans: bool = False,
    ) -> None:
        """Begins at rest at `position`, (3,) metres NED; without `leans` it stays level."""
        start = StartConfig(position_m=(float(position[0]), float(position[1]), float(position[2])))
        self._vehicles = Vehicles([start], config or VehicleConfig(), yaw_rad=yaw_rad, seed=seed)
        self._leans = leans

    def __call__(self, demand: Demand, interval_s: float) -> MotionState:
        """Advances it by ``interval_s`` seconds."""
        vehicles = self._vehicles
        if interval_s > 0.0:
            heading = np.array([demand.yaw_rad])
            vehicles.step(demand.velocity[None], heading, interval_s, heights=np.array([-demand.down_m]))
        R = vehicles.R_ned_body[0]
        if not self._leans:
            R = rotation_from_euler(0.0, 0.0, math.atan2(R[1, 0], R[0, 0]))
        return MotionState(vehicles.position[0], vehicles.velocity[0], R)


STICK_EXPO = 0.6
"""How much of a stick's curve is cubic, as PX4 1.18 has it and MPC_XY_MAN_EXPO before: slow near the middle."""
OVERRIDE_FILTER_S, OVERRIDE_SAMPLES = 0.05, 3
"""Time constant of the low pass on the sticks' speed, and in how many positions in a row the speed has one sign."""


def stick_curve(sticks: FloatArray, deadzone: float = 0.0) -> FloatArray:
    """The share of the full speed, -1 to 1, that sticks at -1 to 1 ask for in Position mode."""
    moved = np.sign(sticks) * np.maximum(np.abs(sticks) - deadzone, 0.0) / (1.0 - deadzone)
    curved: FloatArray = (1.0 - STICK_EXPO) * moved + STICK_EXPO * moved**3
    return curved


class StickOverride:
    """Whether sticks move fast enough for the pilot to take over, by PX4 1.18's rule for MAN_OVERRIDE_SPD.

    The low-passed speed of a stick is above the threshold, and it has moved the same way several times on end.
    """

    def __init__(self) -> None:
        self._last: tuple[float, FloatArray] | None = None
        self._speed, self._sign, self._same = np.zeros(2), np.zeros(2), np.zeros(2)

    def moved(self, now_s: float, sticks: FloatArray, threshold: float) -> bool:
        """Takes a new position of the sticks (2,), -1 to 1. ``threshold``: travel a second; negative: they never do."""
        last, self._last = self._last, (now_s, sticks)
        if last is None or now_s <= last[0]:
            return False
        interval_s = now_s - last[0]
        speed = (sticks - last[1]) / interval_s
        self._speed = self._speed + interval_s / (OVERRIDE_FILTER_S + interval_s) * (speed - self._speed)
        sign = np.sign(speed)
        counted = np.where(sign == self._sign, self._same + 1, 1)
        self._same, self._sign = np.where(sign == 0, self._same, counted), np.where(sign == 0, self._sign, sign)
        fast = (np.abs(self._speed) > threshold) & (self._same >= OVERRIDE_SAMPLES)
        return threshold >= 0.0 and bool(fast.any())
