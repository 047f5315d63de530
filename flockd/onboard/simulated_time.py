"""Simulated time: the computer's clock made slower or faster, the same in all of its programs."""

from __future__ import annotations

import asyncio
import selectors
import time
from collections.abc import Callable
from typing import Any


def event_loop_at(speed_factor: float) -> asyncio.AbstractEventLoop:
    """An event loop with sleeps and time-outs by `clock_at`; asyncio's own for a factor of 1."""
    return asyncio.new_event_loop() if speed_factor == 1.0 else _SimulatedLoop(speed_factor)


class _SimulatedLoop(asyncio.SelectorEventLoop):
    def __init__(self, speed_factor: float) -> None:
        self._now = clock_at(speed_factor)
        super().__init__(_SimulatedSelector(speed_factor))

    def time(self) -> float:
        return self._now()


class _SimulatedSelector(selectors.DefaultSelector):
    """Waits in real time for intervals of simulated time."""

    def __init__(self, speed_factor: float) -> None:
        super().__init__()
        self._speed_factor = speed_factor

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, Any]]:
        return super().select(None if timeout is None else timeout / self._speed_factor)


def clock_at(speed_factor: float) -> Callable[[], float]:
    """Seconds on the monotonic clock times ``speed_factor``; the clock itself for a factor of 1."""
    return time.monotonic if speed_factor == 1.0 else lambda: speed_factor * time.monotonic()
