"""The autopilot's clock against this computer's, from round trips of MAVLink's TIMESYNC; pure, knows no clock.

A round trip tells the offset between two clocks to half its duration: how long each way took is not known. A busy
computer delays a message on one way, so that the shortest round trips are the best, and weigh the most.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from flockd.messages import FloatArray

WINDOW_S = 30.0
"""Older round trips do not count."""
MOST_SAMPLES = 300
LEAST_SAMPLES = 5
DRIFT = 5e-5
"""Standard deviation of the rate between two crystals, as known before anything was measured."""
FLOOR_S = 1e-4
"""Standard deviation of the offset in the shortest round trip."""
JUMP_S = 0.01
JUMPS = 3
"""So many round trips in a row that contradict the estimate by `JUMP_S` and half their duration begin a new one."""
LONGEST_S = 1.0
"""A longer round trip says nothing."""


@dataclass(frozen=True)
class ClockEstimate:
    """The autopilot's clock as of one time of this computer's."""

    time_s: float
    """Of the newest round trip, on this computer's clock."""
    offset_s: float
    """The autopilot's clock less this computer's, then."""
    drift: float
    """How much faster the autopilot's clock runs: seconds a second."""
    jitter_s: float
    """Robust standard deviation of single round trips' offsets."""
    round_trip_s: float
    """The shortest of the last seconds; half of it bounds the offset's error where clocks run evenly."""
    samples: int

    def local_s(self, autopilot_s: float) -> float:
        """When on this computer's clock the autopilot's showed that."""
        return self.time_s + (autopilot_s - self.time_s - self.offset_s) / (1.0 + self.drift)


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
        if not 0.0 <= duration_s <= LONGEST_S:
            return
        sample = middle_s, autopilot_s - middle_s, duration_s
        if self.estimate is not None and _contradict(sample, self._expected_s(middle_s)):
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
        self.estimate = _fitted(np.array(self._samples)) if len(self._samples) >= LEAST_SAMPLES else None

    def _expected_s(self, time_s: float) -> float:
        assert self.estimate is not None
        return self.estimate.offset_s + self.estimate.drift * (time_s - self.estimate.time_s)


def _contradict(sample: tuple[float, float, float], offset_s: float) -> bool:
    """Whether a round trip cannot be one with that offset."""
    return abs(sample[1] - offset_s) > 0.5 * sample[2] + JUMP_S


def _fitted(samples: FloatArray) -> ClockEstimate:
    """A line through the offsets (n, 3), each with the deviation that its duration beyond the shortest allows.

    Delays are all on one way while a computer is busy and do not cancel out, so that many poor round trips must not
    outvote a good one: their deviation grows with the square.
    """
    time_s, offset_s, duration_s = samples.T
    beyond = 0.5 * (duration_s - duration_s.min()) / FLOOR_S
    sigma_s = FLOOR_S * (1.0 + beyond**2)
    since_s, first_s = time_s - time_s[-1], offset_s[-1]
    # Rows of the least squares: one a sample, and what is known of the drift before.
    rows = np.vstack([np.column_stack([np.ones_like(since_s), since_s]) / sigma_s[:, None], [0.0, 1.0 / DRIFT]])
    values = np.append((offset_s - first_s) / sigma_s, 0.0)
    offset, drift = np.linalg.lstsq(rows, values, rcond=None)[0]
    residuals = offset_s - first_s - offset - drift * since_s
    return ClockEstimate(
        time_s=float(time_s[-1]),
        offset_s=float(first_s + offset),
        drift=float(drift),
        jitter_s=1.4826 * float(np.median(np.abs(residuals))),
        round_trip_s=float(duration_s.min()),
        samples=len(samples),
    )
