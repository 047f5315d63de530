"""The weave: twelve seconds up and down, from which a drone learns how large the others are (`size_learner`).

The flocking law is level, so that nobody follows. One drone weaves at a time: of two that rise together no bearing
shifts.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.messages import Neighbour
from flockd.flight.safety.approach import COLUMN

_ASKED_M = 0.43
"""The drone asks for heights this much above and below its own, which moves it by about 0.34 m, ..."""
PERIOD_S, DURATION_S = 6.0, 12.0
"""... in a sine of this period, for so long."""
_SETTLES_S = 3.0
"""So long afterwards it asks for the height where it began, to be there again."""
_DRAWN_WITHIN_S = 8.0
"""It begins at a time drawn from so many seconds, for not all to weave at once."""
_CLIMB_M_S = 0.2
"""A neighbour that rises or sinks faster, or did so in the last half period, is weaving, and the drone waits."""
_AGAIN_S = (1.0, 4.0)
"""Where it may not begin it tries again after so long."""
_STEADY_S = 6.0
"""For so long the mission's height has to have been the same: a flock changes its height together."""
_AT_HEIGHT_M = 0.5
"""From the mission's height the drone is no farther off when it begins."""
_ABOVE_LOWEST_M = 0.5
"""It stays so far within the heights that the gate allows: the lowest is near the ground."""
_ABOVE_GROUND_M = 2.0
"""Nor does it begin lower above the ground, which may be higher than at home."""


class Weave:
    """When one drone moves up and down, and how."""

    def __init__(self, gate: GateParameters, own: bytes) -> None:
        """``own``: what no two drones have in common, so that they draw other times."""
        self._gate = gate
        self._random = np.random.default_rng(zlib.crc32(own))
        self._next_s: float | None = None
        self._climbed_s = -math.inf
        """When a neighbour last rose or sank."""
        self._began_s: float | None = None
        self._ended_s: float | None = None
        self._base_m = 0.0
        self._wanted_m: float | None = None
        self._steady_since_s: float | None = None

    @property
    def moves(self) -> bool:
        """Whether it moves the drone up and down."""
        return self._began_s is not None and self._ended_s is None

    def is_over(self, time_s: float) -> bool:
        """Whether it has moved the drone for as long as it should."""
        return self._began_s is not None and self._ended_s is None and time_s - self._began_s >= DURATION_S

    def height(
        self,
        time_s: float,
        height_m: float,
        above_ground_m: float,
        wanted_m: float | None,
        neighbours: Sequence[Neighbour],
        *,
        needed: bool,
    ) -> float | None:
        """The height to ask for instead of the mission's, `wanted_m`; None: the one that the flight began at.

        The drone is at `height_m` above home. `needed`: there is something to learn, and nothing that forbids it.
        """
        if any(one.confirmed and abs(one.velocity[2]) > _CLIMB_M_S for one in neighbours):
            self._climbed_s = time_s
        if self._steady_since_s is None:  # a flight begins at its height
            self._wanted_m, self._steady_since_s = wanted_m, time_s - _STEADY_S
        elif wanted_m != self._wanted_m:
            self._wanted_m, self._steady_since_s = wanted_m, time_s
        if self._began_s is None:
            if not needed or not self._begins(time_s, height_m, above_ground_m, neighbours):
                return wanted_m
            self._began_s, self._base_m = time_s, height_m
        elif self._ended_s is None and (not needed or self._steady_since_s > self._began_s or self.is_over(time_s)):
            self._ended_s = time_s
        base_m = self._base_m if wanted_m is None else wanted_m
        if self._ended_s is None:
            return base_m + _ASKED_M * math.sin(2 * math.pi * (time_s - self._began_s) / PERIOD_S)
        if time_s - self._ended_s >= _SETTLES_S:
            self._began_s = self._ended_s = self._next_s = None
            return wanted_m
        return base_m

    def _begins(self, time_s: float, height_m: float, above_ground_m: float, neighbours: Sequence[Neighbour]) -> bool:
        if self._next_s is None:
            self._next_s = time_s + self._random.uniform(0.0, _DRAWN_WITHIN_S)
        if time_s < self._next_s:
            return False
        may = above_ground_m >= _ABOVE_GROUND_M and self._may_begin(time_s, height_m, neighbours)
        if not may:
            self._next_s = time_s + self._random.uniform(*_AGAIN_S)
        return may

    def _may_begin(self, time_s: float, height_m: float, neighbours: Sequence[Neighbour]) -> bool:
        assert self._steady_since_s is not None
        base_m = height_m if self._wanted_m is None else self._wanted_m
        room_m = min(base_m - self._gate.min_height_m, self._gate.max_height_m - base_m)
        seen = [one for one in neighbours if one.confirmed]
        column_m = COLUMN * self._gate.degraded_separation_m
        return (
            time_s - self._steady_since_s >= _STEADY_S
            and abs(height_m - base_m) <= _AT_HEIGHT_M
            and room_m >= _ASKED_M + _ABOVE_LOWEST_M
            and time_s - self._climbed_s >= PERIOD_S / 2
            and bool(seen)
            and all(math.hypot(*one.position[:2]) >= column_m for one in seen)
        )
