"""The gate as the setpoint streamer calls it: judges each setpoint on the streamer's thread, just before it is sent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flockd.core.messages import Setpoint, VelocityCommand
from flockd.flight.safety import Gate, Permission, Surroundings, Wanted


@dataclass(frozen=True, eq=False)
class Clearance:
    """What the gate needs to judge a setpoint, as of the last tick of the control loop."""

    permission: Permission
    around: Surroundings
    command_time_s: float
    """When the command in the setpoints was made."""


class StreamGate:
    """Calls the gate with the newest clearance; without a clearance nothing is sent."""

    def __init__(self, gate: Gate, clock: Callable[[], float]) -> None:
        self._gate, self._clock = gate, clock
        self.clearance: Clearance | None = None

    def __call__(self, setpoint: Setpoint) -> Setpoint | None:
        """The setpoint that may be sent in its place; None: nothing may."""
        clearance = self.clearance
        if clearance is None:
            return None
        command = VelocityCommand(setpoint.velocity, np.zeros(2), setpoint.yaw_rad)
        wanted = Wanted(command, clearance.command_time_s, setpoint.height_m)
        return self._gate.step(self._clock(), clearance.permission, wanted, clearance.around).setpoint
