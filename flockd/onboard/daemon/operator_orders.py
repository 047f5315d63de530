"""Operators' orders: checks that each is for this drone, allowed, new and in time, and passes it on."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple

from flockd.core import services
from flockd.core.messages import MissionOrder
from flockd.flight.safety import FLYING, State
from flockd.onboard.telemetry.order_messages import parse_ask, parse_order
from flockd.onboard.telemetry.topics import AnswerMessage, AskMessage, TakenOrderMessage

ORDERS = frozenset({"goto", "velocity"})
"""Commands that change the mission."""
_TAKES_ORDERS = FLYING - {State.ASKING}
_NOT_FLYING = "flockd does not fly the drone now, as its state is {}"


@dataclass
class OperatorRequests:
    """Requests of operators to the supervisor."""

    shutdown: bool = False
    hold: bool = False
    land: bool = False
    resume: bool = False
    """Counts once: reset after the supervisor has seen it, like the next one."""

    def apply(self, command: str) -> None:
        """Takes one command, hold, land or resume; it replaces an earlier one."""
        self.hold = command == "hold"
        self.land = command == "land"
        self.resume = command == "resume"


class OperatorCommands:
    """Accepts or refuses a command on any thread, and applies it on the event loop.

    A flood of commands fills neither the log nor the recording: repeated events are only counted.
    """

    def __init__(
        self,
        allowed: Collection[str],
        requests: OperatorRequests,
        loop: asyncio.AbstractEventLoop,
        log_event: Callable[[str], None],
        *,
        order_fault: Callable[[MissionOrder], str | None],
        fly: Callable[[MissionOrder], None],
        state: Callable[[], State],
        identity: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``order_fault``: why the mission refuses an order, on any thread; ``fly``: passes one to the pilot's next
        step, on the event loop; ``state``: the supervisor's, on any thread; ``identity`` and ``clock``: those that the
        drone publishes."""
        self._allowed, self._requests, self._loop = allowed, requests, loop
        self._order_fault, self._fly, self._state = order_fault, fly, state
        self._checks = OrderChecks(identity, clock)
        self.recent = self._checks.recent
        self._taken = _Limited(log_event, burst=60, refill_s=1.0, clock=clock)
        self._refusals = _Limited(log_event, burst=10, refill_s=60.0, clock=clock)
        self.refused = 0
        """Commands refused since the start."""

    def handle(self, command: str, payload: bytes) -> AnswerMessage:
        """The answer to a command, by its name and the payload of its query."""
        operator = ""
        try:
            if command not in self._allowed:
                allowed = ", ".join(self._allowed) or "none"
                raise ValueError(f"{command!r:.40} is not allowed here; telemetry.commands allows {allowed}")  # noqa: TRY301
            ask = parse_ask(payload)
            operator = f" of {ask['operator']}"
            self._apply(command, ask)
        except ValueError as error:
            self.refused += 1
            self._refusals.tell(f"an operator's command{operator} was refused: {error}")
            return AnswerMessage(accepted=False, sentence=str(error))
        self._taken.tell(f"an operator asked for {command}: {ask['operator']}, order {ask['sequence']}")
        sentence = f"{command} is being tried; the drone's state shows the result"
        if command in SAFE and (state := self._state()) not in FLYING:
            sentence = f"{_NOT_FLYING.format(state)}: the pilot has to do it; flockd begins no flight before `resume`"
        return AnswerMessage(accepted=True, sentence=sentence)

    def _apply(self, command: str, ask: AskMessage) -> None:
        """Applies a command. Raises ValueError with the reason if it is refused."""
        order = parse_order(command, ask["order"]) if command in ORDERS else None
        fault = self._checks.fault(command, ask)
        if order is not None and fault is None:
            told = f"{_NOT_FLYING.format(state := self._state())}; its mission begins with the flight"
            fault = self._order_fault(order) if state in _TAKES_ORDERS else told
        if fault is not None:
            raise ValueError(fault)
        self._checks.take(command, ask)
        if order is not None:
            self._loop.call_soon_threadsafe(self._fly, order)
        else:
            self._loop.call_soon_threadsafe(self._requests.apply, command)


