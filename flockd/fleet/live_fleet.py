"""The present state of a fleet, from its telemetry."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Self

from flockd.fleet.drone_queries import ClockReading
from flockd.fleet.drone_rows import Known, Row, drone_rows, history_row
from flockd.fleet.watcher import FleetWatcher, Watched
from flockd.onboard.telemetry.topics import AnswerMessage, is_name

Event = tuple[float, str, str]
"""Time of arrival, key of the drone, and text."""

ASK_EVERY_S = 5.0
"""Interval of asking each drone for its clocks, and for its configuration until it has answered."""
ASK_SILENT_S = 60.0
"""Longest interval of queries to a drone that does not answer."""
LOOK_EVERY_S = 0.5
"""Interval of checks for new drones, and of rows of the history."""
HISTORY_S = 300.0
MANY = 100
"""Number of malformed messages that a few faults may cause; more are reported."""
CLOCK_READINGS = 8
"""Number of last readings; the one with the least delay gives the difference of the clocks."""
ROWS_S = 0.1
"""Time after which rows are computed again."""
_ASKING_THREADS = 16


class LiveFleet:
    """The state for the page and the bridge to ROS 2. Runs on the event loop; queries wait on threads.

    It queries the drones' clocks between ``__enter__`` and ``__exit__``.
    """

    def __init__(self, watcher: FleetWatcher) -> None:
        """``watcher``: the caller closes it."""
        self._watcher = watcher
        self._lock = threading.Lock()
        self._known: dict[str, Known] = {}
        self._readings: dict[str, deque[ClockReading]] = {}
        self._due_s: dict[str, float] = {}
        """Time of the next query to each drone."""
        self._waits_s: dict[str, float] = {}
        """Interval of queries to drones that did not answer."""
        self._asking: set[str] = set()
        self._rows: tuple[float, dict[str, Row]] = -math.inf, {}
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
        """The watcher's clock."""
        return time.monotonic()

    def wall_s(self, time_s: float) -> float:
        """Seconds since 1970, by this computer's clock, at a time of the watcher's."""
        return time.time() - time.monotonic() + time_s

    def drones(self) -> tuple[Watched, ...]:
        """All drones that were ever heard."""
        return self._watcher.drones()

    def known(self) -> Mapping[str, Known]:
        """Replies to queries, by the drone's key."""
        with self._lock:
            return dict(self._known)

    def rows(self, time_s: float) -> dict[str, Row]:
        """The row of each drone that was ever heard, by its key, the worst first."""
        made_s, rows = self._rows
        if not 0.0 <= time_s - made_s < ROWS_S:
            rows = drone_rows(self.drones(), self.known(), time_s)
            self._rows = time_s, rows
        return rows

    def notes(self) -> list[str]:
        """Warnings about messages that no drone sends."""
        malformed, forgotten = self._watcher.malformed, self._watcher.forgotten
        notes = []
        if malformed > MANY:
            notes.append(f"more than {_rounded(malformed)} malformed messages have come")
        if forgotten:
            notes.append(f"more names are heard than a fleet has drones: {_rounded(forgotten)} were forgotten")
        return [f"{note}; see who else reaches these endpoints" for note in notes]

    def events(self) -> list[Event]:
        """All remembered events, the newest last."""
        return [(event.time_s, f"{event.fleet}/{event.drone}", event.sentence) for event in self._watcher.events()]

    def history(self) -> Mapping[str, list[list[float | None]]]:
        """The last five minutes by key: rows of `HISTORY_COLUMNS` in order of time."""
        with self._lock:
            return {key: list(rows) for key, rows in self._history.items()}

    def ask(self, drone: str, command: str, order: Mapping[str, object] | None, operator: str) -> AnswerMessage:
        """Sends a command to the drone, which decides. Waits: call it, and `image`, on a separate thread."""
        answer = self._watcher.ask(drone, command, operator, order)
        return answer or AnswerMessage(accepted=False, sentence="did not answer, or this computer may not command it")

    def image(self, drone: str, camera: str) -> bytes | None:
        """A JPEG of a camera's image, from the drone."""
        there = any(one.alive and f"{one.fleet}/{one.drone}" == drone for one in self._watcher.drones())
        return self._watcher.queries.image(drone, camera) if there and is_name(camera) else None

    def _run(self) -> None:
        """Keeps the history, and queries each drone when it appears and then regularly."""
        while not self._over.wait(LOOK_EVERY_S):
            now_s, drones = time.monotonic(), self._watcher.drones()
            self._keep(now_s)
            alive = {f"{drone.fleet}/{drone.drone}": drone for drone in drones if drone.alive}
            for key in (self._due_s.keys() | self.known().keys()) - alive.keys():
                self._forget(key)
            due = [key for key in alive if now_s >= self._due_s.get(key, -math.inf) and key not in self._asking]
            due.sort(key=lambda key: (self._waits_s.get(key, 0.0), -alive[key].messages))  # silent ones last
            for key in due[: _ASKING_THREADS - len(self._asking)]:
                self._asking.add(key)
                self._pool.submit(self._ask_one, key)

    def _keep(self, now_s: float) -> None:
        rows = self.rows(now_s)
        with self._lock:
            for key in self._history.keys() - rows.keys():
                del self._history[key]
            for key, row in rows.items():
                kept = self._history.setdefault(key, deque(maxlen=round(HISTORY_S / LOOK_EVERY_S)))
                kept.append(history_row(row, now_s))

    def _forget(self, key: str) -> None:
        """Deletes a drone's replies: when it comes back, its configuration may differ."""
        self._due_s.pop(key, None)
        self._waits_s.pop(key, None)
        with self._lock:
            self._known.pop(key, None)
            self._readings.pop(key, None)

    def _ask_one(self, key: str) -> None:
        """Queries one drone, on a separate thread."""
        answered = False
        try:
            answered = self._learn(key)
        finally:
            before_s = self._waits_s.get(key, 0.0) or ASK_EVERY_S / 2
            self._waits_s[key] = 0.0 if answered else min(2.0 * before_s, ASK_SILENT_S)
            self._due_s[key] = time.monotonic() + (self._waits_s[key] or ASK_EVERY_S)
            self._asking.discard(key)

    def _learn(self, key: str) -> bool:
        """Takes a drone's replies. Returns whether it answered."""
        with self._lock:
            about = self._known.get(key, Known()).about
        about = about or self._watcher.queries.about(key)
        reading = None if about is None else self._watcher.queries.clock(key)
        with self._lock:
            readings = self._readings.setdefault(key, deque(maxlen=CLOCK_READINGS))
            if reading is None:
                self._known[key] = Known(about)
                return False
            readings.append(reading)
            self._known[key] = Known(about, reading.delay_s, min(readings).ahead_s)
            return True


def _rounded(count: int) -> int:
    """A number rounded to one digit, so that a note seldom changes."""
    return int(float(f"{count:.0e}"))
