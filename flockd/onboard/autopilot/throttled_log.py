"""A log for what a library repeats: each text at once, and then once a minute, with how often it came meanwhile."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

AGAIN_S = 60.0
MAX_TEXTS = 100
"""Texts remembered; a library that puts numbers into its texts never repeats one."""


class ThrottledLog:
    """May be called on any thread."""

    def __init__(self, log: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self._log, self._clock = log, clock
        self._lock = threading.Lock()
        self._told: dict[str, tuple[float, int]] = {}
        """When each text was written last, and how often it has come since."""

    def __call__(self, level: int, text: str) -> None:
        """Writes the text, or counts it."""
        with self._lock:
            now = self._clock()
            told_s, count = self._told.get(text, (-AGAIN_S, 0))
            if now - told_s < AGAIN_S:
                self._told[text] = told_s, count + 1
                return
            if len(self._told) >= MAX_TEXTS:
                self._told.clear()
            self._told[text] = now, 0
        self._log.log(level, "%s", f"{text} ({count} times more in {now - told_s:.0f} s)" if count else text)
