"""Requests to the autopilot to take over from flockd: Hold, Return or Land."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from typing import Literal

from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink

Takeover = Literal["hold", "return", "land"]

POLL_S = 0.02
REPLY_S = 1.0
"""How long the autopilot may take to answer one request; its own repetitions are within."""
RETRY_S = 0.3
"""Between two requests for the same, where the first changed nothing."""
SAME_AGAIN_S = 30.0
"""Until the same answer is logged again: an autopilot that has died is asked about once a second, for ever."""


class AutopilotRequests:
    """Repeats the request that the control loop has set until the autopilot has complied."""

    def __init__(self, link: AutopilotLink, log_event: Callable[[str], None]) -> None:
        self._link, self._log_event = link, log_event
        self._logged, self._logged_s = "", -math.inf
        self.takeover: Takeover | None = None
        """The mode to request, set by the control loop; None: none."""
        self.asking = False
        """A request is under way; a landing takes two, and the first already ends offboard."""

    async def run(self) -> None:
        """Sends requests until cancelled."""
        asks: dict[Takeover, Callable[[], Awaitable[None]]] = {
            "hold": self._link.hold,
            "return": self._link.return_home,
            "land": self._link.land,
        }
        while True:
            takeover = self.takeover
            if takeover is None:
                self._logged = ""
                await asyncio.sleep(POLL_S)
                continue
            await self._ask(takeover, asks[takeover])
            await self._wait_for_another(takeover)

    async def _ask(self, takeover: Takeover, ask: Callable[[], Awaitable[None]]) -> None:
        self.asking = True
        try:
            async with asyncio.timeout(REPLY_S):
                await ask()
        except AutopilotError as error:
            self._log(str(error))
        except TimeoutError:
            self._log(f"the autopilot was asked for {takeover} and has not responded yet")
        else:
            self._log(f"the autopilot was asked for {takeover}, and agreed")
        finally:
            self.asking = False

    def _log(self, answer: str) -> None:
        """An event for an answer, unless it is the last one's repetition."""
        now_s = asyncio.get_running_loop().time()
        if answer != self._logged or now_s - self._logged_s >= SAME_AGAIN_S:
            self._logged, self._logged_s = answer, now_s
            self._log_event(answer)

    async def _wait_for_another(self, takeover: Takeover) -> None:
        loop = asyncio.get_running_loop()
        until = loop.time() + RETRY_S
        while self.takeover == takeover and loop.time() < until:
            await asyncio.sleep(POLL_S)
