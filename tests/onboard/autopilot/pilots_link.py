"""A link that may also do what flockd leaves to pilots, for checks of the link and of autopilots."""

from __future__ import annotations

from flockd.onboard.autopilot.mavsdk_link import AutopilotLink

COMMAND_ARM_DISARM = 400


class PilotsLink(AutopilotLink):
    """Arms, takes off and selects offboard. Each raises AutopilotError when the autopilot refuses."""

    async def arm(self) -> None:
        """Starts the motors."""
        await self._command("to arm", COMMAND_ARM_DISARM, 1, refused="to arm")

    async def take_off(self) -> None:
        """Climbs to the autopilot's own take-off height (MIS_TAKEOFF_ALT), once armed."""
        await self._set_mode("take-off")

    async def request_offboard(self) -> None:
        """Selects offboard; setpoints must be streaming by then."""
        await self._set_mode("offboard")
