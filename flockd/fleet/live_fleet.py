"""The present state of a fleet, from its telemetry."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
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


@dataclass
class _Contact:
    """What a drone that is alive has answered, and when it is asked again."""

    known: Known = field(default_factory=Known)
    readings: deque[ClockReading] = field(default_factory=lambda: deque(maxlen=CLOCK_READINGS))
    due_s: float = -math.inf
    wait_s: float = 0.0
    """Interval of queries while it does not answer."""
    asking: bool = False


class LiveFleet:
    """The state for the page and the bridge to ROS 2. Runs on the event loop; queries wait on threads.

    It queries the drones' clocks between ``__enter__`` and ``__exit__``.
    """

    def __init__(self, watcher: FleetWatcher) -> None:
        """``watcher``: the caller closes it."""
        self._watcher = watcher
        self._lock = threading.Lock()
        self._contacts: dict[str, _Contact] = {}
        """By the drone's key. A drone that comes back gets a new one: its configuration may differ."""
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
            return {key: contact.known for key, contact in self._contacts.items()}

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
            with self._lock:
                self._contacts = {key: self._contacts.get(key) or _Contact() for key in alive}
            due = [key for key, one in self._contacts.items() if now_s >= one.due_s and not one.asking]
            due.sort(key=lambda key: (self._contacts[key].wait_s, -alive[key].messages))  # silent ones last
            for key in due[: _ASKING_THREADS - sum(one.asking for one in self._contacts.values())]:
                self._contacts[key].asking = True
                self._pool.submit(self._ask_one, key, self._contacts[key])

    def _keep(self, now_s: float) -> None:
        rows = self.rows(now_s)
        with self._lock:
            new = deque[list[float | None]](maxlen=round(HISTORY_S / LOOK_EVERY_S))
            self._history = {key: self._history.get(key) or new.copy() for key in rows}
            for key, row in rows.items():
                self._history[key].append(history_row(row, now_s))

    def _ask_one(self, key: str, contact: _Contact) -> None:
        """Queries one drone, on a separate thread."""
        reading: ClockReading | None = None
        try:
            about = contact.known.about or self._watcher.queries.about(key)
            reading = None if about is None else self._watcher.queries.clock(key)
            if reading is None:
                contact.known = Known(about)
            else:
                contact.readings.append(reading)
                contact.known = Known(about, reading.delay_s, min(contact.readings).ahead_s)
        finally:
            before_s = contact.wait_s or ASK_EVERY_S / 2
            contact.wait_s = min(2.0 * before_s, ASK_SILENT_S) if reading is None else 0.0
            contact.due_s = time.monotonic() + (contact.wait_s or ASK_EVERY_S)
            contact.asking = False


def _rounded(count: int) -> int:
    """A number rounded to one digit, so that a note seldom changes."""
    return int(float(f"{count:.0e}"))
