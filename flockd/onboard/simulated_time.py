"""Simulated time: the computer's own made slower or faster, so that all of its programs have the same."""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Callable
from typing import Any


def event_loop_at(speed_factor: float) -> asyncio.AbstractEventLoop:
    """Sleeps and time-outs by `clock_at`; at 1 asyncio's own loop."""
    return asyncio.new_event_loop() if speed_factor == 1.0 else _SimulatedLoop(speed_factor)


class _SimulatedLoop(asyncio.SelectorEventLoop):
    def __init__(self, speed_factor: float) -> None:
        self._now = clock_at(speed_factor)
        super().__init__(_SimulatedSelector(speed_factor))

    def time(self) -> float:
        return self._now()


class _SimulatedSelector(selectors.DefaultSelector):
    """Waits in real time for what is asked in simulated time."""

    def __init__(self, speed_factor: float) -> None:
        super().__init__()
        self._speed_factor = speed_factor

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, Any]]:
        return super().select(None if timeout is None else timeout / self._speed_factor)


def clock_at(speed_factor: float) -> Callable[[], float]:
    """Seconds on the monotonic clock times ``speed_factor``; at 1 the clock itself."""
    return time.monotonic if speed_factor == 1.0 else lambda: speed_factor * time.monotonic()
