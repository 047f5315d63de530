"""Time for tests whose drone flies in this process: without the pauses in which the computer ran others.

The daemon, the fake autopilot, the cameras and the test itself read one clock. It advances `SPEED_FACTOR` times as fast
as real time, but by `MOST_S` at most from one reading to the next. So a time-out that the drone keeps is kept however
busy the computer is, and a bound that a test asserts is the requirement's.
"""

from __future__ import annotations

import asyncio
import inspect
import math
import selectors
import threading
import time
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

Story = Callable[[], Coroutine[Any, Any, None]]

SPEED_FACTOR = 2.0
"""These flights wait much and compute little."""
MOST_S = 0.05
"""More than between two readings on a computer that is free: the fake autopilot reads every 0.02 s of real time."""


class CalmClock:
    """Monotonic seconds, for any thread."""

    def __init__(self, real: Callable[[], float]) -> None:
        self._real = real
        self._read_s = self._now_s = real()
        self._lock = threading.Lock()
        self.stands: Callable[[], bool] = lambda: False
        """No time passes while it is so: a story may wait for what takes real time, as a message on its way."""

    def __call__(self) -> float:
        """Now."""
        with self._lock:
            read_s = self._real()
            self._now_s += 0.0 if self.stands() else min(read_s - self._read_s, MOST_S)
            self._read_s = read_s
            return self._now_s


clock = CalmClock(lambda: SPEED_FACTOR * time.monotonic())
"""This process's."""


class _Loop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        super().__init__(_Selector())

    def time(self) -> float:
        return clock()


class _Selector(selectors.DefaultSelector):
    """Returns often enough for the clock to advance while nothing happens."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, Any]]:
        return super().select(min(MOST_S / 2, math.inf if timeout is None else timeout) / SPEED_FACTOR)


class _SteppedLoop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        self._selector_now = _SteppedSelector()
        super().__init__(self._selector_now)

    def time(self) -> float:
        return self._selector_now.now_s


class _SteppedSelector(selectors.DefaultSelector):
    now_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, Any]]:
        ready = super().select(0.0)
        if not ready and timeout is not None:
            self.now_s += timeout
        return ready


def run_stepped(story: Story) -> None:
    """Runs a coroutine that waits for nothing outside of it: each sleep and time-out passes at once."""
    with asyncio.Runner(loop_factory=_SteppedLoop) as runner:
        runner.run(story())


def run(story: Story) -> None:
    """Runs the coroutine on an event loop whose sleeps and time-outs are by `clock`."""
    with asyncio.Runner(loop_factory=_Loop) as runner:
        runner.run(story())


def run_coroutine_test(test: pytest.Function, run_it: Callable[[Story], None]) -> bool | None:
    """Runs an `async def test_...`, with fixtures and parameters as other tests have them; None for another test."""
    if not inspect.iscoroutinefunction(test.obj):
        return None
    given = {name: test.funcargs[name] for name in inspect.signature(test.obj).parameters}
    run_it(lambda: test.obj(**given))
    return True


def until(true: Callable[[], Any], patience_s: float = 60.0) -> Any:
    """Waits for it in real time, and gives it; fails where it does not come."""
    end_s = time.monotonic() + patience_s
    while not (found := true()):
        assert time.monotonic() < end_s, "it did not come"
        time.sleep(0.01)
    return found
