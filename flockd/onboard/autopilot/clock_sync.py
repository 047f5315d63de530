"""The autopilot's clock against this computer's, from round trips of MAVLink's TIMESYNC; pure, knows no clock.

A round trip bounds the offset between two clocks by half its duration on either side, as the time of each way is not
known. A busy computer only makes the bounds of a round trip wider: the offset lies where the bounds of all overlap.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from flockd.core import services
from flockd.core.consistency import STAMP
from flockd.core.messages import FloatArray

WINDOW_S = 30.0
"""Older round trips do not count."""
MOST_SAMPLES = 300
LEAST_SAMPLES = 5
DRIFT = 5e-5
"""Seconds a second by which two crystals may run apart: the bounds of a round trip widen with its age."""
JUMP_S = 0.01
JUMPS = 3
"""So many round trips in a row that contradict the estimate by `JUMP_S` and half their duration begin a new one."""
RECENT_S = 2.0
COMPARED_S = 1.0
"""Messages that are compared with the clock: at 30 Hz enough for one that nothing has held up, ..."""
LEAST_MESSAGES = 10
"""... and at any rate so many."""
LIES_AFTER_S = 1.5
"""Longer than an autopilot that has started again contradicts its old clock."""
BELIEVED_AGAIN_S = 10.0


@dataclass(frozen=True)
class ClockEstimate:
    """The autopilot's clock as of one time of this computer's."""

    time_s: float
    """Time of the newest round trip, on this computer's clock."""
    offset_s: float
    """The autopilot's clock less this computer's, then."""
    error_s: float
    """The offset is off by no more, where the clocks run evenly; where they do not, by how much they contradict it."""
    round_trip_s: float
    """The shortest of the last seconds."""
    recent_round_trip_s: float
    """The shortest of the last `RECENT_S`."""

    def local_s(self, autopilot_s: float) -> float:
        """When on this computer's clock the autopilot's showed that."""
        return autopilot_s - self.offset_s


class StampMonitor:
    """Whether the clock that round trips give is that of the stamps in other messages: TIMESYNC may lie.

    A message cannot arrive before it was stamped, and the quickest in a second takes no longer on its one way than the
    quickest round trip takes on both. A clock that jumps, drifts or belongs to another sender violates one of the
    two. A busy computer violates neither, because it delays round trips too. The limits are `consistency.STAMP`'s.
    """

    def __init__(self) -> None:
        self._differences: deque[tuple[float, float]] = deque()
        """Of the last `COMPARED_S`: when a message arrived, and that less its stamp."""
        self._begun_s: float | None = None
        """Since when stamps contradict the clock; None: they do not."""
        self._last_s = -np.inf
        """When they last did."""
        self.lies = False
        """It has contradicted for long enough to say so, and has not agreed again for long enough."""
        self.delay_s = 0.0
        """On the way, the quickest message by this clock."""

    def believes(self, clock: ClockEstimate | None, stamp_s: float, arrived_s: float) -> bool:
        """Whether a message's stamp, on the autopilot's clock, may be used with that clock."""
        self._differences.append((arrived_s, arrived_s - stamp_s))
        while len(self._differences) > LEAST_MESSAGES and arrived_s - self._differences[0][0] > COMPARED_S:
            self._differences.popleft()
        if clock is None:
            return False
        if len(self._differences) < LEAST_MESSAGES:
            return not self.lies
        self.delay_s = min(difference for _, difference in self._differences) + clock.offset_s
        unsure_s = STAMP.limit + clock.error_s
        if -unsure_s <= self.delay_s <= clock.recent_round_trip_s + unsure_s:
            self._begun_s = None
            self.lies = self.lies and arrived_s - self._last_s < BELIEVED_AGAIN_S
            return not self.lies
        self._last_s = arrived_s
        self._begun_s = arrived_s if self._begun_s is None else self._begun_s
        self.lies = self.lies or arrived_s - self._begun_s >= LIES_AFTER_S
        return False


class ClockSync:
    """Estimates the offset from the round trips of the last `WINDOW_S`. `add` is for one thread, the rest for any."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float, float]] = deque(maxlen=MOST_SAMPLES)
        """Middle of the round trip on this computer's clock, the autopilot's time less that, and the duration."""
        self._contradicting: list[tuple[float, float, float]] = []
        self.estimate: ClockEstimate | None = None
        """None before `LEAST_SAMPLES` round trips, and after the autopilot has started again."""

    def add(self, sent_s: float, autopilot_s: float, received_s: float) -> None:
        """Takes a round trip: when it began and ended on this computer's clock, and the autopilot's time between."""
        duration_s, middle_s = received_s - sent_s, 0.5 * (sent_s + received_s)
        if not 0.0 <= duration_s <= services.TIME_SYNC.timeout:
            return
        sample = middle_s, autopilot_s - middle_s, duration_s
        if self.estimate is not None and _contradict(sample, self.estimate.offset_s):
            self._contradicting = [one for one in self._contradicting if not _contradict(one, sample[1])] + [sample]
            if len(self._contradicting) < JUMPS:
                return
            self._samples.clear()
            self._samples.extend(self._contradicting)
        else:
            self._samples.append(sample)
        self._contradicting = []
        while middle_s - self._samples[0][0] > WINDOW_S:
            self._samples.popleft()
        self.estimate = _overlap(np.array(self._samples)) if len(self._samples) >= LEAST_SAMPLES else None


def _contradict(sample: tuple[float, float, float], offset_s: float) -> bool:
    """Whether a round trip cannot be one with that offset."""
    return abs(sample[1] - offset_s) > 0.5 * sample[2] + JUMP_S


def _overlap(samples: FloatArray) -> ClockEstimate:
    """The middle of what the bounds of all round trips (n, 3) have in common, or of the gap where they have nothing."""
    time_s, offset_s, duration_s = samples.T
    within_s = 0.5 * duration_s + DRIFT * (time_s[-1] - time_s)
    least_s, most_s = (offset_s - within_s).max(), (offset_s + within_s).min()
    return ClockEstimate(
        time_s=float(time_s[-1]),
        offset_s=float(0.5 * (least_s + most_s)),
        error_s=float(0.5 * abs(most_s - least_s)),
        round_trip_s=float(duration_s.min()),
        recent_round_trip_s=float(duration_s[time_s >= time_s[-1] - RECENT_S].min()),
    )
