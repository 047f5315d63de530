"""Commands of operators, as they arrive by signal or telemetry, and what the supervisor sees of them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from dataclasses import dataclass

from flockd.telemetry.topics import AnswerMessage


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


def command_handler(
    allowed: Collection[str],
    requests: OperatorRequests,
    loop: asyncio.AbstractEventLoop,
    log_event: Callable[[str], None],
) -> Callable[[str], AnswerMessage]:
    """A function that accepts or refuses a command on any thread, and applies it on the event loop."""

    def handle(command: str) -> AnswerMessage:
        if command not in allowed:
            sentence = f"{command!r} is not allowed here; telemetry.commands allows {', '.join(allowed) or 'none'}"
            log_event(f"an operator's command was refused: {sentence}")
            return AnswerMessage(accepted=False, sentence=sentence)
        loop.call_soon_threadsafe(requests.apply, command)
        log_event(f"an operator asked for {command}")
        return AnswerMessage(accepted=True, sentence=f"{command} is being tried; the topic `flight` shows the result")

    return handle
