"""Commands of operators, as they arrive by signal or telemetry, and what the supervisor sees of them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Protocol

from flockd.core.messages import MissionOrder
from flockd.onboard.telemetry.order_messages import parse_order
from flockd.onboard.telemetry.topics import AnswerMessage

ORDERS = frozenset({"goto", "velocity"})
"""Commands that change the mission."""


@dataclass
class OperatorRequests:
    """What operators have requested, and whether the autopilot has refused offboard mode."""

    shutdown: bool = False
    hold: bool = False
    land: bool = False
    resume: bool = False
    """Counts once: reset when the supervisor has seen it. So does the next."""
    offboard_refused: bool = False

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


def command_handler(
    allowed: Collection[str],
    requests: OperatorRequests,
    missions: Missions,
    loop: asyncio.AbstractEventLoop,
    log_event: Callable[[str], None],
) -> Callable[[str, bytes], AnswerMessage]:
    """A function that accepts or refuses a command on any thread, and applies it on the event loop."""

    def refused(sentence: str) -> AnswerMessage:
        log_event(f"an operator's command was refused: {sentence}")
        return AnswerMessage(accepted=False, sentence=sentence)

    def handle(command: str, payload: bytes) -> AnswerMessage:
        if command not in allowed:
            return refused(f"{command!r} is not allowed here; telemetry.commands allows {', '.join(allowed) or 'none'}")
        if command in ORDERS:
            try:
                order = parse_order(command, payload)
            except ValueError as error:
                return refused(str(error))
            fault = missions.fault(order)
            if fault is not None:
                return refused(fault)
            loop.call_soon_threadsafe(missions.apply, order)
        else:
            loop.call_soon_threadsafe(requests.apply, command)
        log_event(f"an operator asked for {command}")
        return AnswerMessage(accepted=True, sentence=f"{command} is being tried; the drone's state shows the result")

    return handle
