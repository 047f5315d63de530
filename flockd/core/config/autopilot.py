"""The link to the autopilot, and the requests that flockd may make."""

from __future__ import annotations

import re
import termios
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from flockd.core import services
from flockd.core.config.base import Distance, Port, Section, Speed, text

LEAST_BAUD = 57_600
"""Bits a second, ten a byte: what flockd asks of an autopilot without a range finder is 4.5 kB/s."""


def _baud(address: str) -> str:
    """Raises ValueError if no serial port has this baud rate, or if it is too slow; or for an address of all."""
    if re.match(r"(udp|tcp)out://0\.0\.0\.0:", address):
        raise ValueError(f"{address} names no computer to send to; write the autopilot's address, or `udpin://`")
    baud = address.rpartition(":")[2]
    rates = [name[1:] for name in dir(termios) if re.fullmatch(r"B[1-9]\d*", name)]
    enough = sorted((rate for rate in rates if int(rate) >= LEAST_BAUD), key=int)
    if address.startswith("serial:") and baud not in enough:
        told = "has no baud rate" if "/" in baud else f"has the baud rate {baud}, which no port has"
        if baud in rates:
            told = f"has the baud rate {baud}, too slow for what the autopilot has to send"
        raise ValueError(f"{address} {told}; write the autopilot's, of {', '.join(enough)}")
    return address


class AutopilotParameters(Section):
    """The link to this drone's autopilot, and the requests that flockd may make."""

    address: Annotated[
        str,
        Port,
        AfterValidator(_baud),
        text(
            r"^((udpin|udpout|tcpin|tcpout)://[^/]+|serial:///.+):\d+$",
            "an address, as in `serial:///dev/ttyAMA0:921600` for a cable and its baud rate, or `udpin://0.0.0.0:14540`",
        ),
    ] = "udpin://127.0.0.1:14540"
    """`udpin://` waits for an autopilot that sends to this address; `serial:///dev/ttyS1:921600` is a cable."""
    system_id: Annotated[int, Field(ge=1, le=250)] | None = None
    """The autopilot's MAV_SYS_ID, different for each drone of the fleet; flockd ignores other systems. By default that
    of the only autopilot on the link; flockd refuses to start if there are two."""
    setpoint_rate_hz: Annotated[float, Field(ge=5, le=50)] = services.SETPOINT.rate_hz
    max_setpoint_age_s: Annotated[float, Field(gt=0, le=10)] = services.REQUEST.timeout
    """An older setpoint is not sent."""
    max_control_age_s: Annotated[float, Field(gt=0, le=0.4)] = services.CONTROL.timeout
    """No setpoint is sent if the control loop has not run for this long."""
    max_gap_s: Annotated[float, Field(gt=0, le=0.9)] = services.SETPOINT.timeout
    """A longer gap between setpoints in offboard flight, or a longer silence of the autopilot, ends the stream for this
    flight. Keep it below PX4's COM_OF_LOSS_T, because PX4 returns to offboard by itself when setpoints come back."""
    on_failure: Literal["hold", "land"] = "hold"
    """The mode that flockd requests from the autopilot when it cannot fly on."""
    height_m: Distance | None = None
    """Height above home to fly at; by default the height at which the flight begins."""
    max_velocity_trim_m_s: Speed = 0.5
    """Limit of the correction of setpoints by the difference between the cameras' velocity and the autopilot's: the
    autopilot flies by its own estimate, which errs by 0.1 to 0.3 m/s with GNSS alone. 0: no correction. No effect with
    `own_velocity: autopilot`."""
    low_battery_share: Annotated[float, Field(ge=0, lt=1)] = 0.2
    """Share of the charge at or below which the battery counts as low."""
