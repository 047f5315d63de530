"""Watches a fleet: for the commands of people. Nothing that flies imports this."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import zenoh

from flockd.fleet.drone_queries import DroneQueries
from flockd.onboard.telemetry.schema import completed, fault
from flockd.onboard.telemetry.topics import PREFIX, TOPICS, checked_name, is_name
from flockd.onboard.telemetry.zenoh_session import SessionOwner, open_session

MAX_BYTES = 1 << 20
"""The largest message; one with every field at its longest has a hundredth of it."""
MAX_DRONES = 1000
"""The most drones that are remembered, on a bus on which somebody invents drones."""
MAX_EVENTS = 500
"""So many of the newest are remembered."""
_PERIOD_SHARE = 0.2
"""Weight of the newest period in the mean."""
_SLOWEST = 10.0
"""The smallest speed factor that a daemon's configuration allows is 0.1."""


@dataclass(frozen=True)
class Heard:
    """The newest message of one topic, and when it came on the watcher's clock."""

    time_s: float
    message: Mapping[str, Any]
    slowness: float = 1.0
    """Seconds of the watcher's clock in one of the drone's: a simulated drone's time may pass slowly."""
    period_s: float | None = None
    """Between new messages, by the watcher's clock, smoothed; None before the second."""
    new_s: float | None = None
    """When the newest came that was not sent once more."""


def _heard(before: Heard | None, now_s: float, message: Mapping[str, Any]) -> Heard:
    """With how slowly the drone's time passed since its message before."""
    if before is None:
        return Heard(now_s, message, _SLOWEST, new_s=now_s)  # not known yet
    own_s = message.get("time_s", 0.0) - before.message.get("time_s", 0.0)
    if own_s <= 0:
        return replace(before, time_s=now_s, message=message)  # sent once more, or begun again
    slowness = min(max((now_s - before.time_s) / own_s, 1.0), _SLOWEST)
    return Heard(now_s, message, slowness, _period_s(before, now_s), new_s=now_s)


def _period_s(before: Heard, now_s: float) -> float | None:
    """A moving mean of the time from one new message to the next."""
    if before.new_s is None:
        return None
    period_s = now_s - before.new_s
    return period_s if before.period_s is None else before.period_s + _PERIOD_SHARE * (period_s - before.period_s)


@dataclass(frozen=True)
class Watched:
    """What is known of one drone."""

    fleet: str
    drone: str
    alive: bool = False
    """Its liveliness token is there: its process runs and can be reached."""
    topics: Mapping[str, Heard] = field(default_factory=dict)
    malformed: Mapping[str, str] = field(default_factory=dict)
    """What is wrong with the newest message of a topic, by topic; one that is well formed again is not here."""
    seen: bool = False
    """Something of it was well formed, or its token was there: it is a drone."""

    def message(self, topic: str, now_s: float) -> Mapping[str, Any] | None:
        """The newest of a topic; None where there is none, or one too old to say anything of now."""
        heard, stale_s = self.topics.get(topic), TOPICS[topic].stale_after_s
        if heard is None or (stale_s is not None and now_s - heard.time_s > stale_s * heard.slowness):
            return None
        return heard.message


@dataclass(frozen=True)
class HeardEvent:
    """Something that happened once to one drone, and when it was heard on the watcher's clock."""

    time_s: float
    fleet: str
    drone: str
    sentence: str


class FleetWatcher(SessionOwner):
    """Hears all that the drones of a fleet publish. Raises UnavailableError for an endpoint that cannot be used."""

    def __init__(
        self,
        fleet: str | None,
        *,
        listen: Sequence[str],
        connect: Sequence[str],
        settings: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``fleet``: None for every fleet that is heard."""
        self._clock = clock
        self._lock = threading.Lock()
        self._drones: dict[tuple[str, str], Watched] = {}
        self.malformed = 0
        """Messages that are none, and those of drones that cannot be."""
        self._events: deque[HeardEvent] = deque(maxlen=MAX_EVENTS)
        self._session = open_session("telemetry", listen, connect, settings=settings)
        self.queries = DroneQueries(self._session)
        """To the same drones."""
        drones = f"{PREFIX}/{'*' if fleet is None else checked_name(fleet)}/*"
        self._subscribers = [
            self._session.declare_subscriber(f"{drones}/{topic}", self._take_message) for topic in TOPICS
        ]
        self._tokens = self._session.liveliness().declare_subscriber(f"{drones}/alive", self._take_token, history=True)

    def drones(self) -> tuple[Watched, ...]:
        """All that were ever heard of."""
        with self._lock:
            return tuple(drone for drone in self._drones.values() if drone.seen)

    def events(self) -> tuple[HeardEvent, ...]:
        """The newest, in the order in which they came."""
        with self._lock:
            return tuple(self._events)

    def reached(self) -> int:
        """How many peers and routers it is connected to."""
        return len(self._session.info.peers_zid()) + len(self._session.info.routers_zid())

    def _take_message(self, sample: zenoh.Sample) -> None:
        """On a thread of zenoh's. What is malformed is kept as such, for a drone that is known otherwise."""
        fleet, drone, topic = str(sample.key_expr).split("/")[2:5]
        message, wrong = _parsed(sample.payload, topic)
        with self._lock:
            watched = self._watched(fleet, drone)
            if watched is None or wrong is not None:
                self.malformed += 1
            if watched is None:
                return
            if wrong is not None:
                malformed = {**watched.malformed, topic: wrong}
                self._drones[fleet, drone] = replace(watched, malformed=malformed)
                return
            heard = _heard(watched.topics.get(topic), self._clock(), message)
            if topic == "events":
                self._events.append(HeardEvent(heard.time_s, fleet, drone, message["event"]))
            malformed = {name: why for name, why in watched.malformed.items() if name != topic}
            self._drones[fleet, drone] = replace(
                watched, topics={**watched.topics, topic: heard}, malformed=malformed, seen=True
            )

    def _take_token(self, sample: zenoh.Sample) -> None:
        fleet, drone = str(sample.key_expr).split("/")[2:4]
        with self._lock:
            watched = self._watched(fleet, drone)
            if watched is None:
                self.malformed += 1
                return
            self._drones[fleet, drone] = replace(watched, alive=sample.kind == zenoh.SampleKind.PUT, seen=True)

    def _watched(self, fleet: str, drone: str) -> Watched | None:
        """What is known of a drone so far; None for one that cannot be, or is one too many."""
        known = self._drones.get((fleet, drone))
        if known is not None:
            return known
        if len(self._drones) >= MAX_DRONES or not (is_name(fleet) and is_name(drone)):
            return None
        return Watched(fleet, drone)


def _parsed(payload: zenoh.ZBytes, topic: str) -> tuple[dict[str, Any], str | None]:
    """A message, and what is wrong with it."""
    raw = payload.to_bytes()
    if len(raw) > MAX_BYTES:
        return {}, f"it is longer than {MAX_BYTES >> 10} KiB"
    try:
        message = json.loads(raw)
    except (ValueError, RecursionError):
        return {}, "it is not JSON"
    message = completed(message, TOPICS[topic].type)
    return message, fault(message, TOPICS[topic].type)
