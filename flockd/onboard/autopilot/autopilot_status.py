"""The autopilot's status, and its errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from flockd.core.errors import ExitCode, UnavailableError
from flockd.core.messages import FloatArray

FlightMode = Literal[
    "manual", "stabilized", "acro", "altitude", "position", "hold", "mission", "return", "land", "take-off", "offboard",
    "other", "unknown"
]  # fmt: skip
"""PX4's flight modes as flockd tells them apart; unknown: not heard yet."""
MODES: Mapping[tuple[int, int], FlightMode] = {
    (1, 0): "manual",
    (2, 0): "altitude",
    (3, 0): "position",
    (4, 2): "take-off",
    (4, 3): "hold",
    (4, 4): "mission",
    (4, 5): "return",
    (4, 6): "land",
    (5, 0): "acro",
    (6, 0): "offboard",
    (7, 0): "stabilized",
}
"""PX4's main and sub mode."""
LandedState = Literal["unknown", "ground", "air", "taking off", "landing"]


def mode_of(custom_mode: float) -> FlightMode:
    """The mode of PX4's `custom_mode` in MAVLink; `other` if it is not in `MODES`."""
    number = int(custom_mode)
    return MODES.get((number >> 16 & 0xFF, number >> 24 & 0xFF), "other")


class AutopilotError(UnavailableError):
    """The autopilot is missing, did not answer, or refused; the text says which, and what to do."""


class AutopilotSettingError(AutopilotError):
    """The configuration's section `autopilot` is incomplete; a restart does not help."""

    exit_code = ExitCode.BAD_CONFIGURATION


@dataclass(frozen=True, eq=False)
class AutopilotStatus:
    """The newest known state, at `time_s` on the link's clock. None: not received yet, or unknown to the autopilot."""

    time_s: float
    heartbeat_age_s: float
    """Time since the last heartbeat; infinite before the first."""
    message_age_s: float
    """Time since its last message of any kind."""
    flight_mode: FlightMode
    armed: bool
    failsafe: bool
    """Whether it flies its own failsafe instead of what it was commanded."""
    landed_state: LandedState
    battery_share: float | None
    """0 to 1."""
    estimate_ok: bool | None
    """Whether attitude, height, horizontal velocity and position are estimated."""
    gps_ok: bool | None
    """Whether it has a three-dimensional fix."""
    position_ned: FloatArray | None
    """(3,) metres from the estimator's origin at the start of the flight, which is not home."""
    home_ned: FloatArray | None
    """(3,) metres from the same origin."""
    foreign_setpoints: str | None = None
    """Evidence of setpoints that flockd did not send, in a few words; None: there is none."""
    fastest_m_s: float = math.inf
    """The autopilot's speed limit for setpoints; infinite if it is not known."""
    parameter_fault: str | None = None
    """The fault of a parameter that was changed since the drone was armed."""
    frame_jumped: bool = False
    """Whether its local frame, or its heading, has jumped far since offboard began."""

    @property
    def in_air(self) -> bool:
        """Whether it is off the ground; false if unknown."""
        return self.landed_state in {"air", "taking off", "landing"}


@dataclass(frozen=True)
class Firmware:
    """The autopilot's firmware."""

    autopilot: str
    """`PX4`, or `autopilot N` by its MAV_AUTOPILOT."""
    version: str
    """As in `1.16.0`."""
