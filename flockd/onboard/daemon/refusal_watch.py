"""Keeps an eye on why the autopilot would refuse to arm or to fly offboard: for telemetry, and for the log."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterable

from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.refusals import Refusal

POLL_S = 0.5
ASK_AGAIN_S = 10.0
"""Between two requests for the list of failed checks, where the first brought none."""
LOG_AGAIN_S = 60.0
"""Until a reason that comes and goes is logged again."""


class RefusalWatch:
    """Asks for the list of failed checks where it is missing, and logs each new reason."""

    def __init__(self, link: AutopilotLink, log_event: Callable[[str], None], clock: Callable[[], float]) -> None:
        self._link, self._clock = link, clock
        self._log = RefusalLog(log_event)
        self._asked_s = -math.inf
        self.current: tuple[Refusal, ...] = ()
        """As of the last half second, the cause first."""

    async def run(self) -> None:
        """Watches until cancelled."""
        while True:
            now = self._clock()
            self.current = self._link.refusals()
            self._log.update(self.current, now)
            if self._must_ask(now):
                self._asked_s = now
                await self._ask()
            await asyncio.sleep(POLL_S)

    def _must_ask(self, now_s: float) -> bool:
        """In flight nothing is asked: the list is for those who want to begin one."""
        return not self._link.knows_checks() and not self._link.status().armed and now_s - self._asked_s >= ASK_AGAIN_S

    async def _ask(self) -> None:
        try:
            async with asyncio.timeout(ASK_AGAIN_S):
                await self._link.ask_for_checks()
        except (AutopilotError, TimeoutError):
            return  # a firmware without such a list; single messages tell the reasons then


class RefusalLog:
    """Logs each reason when it comes, and not again while it comes and goes."""

    def __init__(self, log_event: Callable[[str], None]) -> None:
        self._log_event = log_event
        self._seen_s: dict[str, float] = {}

    def update(self, refusals: Iterable[Refusal], now_s: float) -> None:
        """Takes all that hold now."""
        for refusal in refusals:
            if now_s - self._seen_s.get(refusal.reason, -math.inf) >= LOG_AGAIN_S:
                self._log_event(refusal.sentence)
            self._seen_s[refusal.reason] = now_s
