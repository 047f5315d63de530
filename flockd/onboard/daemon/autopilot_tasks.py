"""What the daemon exchanges with the autopilot besides setpoints: takeovers, texts, and reasons to refuse."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Literal

from flockd.flight.safety import Decision, State
from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink, Severity
from flockd.onboard.autopilot.refusals import Refusal

Takeover = Literal["hold", "return", "land"]

POLL_S = 0.02
REPLY_S = 1.0
"""Longest time for the autopilot's reply to one request, with its own repetitions."""
RETRY_S = 0.3
"""Time before a request that changed nothing is repeated."""
FROM_HOLD_S = 5.0
"""Longest time for which landing or return is requested from the Hold that comes before it."""
SAME_AGAIN_S = 30.0
"""Time before the same answer is logged again: a dead autopilot is asked once a second, for ever."""


class AutopilotRequests:
    """Repeats the control loop's request until the autopilot has complied."""

    def __init__(self, link: AutopilotLink, log_event: Callable[[str], None]) -> None:
        self._link, self._log_event = link, log_event
        self._logged, self._logged_s = "", -math.inf
        self.takeover: Takeover | None = None
        """The mode to request, set by the control loop; None: no request."""
        self.asking = False
        """Whether a request is in progress; a landing takes two, and the first already ends offboard."""

    async def run(self) -> None:
        """Sends requests until cancelled."""
        asks: dict[Takeover, Callable[[], Awaitable[None]]] = {
            "hold": self._link.hold,
            "return": self._link.return_home,
            "land": self._link.land,
        }
        now = asyncio.get_running_loop().time
        while True:
            takeover = self.takeover
            if takeover is None:
                self._logged = ""
                await asyncio.sleep(POLL_S)
                continue
            until_s, self.asking = now() + FROM_HOLD_S, True
            agreed = await self._agrees(takeover, asks[takeover])
            # Hold ends the flight, and the control loop's request with it. Any other mode is the pilot's choice.
            while not agreed and takeover != "hold" and self._holds() and now() < until_s:
                await asyncio.sleep(RETRY_S)
                agreed = self._holds() and await self._agrees(takeover, asks[takeover])
            self.asking = False
            await self._wait_for_another(takeover)

    def _holds(self) -> bool:
        return self._link.status().flight_mode == "hold"

    async def _agrees(self, takeover: Takeover, ask: Callable[[], Awaitable[None]]) -> bool:
        """Sends one request, and logs the answer."""
        try:
            async with asyncio.timeout(REPLY_S):
                await ask()
        except AutopilotError as error:
            self._log(str(error))
        except TimeoutError:
            self._log(f"the autopilot was asked for {takeover} and has not responded yet")
        else:
            self._log(f"the autopilot was asked for {takeover}, and agreed")
            return True
        return False

    def _log(self, answer: str) -> None:
        """Logs an answer as an event, unless it repeats the last one."""
        now_s = asyncio.get_running_loop().time()
        if answer != self._logged or now_s - self._logged_s >= SAME_AGAIN_S:
            self._logged, self._logged_s = answer, now_s
            self._log_event(answer)

    async def _wait_for_another(self, takeover: Takeover) -> None:
        loop = asyncio.get_running_loop()
        until = loop.time() + RETRY_S
        while self.takeover == takeover and loop.time() < until:
            await asyncio.sleep(POLL_S)


EVERY_S = 2.0
"""Time between two texts, except for a graver one: states that pass in between are not sent."""

SEVERITIES: Mapping[State, Severity] = {
    State.IDLE: Severity.INFO,
    State.READY: Severity.INFO,
    State.NORMAL: Severity.INFO,
    State.DEGRADED: Severity.NOTICE,
    State.HOVER: Severity.WARNING,
    State.ASKING: Severity.CRITICAL,
    State.SILENT: Severity.WARNING,
}


class StateTexts:
    """Sends each new state once, the newest if several came too quickly."""

    def __init__(self, send: Callable[[str, Severity], None], clock: Callable[[], float]) -> None:
        self._send, self._clock = send, clock
        self._told: State | None = None
        self._told_s = -math.inf

    def update(self, decision: Decision) -> None:
        """Takes the supervisor's decision; call it at each tick."""
        state, now_s = decision.state, self._clock()
        if state is self._told:
            return
        severity = SEVERITIES[state]
        graver = self._told is None or severity < SEVERITIES[self._told]
        if graver or now_s - self._told_s >= EVERY_S:
            self._told, self._told_s = state, now_s
            self._send(f"flockd {state_sentence(decision)}", severity)


def state_sentence(decision: Decision) -> str:
    """The state, and its reason."""
    reasons = "; ".join(reason.sentence for reason in decision.reasons)
    return f"{decision.state}: {reasons}" if reasons else str(decision.state)


CHECKS_POLL_S = 0.5
ASK_AGAIN_S = 10.0
"""Time between two requests for the list of failed checks if the first one brought none."""
LOG_AGAIN_S = 60.0
"""Time before a recurring reason is logged again."""


class RefusalWatch:
    """Requests the list of failed checks if it is missing, and logs each new reason."""

    def __init__(self, link: AutopilotLink, log_event: Callable[[str], None], clock: Callable[[], float]) -> None:
        self._link, self._log_event, self._clock = link, log_event, clock
        self._seen_s: dict[str, float] = {}
        self.current: tuple[Refusal, ...] = ()
        """The reasons of the last half second, the cause first."""

    async def run(self) -> None:
        """Watches until cancelled."""
        asked_s = -math.inf
        while True:
            now = self._clock()
            self.current = self._link.refusals()
            for refusal in self.current:
                if now - self._seen_s.get(refusal.reason, -math.inf) >= LOG_AGAIN_S:
                    self._log_event(refusal.sentence)
                self._seen_s[refusal.reason] = now
            # Only on the ground. After lost events, `AutopilotLink.attend` asks too, also in flight.
            if not self._link.knows_checks() and not self._link.status().armed and now - asked_s >= ASK_AGAIN_S:
                asked_s = now
                with suppress(AutopilotError, TimeoutError):
                    async with asyncio.timeout(ASK_AGAIN_S):
                        await self._link.ask_for_checks()
            await asyncio.sleep(CHECKS_POLL_S)
