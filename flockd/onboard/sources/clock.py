"""The clock of a simulation: the computer's own made slower or faster, so that all of its programs have the same."""

from __future__ import annotations

import time
from collections.abc import Callable


def clock_at(speed_factor: float) -> Callable[[], float]:
    """Seconds on the monotonic clock times ``speed_factor``; at 1 the clock itself."""
    return time.monotonic if speed_factor == 1.0 else lambda: speed_factor * time.monotonic()
