"""What the simulator's autopilots do once a mission is over: land where they are, or return to where they began."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flockd.core.config.scenario import ScenarioConfig
from flockd.core.messages import FloatArray

RETURN_M_S = 2.0
_THERE_M = 0.5


class Handover:
    """Remembers whose autopilot has taken over: the pilot's commands count no more then."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        self._starts = np.array([vehicle.position_m[:2] for vehicle in scenario.vehicles])
        self._taken: dict[int, str] = {}

    @property
    def taken(self) -> frozenset[int]:
        """Whose autopilot has taken over, by its number."""
        return frozenset(self._taken)

    def applied(
        self, takeovers: Sequence[str | None], positions: FloatArray, velocity: FloatArray, height_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Velocities (n, 2) and heights (n,) of the pilots, with those of the autopilots that have taken over.

        `takeovers` are `land`, `return` or None, as of this step; `positions` (n, 3) m NED.
        """
        velocity, height_m = velocity.copy(), height_m.copy()
        for i, takeover in enumerate(takeovers):
            if takeover is not None:
                self._taken.setdefault(i, takeover)
        for i, takeover in self._taken.items():
            way = self._starts[i] - positions[i, :2]
            away_m = math.hypot(*way)
            if takeover == "return" and away_m > _THERE_M:
                velocity[i] = way * (min(RETURN_M_S, away_m) / away_m)
            else:
                self._taken[i] = "land"
                velocity[i], height_m[i] = 0.0, 0.0
        return velocity, height_m
