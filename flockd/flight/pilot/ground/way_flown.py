"""The way flown by the images, whose scale is the range to the ground, with the way that the autopilot says it flew.

A range that is off by a factor makes the way by the images off by the same factor. Ground that rises as fast as the
drone climbs looks to range finder and barometer as a range that is stuck does: the way flown tells the two apart.
"""

from __future__ import annotations

import math

import numpy as np

from flockd.core.consistency import RANGE_VISION
from flockd.core.messages import FloatArray
from flockd.flight.pilot.own_motion import ERROR_LASTS_S, ERROR_M_S

LEAST_WAY_M = 5.0
"""A shorter way tells nothing: velocities err by as much as they are."""
IMAGES_SIGMA = 0.05
"""Standard deviation of the images' way, as a share, where the height is right."""


class WayMonitor:
    """Compares over the last seconds, the older the less. Call `update` once for each step with a range."""

    def __init__(self, compare_s: float) -> None:
        self._compare_s = compare_s
        self.forget()

    def forget(self) -> None:
        """What follows cannot be compared with what was."""
        self._sums = np.zeros(5)

    def update(self, elapsed_s: float, flown: FloatArray, by_range: FloatArray, by_barometer: FloatArray) -> bool:
        """Whether the range finder's scale contradicts the way flown, and the barometer's does so less.

        Args:
            elapsed_s: in the step.
            flown: (3,) metres NED by the autopilot.
            by_range: likewise by the images, in the range finder's scale.
            by_barometer: likewise, in the barometer's.
        """
        square = float(flown @ flown)
        step = [elapsed_s, math.sqrt(square), square, float(by_range @ flown), float(by_barometer @ flown)]
        self._sums = math.exp(-elapsed_s / self._compare_s) * self._sums + step
        seconds, way_m, square, along, along_by_barometer = self._sums.tolist()
        if not way_m >= LEAST_WAY_M:
            return False
        alone_s = seconds + ERROR_LASTS_S * math.expm1(-seconds / ERROR_LASTS_S)  # the integral of a Gauss-Markov error
        sigma = math.hypot(IMAGES_SIGMA, ERROR_M_S * math.sqrt(2.0 * ERROR_LASTS_S * alone_s) / way_m)
        off, off_by_barometer = abs(along / square - 1.0), abs(along_by_barometer / square - 1.0)
        return bool(off > RANGE_VISION.limit * sigma and off_by_barometer < off)
