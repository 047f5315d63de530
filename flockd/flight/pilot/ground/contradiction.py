"""Whether ranges to the ground contradict the barometer's height, themselves, or the way flown.

The height less the range is the ground's height, which each range says to lie between two bounds. On the way they move
apart by the ground's greatest slope, and with time by the barometer's drift; a new range brings them together. What is
beyond them by more than a step of the ground is not the ground: a range of the landing gear, of a cable in the beam, or
one that jumps. Which of the two is wrong two sensors cannot tell: it is taken to be the range finder, since the
autopilot flies by the height. Ground that rises as fast as the drone climbs looks to both as a range that is stuck
does. Readings that are the same to the last bit tell, and else the way flown by the images, whose scale is the range:
it is off by the same factor.
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
"""For which a range that was doubted has to agree with itself before it is believed again."""
REPEATED = 8
"""Readings: of noise of 1 cm, in whole centimetres, so many in a row are the same once in ten thousand."""


@dataclass(frozen=True, eq=False)
class GroundPoint:
    """Where a range hit the ground."""

    time_s: float
    reading_s: float
    """When the range was measured: a reading may be there for several steps."""
    place: FloatArray
    """(2,) metres north and east, of a fixed origin: the drone's, as where its tilt turns the beam is no way flown."""
    range_m: float
    """As it was measured, slant."""
    height_m: float
    """The barometer's, of the drone."""
    ground_m: float
    """The ground's height there, above the zero of the barometer's."""


class ContradictionMonitor:
    """Monitors one range finder. Call `update` for each reading, and `see_way` where images show the way, too."""

    def __init__(self, parameters: RangeFinderParameters) -> None:
        self._parameters = parameters
        self.why: str | None = None
        """The range finder is doubted; None: it is believed."""
        self._before_m = 0.0
        """The ground's height before it was doubted."""
        self._same: GroundPoint | None = None
        """The first of the readings that are the same to the last bit, ..."""
        self._times = 0
        """... and how many they are."""
        self._reading_s = -math.inf
        """When the newest of them was measured."""
        self.forget()

    def forget(self) -> None:
        """What follows cannot be compared with what was; a doubt remains."""
        self._first: GroundPoint | None = None
        """Of the readings that agree with each other, since it was doubted."""
        self._newest: GroundPoint | None = None
        self._bounds_m = np.array([-math.inf, math.inf])
        """By those readings, of the ground's height below the drone at the newest one."""
        self._way = np.zeros(3)
        """Fading sums of the squared way by the autopilot, and of the images' ways along it."""

    def doubt(self, why: str) -> None:
        """From now on the range finder is not believed, before its next readings agree with each other."""
        if self.why is None:
            self._before_m = 0.0 if self._newest is None else float(self._bounds_m.mean())
        self.why, self._first = why, None

    def see_repetition(self, point: GroundPoint) -> None:
        """Whether a sensor that works would have said something else by now."""
        if self._same is None or point.range_m != self._same.range_m:
            self._same, self._times = point, 0
        self._times += point.reading_s != self._reading_s  # not the same one again
        self._reading_s = point.reading_s
        climbed_m = abs(point.height_m - self._same.height_m)
        if climbed_m >= RANGE_REPEATED.limit and self._times >= REPEATED:
            self.doubt("the range stays the same while the height changes")

    def see_way(self, elapsed_s: float, flown: FloatArray, by_images: FloatArray) -> None:
        """Whether the way by the images contradicts the autopilot's in the range's scale, and less in the barometer's.

        Args:
            elapsed_s: in the step.
            flown: (3,) metres NED by the autopilot.
            by_images: (2, 3) likewise by the images, in the range finder's scale and in the barometer's.
        """
        kept = math.exp(-elapsed_s / self._parameters.compare_s)
        self._way = kept * self._way + np.array([flown @ flown, *(by_images @ flown)])
        square, *along = self._way.tolist()
        if not square > 0.0:
            return
        of_velocity = ERROR_M_S * math.sqrt(2.0 * ERROR_LASTS_S * elapsed_s / square)  # of a Gauss-Markov error's mean
        off, off_by_barometer = (abs(one / square - 1.0) for one in along)
        if off > RANGE_VISION.limit * math.hypot(SCALE, of_velocity) and off_by_barometer < off:
            self.doubt("the range contradicts the way flown")

    def update(self, point: GroundPoint, home: FloatArray | None) -> str | None:
        """Why the newest reading is not to be used; None: it is.

        Args:
            point: where it hit the ground.
            home: (2,) where the ground's height is zero, as points' places; None: not known. Counts while nothing else
                is known.
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
        """Its readings agree with each other, and with the ground as it was before; or they change as the height does.

        What is stuck or blocked does not change.
        """
        if newest.time_s - first.time_s < PROBATION_S:
            return False
        off_m = abs(float(self._bounds_m.mean()) - self._before_m)
        followed_m = abs(newest.range_m - first.range_m)
        return bool(off_m <= self._parameters.tolerance_m or followed_m >= self._parameters.tolerance_m)
