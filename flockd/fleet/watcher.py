"""Watches a fleet's telemetry, for people. Code that flies does not import it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from flockd.fleet.drone_queries import DroneQueries
from flockd.onboard.message_json import from_json, parsed
from flockd.onboard.telemetry.topics import PREFIX, TOPICS, AnswerMessage, checked_name, is_name
from flockd.onboard.telemetry.zenoh_session import SessionOwner, close_session, open_session

MAX_BYTES = 1 << 15
"""Largest message: that of a drone with a hundred neighbours."""
MAX_DRONES = 200
"""Largest number of remembered drones, in case a sender invents names."""
FORGOTTEN_AT_ONCE = 20
MAX_EVENTS, MAX_EVENTS_OF_ONE = 500, 100
"""Numbers of remembered events: of all drones, and of one."""
MAX_LINK_BYTES = 1 << 20
"""zenoh's limit for one message."""
_PERIOD_SHARE = 0.2
"""Weight of the newest period in the mean."""
_SLOWEST = 10.0
"""Largest ratio of the watcher's time to a drone's: simulated time may be slow."""


@dataclass(frozen=True)
class Heard:
    """The newest message of one topic, and its arrival on the watcher's clock."""

    time_s: float
    message: Mapping[str, Any]
    slowness: float = 1.0
    """Seconds of the watcher's clock in a second of the drone's: a simulated drone's time may pass slowly."""
    period_s: float | None = None
    """Smoothed time between new messages, by the watcher's clock; None before the second message."""
    new_s: float | None = None
    """Arrival of the newest message that was not a repetition."""


def _heard(before: Heard | None, now_s: float, message: Mapping[str, Any]) -> Heard:
    """A message, with the speed of the drone's time since its last message."""
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
    """State of one drone."""

    fleet: str
    drone: str
    alive: bool = False
    """Whether its liveliness token exists: its process runs and can be reached."""
    topics: Mapping[str, Heard] = field(default_factory=dict)
    malformed: Mapping[str, str] = field(default_factory=dict)
    """Fault of the newest message of each topic, until a valid one comes."""
    seen: bool = False
    """Whether a valid message or a token of it was received."""
    identities: frozenset[str] = frozenset()
    """Identities of the current tokens: several if several drones have this name. Empty text: a drone of an earlier
    version."""
    announced: bool = False
    """Whether its token exists or existed."""
    messages: int = 0
    """Number of valid messages."""

    def message(self, topic: str, now_s: float) -> Mapping[str, Any] | None:
        """The newest message of a topic; None: there is none, or it is outdated."""
        heard, stale_s = self.topics.get(topic), TOPICS[topic].stale_after_s
        if heard is None or (stale_s is not None and now_s - heard.time_s > stale_s * heard.slowness):
            return None
        return heard.message


@dataclass(frozen=True)
class HeardEvent:
    """An event of one drone, and its arrival on the watcher's clock."""

    time_s: float
    fleet: str
    drone: str
    sentence: str


