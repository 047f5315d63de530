"""Runs a test whose drone flies in real time, and tells a computer that stopped it from a drone that failed.

Setpoints 0.5 s apart end a flight, as they should. A computer that does not run this process for so long proves
nothing about the daemon: such a run counts as starved. `tests/conftest.py` runs the test again, and the test fails if
every run is starved.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, Self

BEARABLE_S = 0.3
"""As long as the streamer waits for the control loop."""
MAX_RUNS = 3
PAUSE_S = 5.0
"""Before the test is run again, for whatever kept the computer busy to end."""
_PERIOD_S = 0.02


class StarvedError(AssertionError):
    """A test failed while the computer did not run it."""


class Starvation:
    """The longest time for which this process wanted to run and was not let; its own computing does not count."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        while True:
            slept_s, used_s = time.monotonic(), time.process_time()
            ended = self._ended.wait(_PERIOD_S)
            late_s = time.monotonic() - slept_s - _PERIOD_S
            self.longest_s = max(self.longest_s, late_s - (time.process_time() - used_s))
            if ended:
                return

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()


def tell(story: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Runs the coroutine. Raises StarvedError where it fails while the computer stopped this process for too long."""
    with Starvation() as starvation:
        try:
            asyncio.run(story())
        except Exception as error:
            if starvation.longest_s > BEARABLE_S:
                raise StarvedError(f"the computer stopped this process for {starvation.longest_s:.1f} s") from error
            raise
