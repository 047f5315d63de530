"""Watches a fleet: for the commands of people. Nothing that flies imports this."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import zenoh

from flockd.telemetry.topics import PREFIX, TOPICS, checked_name
from flockd.zenoh_session import SessionOwner, open_session

_SLOWEST = 10.0
"""The smallest speed factor that a daemon's configuration allows is 0.1."""


@dataclass(frozen=True)
class Heard:
    """The newest message of one topic, and when it came on the watcher's clock."""

    time_s: float
    message: Mapping[str, Any]
    slowness: float = 1.0
    """Seconds of the watcher's clock in one of the drone's: a simulated drone's time may pass slowly."""


def _heard(before: Heard | None, now_s: float, message: Mapping[str, Any]) -> Heard:
    """With how slowly the drone's time passed since its message before."""
    if before is None:
        return Heard(now_s, message, _SLOWEST)  # not known yet
    own_s = message.get("time_s", 0.0) - before.message.get("time_s", 0.0)
    if own_s <= 0:
        return Heard(now_s, message, before.slowness)  # sent once more, or begun again
    return Heard(now_s, message, min(max((now_s - before.time_s) / own_s, 1.0), _SLOWEST))


@dataclass(frozen=True)
class Watched:
    """What is known of one drone."""

    fleet: str
    drone: str
    alive: bool = False
    """Its liveliness token is there: its process runs and can be reached."""
    topics: Mapping[str, Heard] = field(default_factory=dict)

    def message(self, topic: str, now_s: float) -> Mapping[str, Any] | None:
        """The newest of a topic; None where there is none, or one too old to say anything of now."""
        heard, stale_s = self.topics.get(topic), TOPICS[topic].stale_after_s
        if heard is None or (stale_s is not None and now_s - heard.time_s > stale_s * heard.slowness):
            return None
        return heard.message


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
        """Messages that are none."""
        self._session = open_session("telemetry", listen, connect, settings=settings)
        drones = f"{PREFIX}/{'*' if fleet is None else checked_name(fleet)}/*"
        self._subscribers = [
            self._session.declare_subscriber(f"{drones}/{topic}", self._take_message) for topic in TOPICS
        ]
        self._tokens = self._session.liveliness().declare_subscriber(f"{drones}/alive", self._take_token, history=True)

    def drones(self) -> tuple[Watched, ...]:
        """All that were ever heard of."""
        with self._lock:
            return tuple(self._drones.values())

    def reached(self) -> int:
        """How many peers and routers it is connected to."""
        return len(self._session.info.peers_zid()) + len(self._session.info.routers_zid())

    def _take_message(self, sample: zenoh.Sample) -> None:
        """On a thread of zenoh's."""
        fleet, drone, topic = str(sample.key_expr).split("/")[2:5]
        try:
            message = json.loads(sample.payload.to_bytes())
        except ValueError:
            message = None
        if not isinstance(message, dict) or not TOPICS[topic].type.__annotations__.keys() <= message.keys():
            self.malformed += 1
            return
        with self._lock:
            watched = self._drones.get((fleet, drone), Watched(fleet, drone))
            heard = _heard(watched.topics.get(topic), self._clock(), message)
            topics = {**watched.topics, topic: heard}
            self._drones[fleet, drone] = replace(watched, topics=topics)

    def _take_token(self, sample: zenoh.Sample) -> None:
        fleet, drone = str(sample.key_expr).split("/")[2:4]
        with self._lock:
            watched = self._drones.get((fleet, drone), Watched(fleet, drone))
            self._drones[fleet, drone] = replace(watched, alive=sample.kind == zenoh.SampleKind.PUT)
