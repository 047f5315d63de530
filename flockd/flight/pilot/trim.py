"""By how much the setpoints are corrected for what the autopilot believes wrongly of its own velocity."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import EgoMotion, FloatArray, VehicleState
from flockd.flight.geometry.level import limit_norm

MEMORY_S = 0.5
"""The paper's step."""
_LASTS_S, _USUAL_M_S, _USUAL_SHARE, _MOST_M_S = 3.0, 0.5, 0.15, 100.0
"""What autopilot and cameras differ by for seconds is less, and this share of the speed, while both are right: of PX4's
estimate 0.15 m/s, of a scale by images 3 %. No difference counts as larger than the last."""


class VelocityTrim:
    """The autopilot's velocity less the one that the cameras measured, averaged over some time and limited.

    An autopilot flies a setpoint v so that its own estimate becomes v. Where that estimate is off by b, the drone moves
    with v - b, and so do neighbours with other b: a flock with equal commands drifts together. So b is added.
    """

    def __init__(self, limit_m_s: float, memory: float, gate_m_s: float) -> None:
        """``limit_m_s``: its largest norm; 0: no trim. ``memory``: share of a trim that is kept over `MEMORY_S`.

        ``gate_m_s``: what the gate lets through.
        """
        self._limit_m_s, self._memory, self._gate_m_s = limit_m_s, memory, gate_m_s
        self._before: VehicleState | None = None
        self._mean = np.zeros(2)
        self._lasts = np.zeros(2)
        """(2,) m/s: by how much the two have differed in the last seconds."""
        self._usual_m_s = math.inf

    @property
    def doubt_m_s(self) -> float:
        """By how much one of the two is wrong; 0 while they agree. Over ground that is higher than home images make the
        drone, and all that they show, faster and farther than it is."""
        off_m_s = math.hypot(*self._lasts)
        return off_m_s if off_m_s > self._usual_m_s else 0.0

    @property
    def velocity(self) -> FloatArray:
        """(2,) m/s, north and east, of the setpoints' correction."""
        return limit_norm(self._mean, self._limit_m_s)

    def corrected(self, velocity: FloatArray) -> FloatArray:
        """The law's velocity (2,) m/s with the trim: not even by rounding more than the gate lets through."""
        return limit_norm(velocity + self.velocity, self._gate_m_s)

    def update(self, vehicle: VehicleState, ego: EgoMotion | None) -> None:
        """With the vehicle's state and the ego-motion of each step.

        Without ego-motion, or without a finite velocity of the autopilot at both of its ends, the trim stays as it was.
        """
        before, self._before = self._before, vehicle
        if before is None or ego is None or before.velocity_ned is None or vehicle.velocity_ned is None:
            return
        if not math.isclose(vehicle.time_s - before.time_s, ego.interval_s, rel_tol=0.2):
            return  # a state from another time than the frames
        believed = (before.velocity_ned + vehicle.velocity_ned) / 2  # the mean over the interval, as the measured one
        wrong = (believed - before.R_ned_body @ ego.velocity)[:2]
        if not np.isfinite(wrong).all():
            return  # it would never leave the mean again
        self._lasts = self._lasts - math.expm1(-ego.interval_s / _LASTS_S) * (
            limit_norm(wrong, _MOST_M_S) - self._lasts
        )
        self._usual_m_s = _USUAL_M_S + _USUAL_SHARE * math.hypot(*believed[:2])
        kept = self._memory ** (ego.interval_s / MEMORY_S)
        self._mean = kept * self._mean + (1 - kept) * limit_norm(wrong, 2 * self._limit_m_s)
