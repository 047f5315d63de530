"""The fleet as its telemetry has it now."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Self

from flockd.fleet.drone_queries import ClockReading
from flockd.fleet.page.drone_rows import Known, Row, drone_rows, history_row
from flockd.fleet.page.fleet_source import Event
from flockd.fleet.watcher import FleetWatcher, Watched
from flockd.onboard.telemetry.topics import AnswerMessage

ASK_EVERY_S = 5.0
"""Each drone for its clocks, and for what it flies with until it has told."""
LOOK_EVERY_S = 0.5
"""For drones that are new, and at what belongs into the history."""
HISTORY_S = 300.0
CLOCK_READINGS = 8
"""The one with the least delay among the last so many says how far the clocks are apart."""
_ASKING_THREADS = 4


class LiveFleet:
    """A `FleetSource`. Asks drones for their clocks on threads of its own between ``__enter__`` and ``__exit__``."""

    span_s = None

    def __init__(self, watcher: FleetWatcher) -> None:
        """``watcher``: stays its owner's."""
        self._watcher = watcher
        self._lock = threading.Lock()
        self._known: dict[str, Known] = {}
        self._readings: dict[str, deque[ClockReading]] = {}
        self._asked_s: dict[str, float] = {}
        self._history: dict[str, deque[list[float | None]]] = {}
        self._over = threading.Event()
        self._pool = ThreadPoolExecutor(_ASKING_THREADS, "fleet page queries")
        self._thread = threading.Thread(target=self._run, name="fleet page", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._pool.shutdown(cancel_futures=True)

    def now_s(self) -> float:
        """See `FleetSource`; so all that follow."""
        return time.monotonic()

    def wall_s(self, time_s: float) -> float:
        """By this computer's clock."""
        return time.time() - time.monotonic() + time_s

    def drones(self, time_s: float) -> tuple[Watched, ...]:
        """All that were ever heard."""
        return self._watcher.drones()

    def known(self) -> Mapping[str, Known]:
        """As far as queries have found it."""
        with self._lock:
            return dict(self._known)

    def rows(self, time_s: float) -> dict[str, Row]:
        """Rows of all drones that were ever heard."""
        return drone_rows(self.drones(time_s), self.known(), time_s)

    def events(self, time_s: float) -> list[Event]:
        """All that are remembered."""
        return [(event.time_s, f"{event.fleet}/{event.drone}", event.sentence) for event in self._watcher.events()]

    def history(self) -> Mapping[str, list[list[float | None]]]:
        """The history of the last five minutes."""
        with self._lock:
            return {key: list(rows) for key, rows in self._history.items()}

    def ask(self, drone: str, command: str, order: Mapping[str, object] | None) -> AnswerMessage:
        """Asks the drone itself, which decides."""
        if drone not in {f"{one.fleet}/{one.drone}" for one in self._watcher.drones()}:
            return AnswerMessage(accepted=False, sentence="no drone of this name was heard")
        answer = self._watcher.queries.ask(drone, command, order)
        return answer or AnswerMessage(accepted=False, sentence="did not answer, or this computer may not command it")

    def image(self, drone: str, camera: str, time_s: float) -> bytes | None:
        """Asks the drone itself."""
        return self._watcher.queries.image(drone, camera)

    def _run(self) -> None:
        """Keeps the history, and asks each drone that is alive as soon as it appears, then now and again."""
        while not self._over.wait(LOOK_EVERY_S):
            now_s = time.monotonic()
            self._keep(now_s)
            for drone in self._watcher.drones():
                key = f"{drone.fleet}/{drone.drone}"
                if not drone.alive:
                    self._forget(key)
                elif now_s - self._asked_s.get(key, -math.inf) >= ASK_EVERY_S:
                    self._asked_s[key] = now_s
                    self._pool.submit(self._ask_one, key)

    def _keep(self, now_s: float) -> None:
        rows = self.rows(now_s)
        with self._lock:
            for key, row in rows.items():
                kept = self._history.setdefault(key, deque(maxlen=round(HISTORY_S / LOOK_EVERY_S)))
                kept.append(history_row(row, now_s))

    def _forget(self, key: str) -> None:
        """When it comes back, it may fly with something else."""
        self._asked_s.pop(key, None)
        with self._lock:
            self._known.pop(key, None)
            self._readings.pop(key, None)

    def _ask_one(self, key: str) -> None:
        with self._lock:
            about = self._known.get(key, Known()).about
        about = about or self._watcher.queries.about(key)
        reading = self._watcher.queries.clock(key)
        with self._lock:
            readings = self._readings.setdefault(key, deque(maxlen=CLOCK_READINGS))
            if reading is None:
                self._known[key] = Known(about)
                return
            readings.append(reading)
            self._known[key] = Known(about, reading.delay_s, min(readings).ahead_s)
