"""An asyncio event loop in simulated time: sleeps and time-outs count simulated seconds."""

from __future__ import annotations

import asyncio
import selectors
from typing import Any

from flockd.onboard.sources.clock import clock_at


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
