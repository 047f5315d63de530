"""The weave: twelve seconds up and down, from which a drone learns how large the others are (`size_learner`).

The flocking law is horizontal, so neighbours do not follow. One drone weaves at a time: if two rise together, no
bearing shifts.
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
"""Amplitude of the commanded height; the drone moves by about 0.34 m."""
PERIOD_S, DURATION_S = 6.0, 12.0
"""Period of the sine, and duration of a weave."""
_DRAWN_WITHIN_S = 8.0
"""The start is drawn from an interval of this length, so that not all drones weave at once; if the drone may not weave
then, it is drawn again from half of it."""
_CLIMB_M_S = 0.2
"""A neighbour with a higher vertical speed is weaving; the drone waits until half a period after it."""
_ROOM_M = 0.5
"""Largest distance from the mission's height at the start, and margin to the gate's height limits: the lower one is
near the ground."""
_ABOVE_GROUND_M = 2.0
"""Least height above the ground at the start; the ground may be higher than at home."""


class Weave:
    """Decides when one drone weaves, and at which height."""

    def __init__(self, gate: GateParameters, own: bytes) -> None:
        """``own``: bytes that no two drones share, so that they draw different times."""
        self._gate = gate
        self._random = np.random.default_rng(zlib.crc32(own))
        self._next_s: float | None = None
        self._climbed_s = -math.inf
        """When a neighbour last rose or sank."""
        self._began_s: float | None = None
        self._base_m: float | None = None
        """Height at which the newest weave began; the drone stays at it if the mission gives no height."""
        self._wanted_m: float | None = None
        """The mission's height when it began: a flock changes its height together, so the weave then ends."""

    @property
    def moves(self) -> bool:
        """Whether the drone weaves now."""
        return self._began_s is not None

    def is_over(self, time_s: float) -> bool:
        """Whether the current weave has lasted its full duration."""
        return self._began_s is not None and time_s - self._began_s >= DURATION_S

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
        """The height to command instead of the mission's, `wanted_m`; None: the height at which the flight began.

        The drone is at `height_m` above home. `needed`: there is something to learn, and nothing forbids it.
        """
        if any(one.confirmed and abs(one.velocity[2]) > _CLIMB_M_S for one in neighbours):
            self._climbed_s = time_s
        if self._began_s is None:
            begin_m = height_m if wanted_m is None else wanted_m
            if needed and self._begins(time_s, height_m, above_ground_m, begin_m, neighbours):
                self._began_s, self._base_m, self._wanted_m = time_s, height_m, wanted_m
        elif not needed or wanted_m != self._wanted_m or self.is_over(time_s):
            self._began_s, self._next_s = None, time_s + _DRAWN_WITHIN_S  # others first
        base_m = self._base_m if wanted_m is None else wanted_m
        if self._began_s is None or base_m is None:
            return base_m
        return base_m + _ASKED_M * math.sin(2 * math.pi * (time_s - self._began_s) / PERIOD_S)

    def _begins(
        self, time_s: float, height_m: float, above_ground_m: float, base_m: float, neighbours: Sequence[Neighbour]
    ) -> bool:
        if self._next_s is None:
            self._next_s = time_s + self._random.uniform(0.0, _DRAWN_WITHIN_S)
        if time_s < self._next_s:
            return False
        self._next_s = time_s + self._random.uniform(0.0, _DRAWN_WITHIN_S / 2)
        room_m = min(base_m - self._gate.min_height_m, self._gate.max_height_m - base_m)
        seen = [one for one in neighbours if one.confirmed]
        column_m = COLUMN * self._gate.degraded_separation_m
        return (
            above_ground_m >= _ABOVE_GROUND_M
            and abs(height_m - base_m) <= _ROOM_M
            and room_m >= _ASKED_M + _ROOM_M
            and time_s - self._climbed_s >= PERIOD_S / 2
            and bool(seen)
            and all(math.hypot(*one.position[:2]) >= column_m for one in seen)
        )
