"""The way flown by the images, whose scale is the range to the ground, with the way that the autopilot says it flew.

A range that is off by a factor makes the way by the images off by the same factor. Ground that rises as fast as the
drone climbs looks to range finder and barometer as a range that is stuck does: the way flown tells the two apart.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from flockd.core.consistency import RANGE_VISION
from flockd.core.messages import FloatArray

LEAST_WAY_M = 5.0
"""A shorter way tells nothing: velocities err by as much as they are."""
VELOCITY_SIGMA_M_S, CORRELATED_S = 0.15, 5.0
"""Standard deviation of an autopilot's velocity, and for how long it errs alike: measured with PX4 in its simulator."""
IMAGES_SIGMA = 0.05
"""Standard deviation of the images' way, as a share, where the height is right."""


class Way(NamedTuple):
    """What a step went."""

    elapsed_s: float
    metres: FloatArray
    """(3,) north, east and down."""


class _Step(NamedTuple):
    time_s: float
    elapsed_s: float
    by_range: float
    """Way by the images times way by the autopilot, m^2, with the range finder's scale, ..."""
    by_barometer: float
    """... and with the barometer's."""
    square: float
    """The autopilot's, squared."""


class WayMonitor:
    """Compares over the last seconds. Call `update` once for each step with a range."""

    def __init__(self, compare_s: float) -> None:
        self._compare_s = compare_s
        self._steps: deque[_Step] = deque()

    def forget(self) -> None:
        """What follows cannot be compared with what was."""
        self._steps.clear()

    def update(self, time_s: float, flown: Way, by_range: FloatArray, by_barometer: FloatArray) -> bool:
        """Whether the range finder's scale contradicts the way flown, and the barometer's does so less.

        Args:
            time_s: of the step's end.
            flown: by the autopilot.
            by_range: (3,) metres by the images, in the range finder's scale.
            by_barometer: (3,) metres likewise, in the barometer's.
        """
        metres = flown.metres
        step = _Step(
            time_s, flown.elapsed_s, float(by_range @ metres), float(by_barometer @ metres), float(metres @ metres)
        )
        self._steps.append(step)
        while time_s - self._steps[0].time_s > self._compare_s:
            self._steps.popleft()
        _, seconds, along, along_by_barometer, square = np.array(self._steps).sum(axis=0)
        way_m = sum(math.sqrt(one.square) for one in self._steps)
        if not way_m >= LEAST_WAY_M:
            return False
        sigma = math.hypot(IMAGES_SIGMA, VELOCITY_SIGMA_M_S * math.sqrt(CORRELATED_S * seconds) / way_m)
        off, off_by_barometer = abs(along / square - 1.0), abs(along_by_barometer / square - 1.0)
        return bool(off > RANGE_VISION.limit * sigma and off_by_barometer < off)
