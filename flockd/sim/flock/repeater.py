"""Sends each drone's newest messages again while a simulation computes its next step, which may take minutes."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from flockd.onboard.telemetry.step_messages import TelemetrySink

EVERY_S = 1.0
"""Below the age at which a watcher takes a message for stale."""


class Repeater:
    """A telemetry sink that hands on each message at once, and the newest of each topic again every second.

    Its thread runs between ``__enter__`` and ``__exit__``.
    """

    def __init__(self, sink: TelemetrySink, every_s: float = EVERY_S) -> None:
        self._sink, self._every_s = sink, every_s
        self._newest: dict[tuple[str, str], Mapping[str, object]] = {}
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._repeat, name="telemetry repeater", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def forget(self, drone: str) -> None:
        """Of a drone that is gone, nothing is sent again."""
        with self._lock:
            self._newest = {key: message for key, message in self._newest.items() if key[0] != drone}

    def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
        """See `TelemetrySink`."""
        with self._lock:
            self._newest[drone, topic] = message
            self._sink.publish(drone, topic, message)

    def _repeat(self) -> None:
        while not self._over.wait(self._every_s):
            with self._lock:
                for (drone, topic), message in self._newest.items():
                    self._sink.publish(drone, topic, message)
