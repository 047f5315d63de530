"""What the simulator's autopilots do once they have taken over: land, return to where they began, or hold."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flockd.core.messages import FloatArray
from flockd.sim.scenario import ScenarioConfig

RETURN_M_S = 2.0
_THERE_M = 0.5
_HOLD_PER_S = 0.95
"""Velocity for each metre from where an autopilot holds: PX4's default of MPC_XY_P."""
_HOLD_BRAKING_M_S2 = 3.0
"""It holds where it would stop, braking so hard: PX4's default of MPC_ACC_HOR."""


class Handover:
    """Remembers whose autopilot has taken over: the pilot's commands count no more then."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        self._starts = np.array([vehicle.position_m[:2] for vehicle in scenario.vehicles])
        self._taken: dict[int, str] = {}
        self._held: dict[int, FloatArray] = {}
        """Where, (3,) m NED."""

    @property
    def taken(self) -> frozenset[int]:
        """Whose autopilot has taken over, by its number."""
        return frozenset(self._taken)

    def hold(self, drone: int, position: FloatArray, velocity: FloatArray) -> None:
        """The autopilot of a drone at `position` (3,) m NED, with (3,) m/s, goes into Hold and stays there."""
        self._taken[drone] = "hold"
        self._held[drone] = position + velocity * (math.hypot(*velocity[:2]) / (2 * _HOLD_BRAKING_M_S2))

    def resume(self, drone: int) -> None:
        """Its pilot flies it again."""
        self._taken.pop(drone, None)
        self._held.pop(drone, None)

    def holding(self, positions: FloatArray) -> dict[int, tuple[FloatArray, float]]:
        """Of each drone in Hold the velocity (2,) m/s back to its place, from (n, 3) m NED, and its height, m."""
        return {i: (_HOLD_PER_S * (held - positions[i])[:2], -float(held[2])) for i, held in self._held.items()}

    def applied(
        self, takeovers: Sequence[str | None], positions: FloatArray, velocity: FloatArray, height_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Velocities (n, 2) and heights (n,) of the pilots, with those of the autopilots that land or return.

        `takeovers` are `land`, `return` or None, as of this step; `positions` (n, 3) m NED.
        """
        velocity, height_m = velocity.copy(), height_m.copy()
        for i, takeover in enumerate(takeovers):
            if takeover is not None:
                self._taken.setdefault(i, takeover)
        for i, takeover in self._taken.items():
            if takeover == "hold":
                continue
            way = self._starts[i] - positions[i, :2]
            away_m = math.hypot(*way)
            if takeover == "return" and away_m > _THERE_M:
                velocity[i] = way * (min(RETURN_M_S, away_m) / away_m)
            else:
                self._taken[i] = "land"
                velocity[i], height_m[i] = 0.0, 0.0
        return velocity, height_m
