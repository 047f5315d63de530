"""Whether ranges to the ground contradict the barometer's height: a sensor that is stuck, blocked, or has jumped.

The height less the range is the ground's height. Between two places it changes by the ground's slope at most, by a
step, and by the barometer's drift, which is slow. A range that stays the same while the drone climbs, one of the
landing gear or of a cable in the beam, and one that jumps make ground that rises more than that. Which of the two is
wrong two sensors cannot tell: it is taken to be the range finder, since the autopilot flies by the height.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from flockd.core.config.perception import RangeFinderParameters
from flockd.core.consistency import RANGE_REPEATED
from flockd.core.messages import FloatArray

BY_BAROMETER = "the range contradicts the barometer"
DOUBTED_AFTER = 2
"""Contradictions in a row: one alone may be a bird, or another drone below."""
PROBATION_S = 3.0
"""For which a range that was doubted has to agree before it is believed again: ..."""
FOLLOWED_M = 1.0
"""... with the ground as it was before; or with the height and itself, while it changes by this much. What is stuck or
blocked does not change."""


REPEATED = 8
"""Readings: of noise of 1 cm, in whole centimetres, so many in a row are the same once in ten thousand."""


@dataclass(frozen=True, eq=False)
class GroundPoint:
    """Where a range hit the ground."""

    time_s: float
    place: FloatArray
    """(2,) metres north and east, of a fixed origin."""
    ground_m: float
    """The ground's height there, above the zero of the barometer's."""
    range_m: float
    """As it was measured, slant."""


class RepetitionMonitor:
    """Notices readings that are the same to the last bit while the height changes. Call `update` for each step."""

    def __init__(self, compare_s: float) -> None:
        self._compare_s = compare_s
        self._same: deque[tuple[GroundPoint, float]] = deque()
        """Of the last seconds, those that are the same, each with the height then."""
        self._reading_s = -np.inf
        self._count = 0

    def forget(self) -> None:
        """What follows cannot be compared with what was."""
        self._same.clear()

    def update(self, point: GroundPoint, reading_s: float, height_m: float) -> GroundPoint | None:
        """The first of the same readings, where a sensor that works would have said something else by now."""
        if not self._same or point.range_m != self._same[0][0].range_m:
            self._same.clear()
            self._count = 0
        self._count += reading_s != self._reading_s  # not the same one again
        self._reading_s = reading_s
        self._same.append((point, height_m))
        while point.time_s - self._same[0][0].time_s > self._compare_s:
            self._same.popleft()
        heights_m = [height for _, height in self._same]
        climbed = max(heights_m) - min(heights_m) >= RANGE_REPEATED.limit
        return self._same[0][0] if climbed and self._count >= REPEATED else None


class ContradictionMonitor:
    """Monitors one range finder. Call `update` once for each reading."""

    def __init__(self, parameters: RangeFinderParameters) -> None:
        self._parameters = parameters
        self._agreed: deque[GroundPoint] = deque()
        """Those of the last `compare_s` while it is believed."""
        self._on_probation: list[GroundPoint] | None = None
        """Since it was doubted, from the last contradiction on; None: it is believed."""
        self._ground_before_m = 0.0
        self._contradictions = 0
        self.why = BY_BAROMETER
        """It is doubted, or the last reading was not used."""

    @property
    def doubted(self) -> bool:
        """It is not believed, however well a single reading fits."""
        return self._on_probation is not None

    def doubt(self, point: GroundPoint, ground_before_m: float, why: str) -> None:
        """From now on its range finder is doubted: another check than this one says so."""
        if self._on_probation is None:
            self._ground_before_m = ground_before_m
        self._on_probation, self.why = [point], why
        self._agreed.clear()
        self._contradictions = 0

    def forget(self) -> None:
        """What follows cannot be compared with what was; a doubt remains."""
        self._agreed.clear()
        self._contradictions = 0
        if self._on_probation is not None:
            self._on_probation = []

    def update(self, point: GroundPoint, home: FloatArray | None) -> bool:
        """Whether a reading contradicts what is known, or its range finder is doubted: it is not to be used.

        Args:
            point: the newest.
            home: (2,) where the ground's height is zero, as the places of points; None: not known. Counts while nothing
                else is known.
        """
        if self._on_probation is not None:
            self._on_probation = self._continued(self._on_probation, point)
            if not self._is_rehabilitated(self._on_probation):
                return True
            self._agreed.extend(self._on_probation[:-1])
            self._on_probation, self.why = None, BY_BAROMETER
        while self._agreed and point.time_s - self._agreed[0].time_s > self._parameters.compare_s:
            self._agreed.popleft()
        known = list(self._agreed)
        if not known and home is not None:
            known = [GroundPoint(point.time_s, home, 0.0, 0.0)]
        if not any(self._contradict(one, point) for one in known):
            self._contradictions = 0
            self._agreed.append(point)
            return False
        self._contradictions += 1
        if self._contradictions >= DOUBTED_AFTER:
            self._ground_before_m = known[0].ground_m
            self._on_probation = [point]
            self._agreed.clear()
            self._contradictions = 0
        return True

    def _contradict(self, one: GroundPoint, other: GroundPoint) -> bool:
        p = self._parameters
        of_ranges_m = p.gate_sigma * p.noise * max(one.range_m, other.range_m)
        rise_m = p.max_slope * float(np.hypot(*(one.place - other.place)))
        return not abs(one.ground_m - other.ground_m) <= p.tolerance_m + of_ranges_m + rise_m

    def _continued(self, before: list[GroundPoint], point: GroundPoint) -> list[GroundPoint]:
        """With one more, which is alone where it contradicts those before."""
        recent = [one for one in before if point.time_s - one.time_s <= self._parameters.compare_s]
        return [point] if any(self._contradict(one, point) for one in recent) else [*recent, point]

    def _is_rehabilitated(self, points: list[GroundPoint]) -> bool:
        newest = points[-1]
        if newest.time_s - points[0].time_s < PROBATION_S:
            return False
        ranges_m = [one.range_m for one in points]
        if max(ranges_m) - min(ranges_m) >= FOLLOWED_M:
            return True
        lately = [one for one in points if newest.time_s - one.time_s <= PROBATION_S]
        return all(abs(one.ground_m - self._ground_before_m) <= self._parameters.tolerance_m for one in lately)
