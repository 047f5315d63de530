"""Commands of operators, as they arrive by signal or telemetry, and what the supervisor sees of them."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Protocol

from flockd.core.messages import MissionOrder
from flockd.onboard.daemon.order_checks import OrderChecks, TakenOrder
from flockd.onboard.telemetry.order_messages import parse_ask, parse_order
from flockd.onboard.telemetry.topics import AnswerMessage, AskMessage, TakenOrderMessage

ORDERS = frozenset({"goto", "velocity"})
"""Commands that change the mission."""


@dataclass
class OperatorRequests:
    """What operators have requested."""

    shutdown: bool = False
    hold: bool = False
    land: bool = False
    resume: bool = False
    """Counts once: reset when the supervisor has seen it. So does the next."""

    def apply(self, command: str) -> None:
        """Sets the request of one command: hold, land or resume; it replaces an earlier one."""
        self.hold = command == "hold"
        self.land = command == "land"
        self.resume = command == "resume"


class Missions(Protocol):
    """What takes an operator's orders to the mission."""

    def fault(self, order: MissionOrder) -> str | None:
        """Why it is refused; None: it is not. On any thread."""

    def apply(self, order: MissionOrder) -> None:
        """Has the pilot take it in its next step. On the event loop."""


class OperatorCommands:
    """Accepts or refuses a command on any thread, and applies it on the event loop.

    However many come, their events fill neither the log nor the recording: what is said too often is counted.
    """

    def __init__(
        self,
        allowed: Collection[str],
        requests: OperatorRequests,
        missions: Missions,
        loop: asyncio.AbstractEventLoop,
        log_event: Callable[[str], None],
        *,
        identity: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``identity`` and ``clock``: those that the drone tells its watchers."""
        self._allowed, self._requests, self._missions, self._loop = allowed, requests, missions, loop
        self._checks, self._clock = OrderChecks(identity, clock), clock
        self._taken = _Limited(log_event, burst=60, refill_s=1.0, clock=clock)
        self._refusals = _Limited(log_event, burst=10, refill_s=60.0, clock=clock)
        self.refused = 0
        """Since the start."""

    def handle(self, command: str, payload: bytes) -> AnswerMessage:
        """The answer to a command, by its name and what its query carries."""
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
        return AnswerMessage(accepted=True, sentence=f"{command} is being tried; the drone's state shows the result")

    def recent(self) -> list[TakenOrderMessage]:
        """For telemetry: the last order of each operator of the last minute, the newest first."""
        now_s = self._clock()
        return [taken_message(order, now_s) for order in self._checks.recent()]

    def _apply(self, command: str, ask: AskMessage) -> None:
        """Raises ValueError with the reason for which it is refused."""
        order = parse_order(command, ask["order"]) if command in ORDERS else None
        fault = self._checks.fault(command, ask) or (None if order is None else self._missions.fault(order))
        if fault is not None:
            raise ValueError(fault)
        self._checks.take(command, ask)
        if order is not None:
            self._loop.call_soon_threadsafe(self._missions.apply, order)
        else:
            self._loop.call_soon_threadsafe(self._requests.apply, command)


def taken_message(order: TakenOrder, now_s: float) -> TakenOrderMessage:
    """As telemetry has it; ``now_s``: on the clock by which it was taken."""
    return TakenOrderMessage(
        operator=order.operator, command=order.command, sequence=order.sequence, age_s=now_s - order.taken_s
    )


class _Limited:
    """Passes on events up to a number at once and one more every ``refill_s``; the next one counts the others."""

    def __init__(
        self, log_event: Callable[[str], None], *, burst: int, refill_s: float, clock: Callable[[], float]
    ) -> None:
        self._log_event, self._burst, self._refill_s, self._clock = log_event, burst, refill_s, clock
        self._lock = threading.Lock()
        self._left, self._filled_s, self._unsaid = float(burst), clock(), 0

    def tell(self, sentence: str) -> None:
        """Passes it on, or counts it."""
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
