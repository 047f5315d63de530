"""Detects ranges to the ground that contradict the barometer, each other, or the distance flown.

The drone's height minus the range is the ground's height. Each range puts it between two bounds. The bounds widen with
the distance flown, by the steepest slope of the ground, and with time, by the barometer's drift; each new range narrows
them. A reading outside them by more than a step of the ground is not of the ground: the beam hit the landing gear or a
cable, or the range jumped. Two sensors cannot show which of them is wrong. The range finder is blamed, since the
autopilot flies by the barometer. Ground that rises as fast as the drone climbs looks like a range that is stuck. Two
tests tell them apart: whether readings are equal to the last bit, and whether the distance flown by the images, whose
scale comes from the range, is wrong by the same factor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flockd.core.config.perception import RangeFinderParameters
from flockd.core.consistency import RANGE_REPEATED, RANGE_VISION
from flockd.core.messages import FloatArray
from flockd.flight.pilot.own_motion import ERROR_LASTS_S, ERROR_M_S, SCALE

PROBATION_S = 3.0
"""Time for which a blamed range finder has to agree with itself before it is used again."""


@dataclass(frozen=True, eq=False)
class GroundPoint:
    """A point of the ground that a range finder measured."""

    time_s: float
    place: FloatArray
    """(2,) metres north and east of a fixed origin: the drone's place. The beam's also moves with its tilt."""
    range_m: float
    """Slant range, as measured."""
    height_m: float
    """Height of the drone by the barometer."""
    ground_m: float
    """Height of the ground at this point, above the barometer's zero."""


class ContradictionMonitor:
    """Monitors one range finder. Call `update` for each reading, and `see_way` if images show the displacement."""

    def __init__(self, parameters: RangeFinderParameters) -> None:
        self._parameters = parameters
        self.why: str | None = None
        """Why the range finder is not used; None: it is."""
        self._before_m = 0.0
        """Height of the ground before the range finder was blamed."""
        self._same: GroundPoint | None = None
        """The first of the readings that are equal to the last bit."""
        self.forget()

    def forget(self) -> None:
        """Drops earlier readings, with which later ones cannot be compared. Blame remains."""
        self._first: GroundPoint | None = None
        """The first reading, since the range finder was blamed, that agrees with those after it."""
        self._newest: GroundPoint | None = None
        self._bounds_m = np.array([-math.inf, math.inf])
        """(2,) bounds of the ground's height below the drone at the newest reading."""
        self._way = np.zeros(3)
        """(3,) fading sums: squared displacement by the autopilot, and the images' displacements along it."""

    def doubt(self, why: str) -> None:
        """Blames the range finder; it is not used until its next readings agree with each other."""
        if self.why is None:
            self._before_m = 0.0 if self._newest is None else float(self._bounds_m.mean())
        self.why, self._first = why, None

    def see_repetition(self, point: GroundPoint) -> None:
        """Blames the range finder if its readings stay equal while the height changes."""
        if self._same is None or point.range_m != self._same.range_m:
            self._same = point
        elif abs(point.ground_m - self._same.ground_m) >= RANGE_REPEATED.limit:  # as of each reading's own time
            self.doubt("the range stays the same while the height changes")

    def see_way(self, elapsed_s: float, flown: FloatArray, by_images: FloatArray) -> None:
        """Blames the range finder if images contradict the autopilot in its scale more than in the barometer's.

        Args:
            elapsed_s: duration of the step.
            flown: (3,) displacement by the autopilot, metres NED.
            by_images: (2, 3) displacement by the images, in the range finder's scale and in the barometer's.
        """
        kept = math.exp(-elapsed_s / self._parameters.compare_s)
        self._way = kept * self._way + np.array([flown @ flown, *(by_images @ flown)])
        square, *along = self._way.tolist()
        if not square > 0.0:
            return
        of_velocity = ERROR_M_S * math.sqrt(2.0 * ERROR_LASTS_S * elapsed_s / square)  # mean of a Gauss-Markov error
        off, off_by_barometer = (abs(one / square - 1.0) for one in along)
        if off > RANGE_VISION.limit * math.hypot(SCALE, of_velocity) and off_by_barometer < off:
            self.doubt("the range contradicts the way flown")

    def update(self, point: GroundPoint, home: FloatArray | None) -> str | None:
        """Takes a reading. Returns why it may not be used; None: it may.

        Args:
            point: where the range hit the ground.
            home: (2,) place at which the ground's height is zero, as `GroundPoint.place`; None: not known. Only used
                for the first reading.
        """
        p = self._parameters
        if self._newest is not None:
            drifted_m = p.tolerance_m * (point.time_s - self._newest.time_s) / p.compare_s
            self._widen(p.max_slope * math.dist(point.place, self._newest.place) + drifted_m)
        elif home is not None and self.why is None:
            self._bounds_m = np.zeros(2)
            self._widen(p.max_slope * math.dist(point.place, home))
        said_m = point.ground_m + p.gate_sigma * p.noise / 2.0 * point.range_m * np.array([-1.0, 1.0])
        if max(self._bounds_m[0] - said_m[1], said_m[0] - self._bounds_m[1]) > p.tolerance_m:
            self.doubt(self.why or "the range contradicts the barometer")
            self.forget()
        self._first, self._newest = self._first or point, point
        self._bounds_m = np.array([max(self._bounds_m[0], said_m[0]), min(self._bounds_m[1], said_m[1])])
        if self.why is not None and self._is_rehabilitated(self._first, point):
            self.why = None
        return self.why

    def _widen(self, by_m: float) -> None:
        self._bounds_m = self._bounds_m + np.array([-by_m, by_m])

    def _is_rehabilitated(self, first: GroundPoint, newest: GroundPoint) -> bool:
        """Whether readings agree with each other and with the ground as it was before, or else follow the height.

        A range that is stuck or blocked does not follow it.
        """
        if newest.time_s - first.time_s < PROBATION_S:
            return False
        off_m = abs(float(self._bounds_m.mean()) - self._before_m)
        followed_m = abs(newest.range_m - first.range_m)
        return bool(off_m <= self._parameters.tolerance_m or followed_m >= self._parameters.tolerance_m)
