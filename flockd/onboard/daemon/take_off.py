"""Take-off without a pilot, where the configuration allows it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from flockd.flight.safety import Decision, Event, State
from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.onboard.daemon.operator_commands import OperatorRequests

POLL_S = 0.02
ARM_RETRY_S = 2.0
SETPOINTS_FIRST = 10
"""The autopilot enters offboard mode only while setpoints arrive."""
EXPECTED_ON_GROUND = frozenset(
    {Event.NOT_OFFBOARD, Event.NOT_ARMED, Event.NOT_IN_AIR, Event.HEIGHTS_LEFT, Event.NEIGHBOURS_LOST}
    | {Event.EGO_MOTION_POOR, Event.EGO_MOTION_LOST}
)
"""Events that do not keep a drone on the ground from taking off."""


class TakeOff:
    """Arms, takes off and switches to offboard, once; only with `autopilot.arm_and_take_off`."""

    def __init__(
        self,
        link: AutopilotLink,
        streamer: SetpointStreamer,
        operator: OperatorRequests,
        decision: Callable[[], Decision],
        log_event: Callable[[str], None],
    ) -> None:
        self._link, self._streamer, self._operator = link, streamer, operator
        self._decision, self._log_event = decision, log_event

    async def run(self) -> None:
        """Takes off; then waits until cancelled."""
        await self._until(self._is_ready_on_the_ground)
        await self._arm()
        try:
            await self._link.take_off()
            await self._until(self._is_up)
            sent = self._streamer.report().sent
            await self._until(lambda: self._streamer.report().sent >= sent + SETPOINTS_FIRST)
            await self._link.request_offboard()
        except AutopilotError as error:
            self._log_event(str(error))
            self._operator.offboard_refused = True
        await asyncio.Event().wait()

    async def _arm(self) -> None:
        """Repeats: an autopilot that has just started refuses for some seconds."""
        reported = ""
        while True:
            try:
                await self._link.arm()
            except AutopilotError as error:
                if str(error) != reported:
                    reported = str(error)
                    self._log_event(reported)
                await asyncio.sleep(ARM_RETRY_S)
                await self._until(self._is_ready_on_the_ground)
            else:
                return

    def _is_ready_on_the_ground(self) -> bool:
        status = self._link.status()
        problems = {reason.event for reason in self._decision().reasons}
        on_ground = not status.armed and status.landed_state == "ground"
        return on_ground and problems <= EXPECTED_ON_GROUND

    def _is_up(self) -> bool:
        return self._decision().state is State.READY and self._link.status().flight_mode == "hold"

    async def _until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            await asyncio.sleep(POLL_S)
