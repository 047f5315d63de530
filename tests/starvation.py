"""Tells a story whose drone flies in real time, and tells a computer that stopped it from a drone that fell.

Setpoints 0.5 s apart end a flight, as they should. A computer that does not run this process for so long proves
nothing about the daemon, and its stories are skipped with the reason.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, Self

import pytest

BEARABLE_S = 0.3
"""As long as the streamer waits for the control loop."""
_LOOK_S = 0.02


class Starvation:
    """The longest time for which this process wanted to run and was not let; its own computing does not count."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        while True:
            slept_s, used_s = time.monotonic(), time.process_time()
            ended = self._ended.wait(_LOOK_S)
            late_s = time.monotonic() - slept_s - _LOOK_S
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
    """Runs it. A failure on a computer that stopped this process for too long is no failure, and skipped."""
    with Starvation() as starvation:
        try:
            asyncio.run(story())
        except Exception as error:
            if starvation.longest_s > BEARABLE_S:
                pytest.skip(f"the computer stopped this process for {starvation.longest_s:.1f} s: {error!r}")
            raise