class FleetWatcher(SessionOwner):
    """Receives all messages of a fleet's drones. Raises UnavailableError for an unusable endpoint."""

    def __init__(
        self,
        fleet: str | None,
        *,
        listen: Sequence[str],
        connect: Sequence[str],
        settings: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``fleet``: None: all fleets."""
        self._clock = clock
        self._lock = threading.Lock()
        self._drones: dict[tuple[str, str], Watched] = {}
        self.malformed = 0
        """Number of malformed messages, and of those of impossible drones."""
        self.forgotten = 0
        """Number of names that were deleted to make room for others."""
        self._events: deque[HeardEvent] = deque(maxlen=MAX_EVENTS)
        connected = partial(open_session, settings=settings, max_message_bytes=MAX_LINK_BYTES)
        self._session = connected("telemetry", listen, connect)
        # Drones that connect here have one connection; to those that this computer connects to, orders have their own.
        self._orders = connected("orders", [], connect) if connect and not listen else self._session
        self.queries = DroneQueries(self._session, self._orders)
        """To the same drones."""
        drones = f"{PREFIX}/{'*' if fleet is None else checked_name(fleet)}/*"
        heard = self._session.declare_subscriber
        self._subscribers = [heard(f"{drones}/{topic}", self._take_message) for topic in TOPICS]
        tokens = self._session.liveliness()
        self._tokens = tokens.declare_subscriber(f"{drones}/alive/**", self._take_token, history=True)

    def queries_under(self, prefix: str) -> DroneQueries:
        """Queries to programs that reply like drones, under other keys."""
        return DroneQueries(self._session, self._orders, prefix)

    def close(self) -> None:
        """Ends both connections."""
        if self._orders is not self._session:
            close_session(self._orders)
        super().close()

    def ask(
        self, drone: str, command: str, operator: str, order: Mapping[str, object] | None = None
    ) -> AnswerMessage | None:
        """A drone's answer to an operator's command, by its key `fleet/drone`; None: no answer.

        The command is refused here if several drones have the name.
        """
        fleet, _, name = drone.partition("/")
        with self._lock:
            watched = self._drones.get((fleet, name))
        if watched is None or not watched.seen:
            return AnswerMessage(accepted=False, sentence="no drone of this name was heard")
        if len(watched.identities) > 1:
            return AnswerMessage(accepted=False, sentence=f"nothing was sent: {ambiguity(watched)}")
        identity = next(iter(watched.identities), "")
        return self.queries.ask(drone, identity, command, operator, order)

    def drones(self) -> tuple[Watched, ...]:
        """All drones that were ever heard."""
        with self._lock:
            return tuple(drone for drone in self._drones.values() if drone.seen)

    def events(self) -> tuple[HeardEvent, ...]:
        """The newest events, in the order of arrival."""
        with self._lock:
            return tuple(self._events)

    def reached(self) -> int:
        """Number of connected peers and routers."""
        return len(self._session.info.peers_zid()) + len(self._session.info.routers_zid())

    def _take_message(self, sample: zenoh.Sample) -> None:
        """Called on a thread of zenoh's. For a known drone, a malformed message is kept as a fault."""
        fleet, drone, topic = str(sample.key_expr).split("/")[2:5]
        message, wrong = _parsed(sample.payload, topic)
        with self._lock:
            if wrong is not None:
                self.malformed += 1
                known = self._drones.get((fleet, drone))
                if known is not None:
                    self._drones[fleet, drone] = replace(known, malformed={**known.malformed, topic: wrong})
                return
            watched = self._watched(fleet, drone)
            if watched is None:
                return
            heard = _heard(watched.topics.get(topic), self._clock(), message)
            if topic == "events":
                self._remember(HeardEvent(heard.time_s, fleet, drone, message["event"]))
            self._drones[fleet, drone] = replace(
                watched,
                topics={**watched.topics, topic: heard},
                malformed={name: why for name, why in watched.malformed.items() if name != topic},
                seen=True,
                messages=watched.messages + 1,
            )

    def _take_token(self, sample: zenoh.Sample) -> None:
        fleet, drone, _, *identity = str(sample.key_expr).split("/")[2:]
        with self._lock:
            watched = self._watched(fleet, drone)
            if watched is None:
                return
            one = frozenset({identity[0] if identity else ""})
            there = sample.kind == zenoh.SampleKind.PUT
            identities = watched.identities | one if there else watched.identities - one
            self._drones[fleet, drone] = replace(
                watched, alive=bool(identities), identities=identities, announced=True, seen=True
            )

    def _watched(self, fleet: str, drone: str) -> Watched | None:
        """The state of a drone; None: its name is impossible."""
        known = self._drones.get((fleet, drone))
        if known is not None:
            return known
        if not (is_name(fleet) and is_name(drone)):
            self.malformed += 1
            return None
        if len(self._drones) >= MAX_DRONES:
            # Those of which least is known: who invents names says little under each.
            for key in sorted(self._drones, key=lambda key: _standing(self._drones[key]))[:FORGOTTEN_AT_ONCE]:
                del self._drones[key]
            self.forgotten += FORGOTTEN_AT_ONCE
        return Watched(fleet, drone)

    def _remember(self, event: HeardEvent) -> None:
        """Keeps each drone's events, however many another drone sends."""
        of_one = [old for old in self._events if (old.fleet, old.drone) == (event.fleet, event.drone)]
        if len(of_one) >= MAX_EVENTS_OF_ONE:
            self._events.remove(of_one[0])
        self._events.append(event)


def ambiguity(drone: Watched) -> str | None:
    """A sentence if several drones have one name; None: the name is unique."""
    if len(drone.identities) < 2:
        return None
    identities = ", ".join(sorted(identity or "of an earlier version" for identity in drone.identities))
    return (
        f"{len(drone.identities)} drones call themselves {drone.drone} ({identities:.80}), and what they tell is "
        "mixed; give each its own `name` in its configuration"
    )


def _standing(drone: Watched) -> tuple[bool, bool, int, float]:
    """Sort key: the drone with the least is deleted first."""
    last_s = max((heard.time_s for heard in drone.topics.values()), default=0.0)
    return drone.alive, drone.announced, drone.messages, last_s


def _parsed(payload: zenoh.ZBytes, topic: str) -> tuple[dict[str, Any], str | None]:
    """A message, or its fault."""
    raw = payload.to_bytes()
    if len(raw) > MAX_BYTES:
        return {}, f"it is longer than {MAX_BYTES >> 10} KiB"
    try:
        message = parsed(raw)
    except ValueError:
        return {}, "it is not JSON"
    try:
        return from_json(TOPICS[topic].type, message), None
    except ValueError as error:
        return {}, str(error)
