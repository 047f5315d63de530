"""The weave: twelve seconds up and down, from which a drone learns how large the others are (`tracking.flock_size`).

The flocking law is level, so that nobody follows. One drone at a time shows most: each draws when it begins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.messages import Neighbour
from flockd.flight.safety.gate import COLUMN
from flockd.flight.tracking.weave_path import (
    AMPLITUDE_SIGMA,
    ASKED_M,
    DURATION_S,
    PERIOD_S,
    SETTLES_S,
    asked_lift_m,
    lift_m,
)

_DRAWN_WITHIN_S = 8.0
"""It begins at a time drawn from so many seconds, for not all to weave at once."""
_CLIMB_M_S = 0.2
"""A neighbour that rises or sinks faster is weaving, and the drone waits."""
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
_ASTRAY_M = 0.2
"""A weave that is so far off `lift_m`, over a second, ends: whoever sees it would take the drone for larger."""
_MOST_UNLIKE = 3 * AMPLITUDE_SIGMA
"""So does one that, over its first period, moves the drone by as much more or less than it should, ..."""
_ALIKE = AMPLITUDE_SIGMA
"""... and after two in a row whose shares are so near it weaves no more: its autopilot follows heights otherwise. A
gate that holds it does not hold it twice alike."""


class Weave:
    """When one drone moves up and down, and how."""

    def __init__(self, gate: GateParameters) -> None:
        self._gate = gate
        self._next_s: float | None = None
        self._began_s: float | None = None
        self._base_m = 0.0
        self._astray_m = self._compared_s = 0.0
        """How far the drone is from where a weave leads, over the last second, and when since its beginning."""
        self._lifts_m: list[tuple[float, float]] = []
        """How high it should have been above where the weave began, and how high it was, at each step since."""
        self._unlike: list[float] = []
        """By which share of what they should the weaves moved the drone that were ended for that."""
        self._wanted_m: float | None = None
        self._steady_since_s: float | None = None

    @property
    def given_up(self) -> str | None:
        """Why it weaves no more, for people."""
        if len(self._unlike) < 2 or abs(self._unlike[-1] - self._unlike[-2]) > _ALIKE:
            return None
        return (
            f"weave: the drone rises and sinks by {self._unlike[-1]:.0%} of what it should, and weaves no more; "
            "its autopilot should follow vertical velocities as theirs do"
        )

    @property
    def moves(self) -> bool:
        """Whether it moves the drone, or has just done so."""
        return self._began_s is not None

    def height(
        self,
        time_s: float,
        height_m: float,
        above_ground_m: float,
        wanted_m: float | None,
        neighbours: Sequence[Neighbour],
        random: np.random.Generator,
        *,
        needed: bool,
    ) -> float | None:
        """The height to ask for instead of the mission's, `wanted_m`; None: the one that the flight began at.

        The drone is at `height_m` above home. `needed`: there is something to learn, and nothing that forbids it.
        """
        if self._steady_since_s is None:  # a flight begins at its height
            self._wanted_m, self._steady_since_s = wanted_m, time_s - _STEADY_S
        elif wanted_m != self._wanted_m:
            self._wanted_m, self._steady_since_s = wanted_m, time_s
        needed = needed and self.given_up is None
        if self._began_s is None and not self._begins(time_s, height_m, above_ground_m, neighbours, random, needed):
            return wanted_m
        assert self._began_s is not None
        elapsed_s = time_s - self._began_s
        base_m = self._base_m if wanted_m is None else wanted_m
        may = needed and self._steady_since_s <= self._began_s
        if elapsed_s < DURATION_S and not (may and self._follows(elapsed_s, height_m - base_m)):
            elapsed_s, self._began_s = DURATION_S, time_s - DURATION_S
        if not 0.0 <= elapsed_s < DURATION_S + SETTLES_S:
            self._began_s = self._next_s = None
            return wanted_m
        return base_m + asked_lift_m(elapsed_s)

    def _follows(self, elapsed_s: float, risen_m: float) -> bool:
        """Whether the drone moves as the others take it to, and no gate holds it between two of them."""
        share = -math.expm1(-max(elapsed_s - self._compared_s, 0.0))
        self._astray_m += share * (risen_m - lift_m(elapsed_s) - self._astray_m)
        self._compared_s = elapsed_s
        self._lifts_m.append((lift_m(elapsed_s), risen_m))
        if elapsed_s >= PERIOD_S:
            should_m, was_m = np.array(self._lifts_m).T
            should_m -= should_m.mean()
            share = float(should_m @ was_m / (should_m @ should_m))
            if abs(share - 1.0) > _MOST_UNLIKE:
                self._unlike.append(share)
                return False
        return abs(self._astray_m) <= _ASTRAY_M

    def _begins(
        self,
        time_s: float,
        height_m: float,
        above_ground_m: float,
        neighbours: Sequence[Neighbour],
        random: np.random.Generator,
        needed: bool,
    ) -> bool:
        if not needed:
            self._next_s = None
            return False
        if self._next_s is None:
            self._next_s = time_s + random.uniform(0.0, _DRAWN_WITHIN_S)
        if time_s < self._next_s:
            return False
        if above_ground_m < _ABOVE_GROUND_M or not self._may_begin(time_s, height_m, neighbours):
            self._next_s = time_s + random.uniform(*_AGAIN_S)
            return False
        self._began_s, self._base_m = time_s, height_m
        self._astray_m = self._compared_s = 0.0
        self._lifts_m = []
        return True

    def _may_begin(self, time_s: float, height_m: float, neighbours: Sequence[Neighbour]) -> bool:
        assert self._steady_since_s is not None
        base_m = height_m if self._wanted_m is None else self._wanted_m
        room_m = min(base_m - self._gate.min_height_m, self._gate.max_height_m - base_m)
        return (
            time_s - self._steady_since_s >= _STEADY_S
            and abs(height_m - base_m) <= _AT_HEIGHT_M
            and room_m >= ASKED_M + _ABOVE_LOWEST_M
            and not self._is_near(neighbours)
            and not any(one.confirmed and abs(one.velocity[2]) > _CLIMB_M_S for one in neighbours)
        )

    def _is_near(self, neighbours: Sequence[Neighbour]) -> bool:
        column_m = COLUMN * self._gate.degraded_separation_m
        return any(one.confirmed and math.hypot(*one.position[:2]) < column_m for one in neighbours)
