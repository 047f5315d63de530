"""Asks the autopilot for what the control loop wants: to take over, or, where configured, to arm and take off."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Literal

from flockd.autopilot.mavsdk_link import AutopilotLink
from flockd.autopilot.status import AutopilotError
from flockd.autopilot.streamer import SetpointStreamer
from flockd.daemon.inspection import Asked
from flockd.safety import Decision, Event, State

Wish = Literal["hold", "return", "land"]

LOOK_S = 0.02
ANSWER_S = 1.0
"""How long the autopilot may take to answer one request; its own repetitions are within."""
AGAIN_S = 0.3
"""Between two requests for the same, where the first changed nothing."""
ARM_AGAIN_S = 2.0
SETPOINTS_FIRST = 10
"""The autopilot takes offboard only from who sends setpoints already."""
NOTHING_TO_SEE_FROM_THE_GROUND = frozenset(
    {Event.NOT_OFFBOARD, Event.NOT_ARMED, Event.NOT_IN_AIR, Event.HEIGHTS_LEFT, Event.NEIGHBOURS_LOST}
    | {Event.EGO_MOTION_POOR, Event.EGO_MOTION_LOST}
)
"""What may be the matter with a drone that stands on the ground and is about to take off."""


class Requests:
    """Sees to it that the autopilot takes over when it shall."""

    def __init__(self, link: AutopilotLink, tell: Callable[[str], None]) -> None:
        self._link, self._tell = link, tell
        self.wish: Wish | None = None
        """Set by the control loop; None: nothing."""
        self.asking = False
        """A request is under way; a landing takes two, and the first already ends offboard."""

    async def run(self) -> None:
        """Asks for ever, whenever there is something to ask for."""
        asks: dict[Wish, Callable[[], Awaitable[None]]] = {
            "hold": self._link.hold,
            "return": self._link.return_home,
            "land": self._link.land,
        }
        while True:
            wish = self.wish
            if wish is None:
                await asyncio.sleep(LOOK_S)
                continue
            await self._ask(wish, asks[wish])
            await self._wait_for_another(wish)

    async def _ask(self, wish: Wish, ask: Callable[[], Awaitable[None]]) -> None:
        self.asking = True
        try:
            async with asyncio.timeout(ANSWER_S):
                await ask()
        except AutopilotError as error:
            self._tell(str(error))
        except TimeoutError:
            self._tell(f"the autopilot was asked for {wish} and has not answered yet")
        else:
            self._tell(f"the autopilot was asked for {wish}, and agreed")
        finally:
            self.asking = False

    async def _wait_for_another(self, wish: Wish) -> None:
        loop = asyncio.get_running_loop()
        until = loop.time() + AGAIN_S
        while self.wish == wish and loop.time() < until:
            await asyncio.sleep(LOOK_S)


class TakeOff:
    """Brings the drone up by itself and switches to offboard, once; only made where the configuration says so."""

    def __init__(
        self,
        link: AutopilotLink,
        streamer: SetpointStreamer,
        asked: Asked,
        decision: Callable[[], Decision],
        tell: Callable[[str], None],
    ) -> None:
        self._link, self._streamer, self._asked = link, streamer, asked
        self._decision, self._tell = decision, tell

    async def run(self) -> None:
        """Takes off, and then stays to do nothing."""
        await self._until(self._is_ready_on_the_ground)
        await self._arm()
        try:
            await self._link.take_off()
            await self._until(self._is_up)
            sent = self._streamer.report().sent
            await self._until(lambda: self._streamer.report().sent >= sent + SETPOINTS_FIRST)
            await self._link.request_offboard()
        except AutopilotError as error:
            self._tell(str(error))
            self._asked.offboard_refused = True
        await asyncio.Event().wait()

    async def _arm(self) -> None:
        """An autopilot that has just started refuses for some seconds."""
        told = ""
        while True:
            try:
                await self._link.arm()
            except AutopilotError as error:
                if str(error) != told:
                    told = str(error)
                    self._tell(told)
                await asyncio.sleep(ARM_AGAIN_S)
                await self._until(self._is_ready_on_the_ground)
            else:
                return

    def _is_ready_on_the_ground(self) -> bool:
        status = self._link.status()
        amiss = {reason.event for reason in self._decision().reasons}
        on_ground = not status.armed and status.landed_state == "ground"
        return on_ground and amiss <= NOTHING_TO_SEE_FROM_THE_GROUND

    def _is_up(self) -> bool:
        return self._decision().state is State.READY and self._link.status().flight_mode == "hold"

    async def _until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            await asyncio.sleep(LOOK_S)
