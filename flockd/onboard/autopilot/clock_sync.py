"""The autopilot's clock relative to this computer's, from round trips of MAVLink's TIMESYNC; pure, without a clock.

A round trip limits the offset between two clocks to within half its duration, as the time of each way is not known. A
busy computer only widens the bounds of a round trip: the offset lies in the intersection of all bounds.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from flockd.core import services
from flockd.core.consistency import STAMP
from flockd.core.messages import FloatArray

WINDOW_S = 30.0
"""Age up to which round trips count."""
MOST_SAMPLES = 300
LEAST_SAMPLES = 5
DRIFT = 5e-5
"""Largest drift between two crystals in s per s: the bounds of a round trip widen with its age."""
JUMP_S = 0.01
JUMPS = 3
"""Round trips in a row that contradict the estimate, by `JUMP_S` and half their duration, before a new one begins."""
RECENT_S = 2.0
COMPARED_S = 1.0
"""Messages of this time are compared with the clock: at 30 Hz, one of them was not delayed."""
LEAST_MESSAGES = 10
"""Fewest messages that are compared."""
LIES_AFTER_S = 1.5
"""Longer than the time for which a restarted autopilot contradicts its old clock."""
BELIEVED_AGAIN_S = 10.0


@dataclass(frozen=True)
class ClockEstimate:
    """The autopilot's clock at one time of this computer's."""

    time_s: float
    """Time of the newest round trip, on this computer's clock."""
    offset_s: float
    """The autopilot's clock minus this computer's."""
    error_s: float
    """Largest error of the offset if the clocks run evenly; else the gap between contradicting bounds."""
    round_trip_s: float
    """The shortest round trip of the last seconds."""
    recent_round_trip_s: float
    """The shortest round trip of the last `RECENT_S`."""

    def local_s(self, autopilot_s: float) -> float:
        """This computer's time at which the autopilot's clock showed `autopilot_s`."""
        return autopilot_s - self.offset_s


class StampMonitor:
    """Checks that round trips and the stamps of other messages show the same clock: TIMESYNC may be wrong.

    A message cannot arrive before it was stamped, and the fastest in a second takes no longer one way than the fastest
    round trip takes both ways. A clock that jumps, drifts or belongs to another sender violates one of the two. A busy
    computer violates neither, because it delays round trips too. The limits are `consistency.STAMP`'s.
    """

    def __init__(self) -> None:
        self._differences: deque[tuple[float, float]] = deque()
        """(arrival, arrival minus stamp) of the messages of the last `COMPARED_S`."""
        self._begun_s: float | None = None
        """Since when stamps contradict the clock; None: they agree."""
        self._last_s = -np.inf
        """When they last contradicted it."""
        self.lies = False
        """Whether they have contradicted it for long enough, and have not agreed again for long enough."""
        self.delay_s = 0.0
        """Delay of the fastest message by this clock."""

    def believes(self, clock: ClockEstimate | None, stamp_s: float, arrived_s: float) -> bool:
        """Whether a message's stamp, on the autopilot's clock, may be converted with that clock."""
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
    """Estimates the offset from the round trips of the last `WINDOW_S`. Call `add` on one thread, the rest on any."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float, float]] = deque(maxlen=MOST_SAMPLES)
        """Middle of the round trip on this computer's clock, the autopilot's time minus it, and the duration."""
        self._contradicting: list[tuple[float, float, float]] = []
        self.estimate: ClockEstimate | None = None
        """None before `LEAST_SAMPLES` round trips, and after a restart of the autopilot."""

    def add(self, sent_s: float, autopilot_s: float, received_s: float) -> None:
        """Takes a round trip: its start and end on this computer's clock, and the autopilot's time between them."""
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
    """Whether a round trip is impossible with that offset."""
    return abs(sample[1] - offset_s) > 0.5 * sample[2] + JUMP_S


def _overlap(samples: FloatArray) -> ClockEstimate:
    """The middle of the intersection of the bounds of all round trips (n, 3), or of the gap if it is empty."""
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
