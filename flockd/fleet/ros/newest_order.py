"""Orders that come faster than a drone answers: one is asked at a time, and of those that wait the newest counts."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any


class NewestOrder:
    """Of one drone and one kind of order. `offer` returns at once, so that a drone that is gone holds up no other."""

    def __init__(self, threads: Executor, take: Callable[[Any], None]) -> None:
        """``take`` may wait; it is called on a thread of ``threads``."""
        self._threads, self._take = threads, take
        self._lock = threading.Lock()
        self._waiting: list[Any] = []
        self._busy = False

    def offer(self, message: Any) -> None:
        """Takes the place of what waits; from any thread."""
        with self._lock:
            self._waiting = [message]
            if self._busy:
                return
            self._busy = True
        self._threads.submit(self._run)

    def _run(self) -> None:
        while (message := self._next()) is not None:
            try:
                self._take(message[0])
            except BaseException:
                with self._lock:
                    self._busy = False  # the next one is passed on all the same
                raise

    def _next(self) -> list[Any] | None:
        """What waits; with nothing, this thread has ended its work."""
        with self._lock:
            waiting, self._waiting = self._waiting, []
            self._busy = bool(waiting)
            return waiting or None
