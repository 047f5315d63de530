"""By how much the setpoints are corrected for what the autopilot believes wrongly of its own velocity."""

from __future__ import annotations

import math

import numpy as np

from flockd.flocking import limit_norm
from flockd.messages import FloatArray, PilotOutput, VehicleState

_MEMORY = 0.7
"""Share of the old trim that stays with each step: noise of single steps goes, drifts over several seconds do not."""


class VelocityTrim:
    """The autopilot's velocity less the one that the cameras measured, averaged over some steps and limited.

    An autopilot flies a setpoint v so that its own estimate becomes v. Where that estimate is off by b, the drone moves
    with v - b, and so do neighbours with other b: a flock with equal commands drifts together. So b is added.
    """

    def __init__(self, limit_m_s: float) -> None:
        """``limit_m_s``: the trim's largest norm; 0: no trim."""
        self._limit_m_s = limit_m_s
        self._before: VehicleState | None = None
        self._mean = np.zeros(2)

    @property
    def velocity(self) -> FloatArray:
        """(2,) m/s, north and east, to be added to the pilot's command."""
        return limit_norm(self._mean, self._limit_m_s)

    def step(self, vehicle: VehicleState, output: PilotOutput) -> None:
        """After each step of the pilot, with the vehicle's state that it got.

        Without ego-motion, or without a finite velocity of the autopilot at both of its ends, the trim stays as it was.
        """
        before, self._before = self._before, vehicle
        ego = output.ego_motion
        if before is None or ego is None or before.velocity_ned is None or vehicle.velocity_ned is None:
            return
        if not math.isclose(vehicle.time_s - before.time_s, ego.interval_s, rel_tol=0.2):
            return  # a state from another time than the frames
        believed = (before.velocity_ned + vehicle.velocity_ned) / 2  # the mean over the interval, as the measured one
        wrong = (believed - before.R_ned_body @ ego.velocity)[:2]
        if not np.isfinite(wrong).all():
            return  # it would never leave the mean again
        self._mean = _MEMORY * self._mean + (1 - _MEMORY) * limit_norm(wrong, 2 * self._limit_m_s)