class _Limited:
    """Passes on a number of events at once and then one every ``refill_s``; the next one counts those left out."""

    def __init__(
        self, log_event: Callable[[str], None], *, burst: int, refill_s: float, clock: Callable[[], float]
    ) -> None:
        self._log_event, self._burst, self._refill_s, self._clock = log_event, burst, refill_s, clock
        self._lock = threading.Lock()
        self._left, self._filled_s, self._unsaid = float(burst), clock(), 0

    def tell(self, sentence: str) -> None:
        """Passes an event on, or counts it."""
        with self._lock:
            now_s = self._clock()
            self._left = min(self._left + (now_s - self._filled_s) / self._refill_s, float(self._burst))
            self._filled_s = now_s
            if self._left < 1.0:
                self._unsaid += 1
                return
            self._left -= 1.0
            unsaid, self._unsaid = self._unsaid, 0
        self._log_event(f"{sentence} (and {unsaid} more before, which were not logged)" if unsaid else sentence)


LATEST_S = services.ORDER.timeout
"""Greatest age of an order; an older one may surprise its operator. A sender asks for the drone's clock just before."""
AHEAD_S = 0.5
"""Largest time of an order after now: the sender's clock runs on while the order travels."""
MOST_SESSIONS = 1000
SAFE = frozenset({"hold", "land"})
"""Accepted even after another operator's later order: they end a flight."""
RECENT_S, MOST_RECENT = 60.0, 8


class _Taken(NamedTuple):
    operator: str
    command: str
    sequence: int
    taken_s: float


class OrderChecks:
    """Checks orders, on any thread."""

    def __init__(self, identity: str, clock: Callable[[], float]) -> None:
        """``identity``: the drone's; ``clock``: the one that it publishes."""
        self._identity, self._clock = identity, clock
        self._lock = threading.Lock()
        self._sequences: OrderedDict[str, int] = OrderedDict()
        self._newest: tuple[float, _Taken] | None = None
        self._recent: dict[str, _Taken] = {}

    def fault(self, command: str, ask: AskMessage) -> str | None:
        """Why an order is refused, for its sender; None: it is accepted, and its number counts as used from now on."""
        if ask["identity"] != self._identity:
            return f"it is for another drone of this name, with the identity {ask['identity']!r:.20}"
        age_s = self._clock() - ask["time_s"]
        if not -AHEAD_S <= age_s <= LATEST_S:
            early = f"is from {age_s:.1f} s ago" if age_s > 0 else f"is from {-age_s:.1f} s ahead of the drone's clock"
            return f"it {early}; an order counts for {LATEST_S:g} s; give it again"
        with self._lock:
            if ask["sequence"] <= self._sequences.get(ask["session"], -1):
                return f"order {ask['sequence']} or a later one of this sender has come before"
            self._sequences[ask["session"]] = ask["sequence"]
            self._sequences.move_to_end(ask["session"])
            while len(self._sequences) > MOST_SESSIONS:
                self._sequences.popitem(last=False)
            if self._newest is not None and ask["time_s"] < self._newest[0] and command not in SAFE:
                later = self._newest[1]
                return f"{later.operator} gave a later order, {later.command}, that has come before"
        return None

    def take(self, command: str, ask: AskMessage) -> None:
        """Notes that an order is carried out."""
        taken = _Taken(ask["operator"], command, ask["sequence"], self._clock())
        with self._lock:
            if self._newest is None or ask["time_s"] >= self._newest[0]:
                self._newest = ask["time_s"], taken
            self._recent = {name: one for name, one in self._recent.items() if name != taken.operator}
            self._recent[taken.operator] = taken
            while len(self._recent) > MOST_RECENT:
                self._recent.pop(next(iter(self._recent)))

    def recent(self) -> list[TakenOrderMessage]:
        """The last order of each operator within `RECENT_S`, the newest first, for telemetry."""
        now_s = self._clock()
        with self._lock:
            taken = [(*one[:3], now_s - one.taken_s) for one in reversed(self._recent.values())]
        return [
            TakenOrderMessage(operator=operator, command=command, sequence=sequence, age_s=age_s)
            for operator, command, sequence, age_s in taken
            if age_s <= RECENT_S
        ]
