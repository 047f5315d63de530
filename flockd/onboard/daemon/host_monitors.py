"""Monitors of the computer: lag of the event loop, temperature, jumps of the wall clock."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from flockd.onboard.daemon.worker import LateError, Worker

SAMPLE_S = 0.05
MEMORY_S = 1.0
THERMAL_ZONES = Path("/sys/class/thermal")
READ_DEADLINE_S = 1.0
JUMP_S = 0.5


class LoopLag:
    """Measures how late the event loop wakes a sleeping task."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._measured: deque[tuple[float, float]] = deque()
        self._due_s = math.inf

    async def run(self) -> None:
        """Measures until cancelled."""
        while True:
            self._due_s = self._clock() + SAMPLE_S
            await asyncio.sleep(SAMPLE_S)
            now = self._clock()
            self._measured.append((now, max(0.0, now - self._due_s)))

    def worst_s(self) -> float:
        """In the last second, and now."""
        now = self._clock()
        while self._measured and now - self._measured[0][0] > MEMORY_S:
            self._measured.popleft()
        return max([0.0, now - self._due_s, *(lag for _, lag in self._measured)])


class Thermometer:
    """Reads the hottest thermal zone once a second, on a worker: some drivers take their time."""

    def __init__(self, folder: Path = THERMAL_ZONES) -> None:
        self._folder = folder
        self._worker = Worker("thermometer")
        self.hottest_c: float | None = None
        """None on a computer that has no thermal zone, and while the reading hangs."""

    async def run(self) -> None:
        """Reads until cancelled."""
        while True:
            try:
                self.hottest_c = await self._worker.do(READ_DEADLINE_S, hottest_zone_c, self._folder)
            except LateError:
                self.hottest_c = None
                self._worker.leave()
                self._worker = Worker("thermometer")
            await asyncio.sleep(1.0)


class WallClock:
    """Reports when the wall clock is set: the flight does not use it, but readers of the log need to know."""

    def __init__(
        self, log_event: Callable[[str], None], clock: Callable[[], float], wall: Callable[[], float] = time.time
    ) -> None:
        self._log_event, self._clock, self._wall = log_event, clock, wall
        self._ahead_s = wall() - clock()

    async def run(self) -> None:
        """Checks once a second until cancelled."""
        while True:
            self.check()
            await asyncio.sleep(1.0)

    def check(self) -> None:
        """Checks once."""
        ahead_s = self._wall() - self._clock()
        if abs(ahead_s - self._ahead_s) > JUMP_S:
            self._log_event(f"the wall clock was set by {ahead_s - self._ahead_s:+.1f} s; the flight does not use it")
        self._ahead_s = ahead_s


def hottest_zone_c(folder: Path) -> float | None:
    """Temperature of the hottest zone that can be read; a zone that is switched off cannot."""
    readings = []
    for zone in folder.glob("thermal_zone*/temp"):
        try:
            readings.append(int(zone.read_text(encoding="ascii")) / 1000)
        except (OSError, ValueError):
            continue
    return max(readings, default=None)
