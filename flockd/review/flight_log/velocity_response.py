"""How a drone follows its velocity setpoints: a first-order lag with a dead time, fitted to its autopilot's log."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from flockd.core.messages import FloatArray
from flockd.review.flight_log.autopilot_log import AutopilotLog

_STEP_S = 0.02
_DEAD_TIMES_S = np.arange(0.0, 0.61, _STEP_S)
_TIME_CONSTANTS_S = np.geomspace(0.05, 2.0, 75)
_SHORTEST_S = 5.0
_LEAST_CHANGE_M_S = 0.1
"""Standard deviation of the setpoints below which their effect is lost in noise."""


class VelocityResponse(NamedTuple):
    """v' = (setpoint of `dead_time_s` ago - v) / `time_constant_s`."""

    time_constant_s: float
    dead_time_s: float
    error_m_s: float
    """Root mean square of what was flown less what the model would fly."""


def velocity_response(log: AutopilotLog) -> VelocityResponse | None:
    """The lag of least squared error (output error, L. Ljung, "System Identification", 1999) over all of the flight.

    None where it was commanded for less than 5 s without a pause, or too evenly to tell.
    """
    spans = [span for span in _spans(log) if np.sqrt(np.var(span[0], axis=0).sum()) >= _LEAST_CHANGE_M_S]
    if not spans:
        return None
    points = 2 * sum(len(flown) for _, flown in spans)
    fits = [
        VelocityResponse(float(tau), float(dead), np.sqrt(sum(_squares(*span, tau, dead) for span in spans) / points))
        for tau in _TIME_CONSTANTS_S
        for dead in _DEAD_TIMES_S
    ]
    return min(fits, key=lambda fit: fit.error_m_s)


def _spans(log: AutopilotLog) -> list[tuple[FloatArray, FloatArray]]:
    """Setpoints and flown velocities, (n, 2) m/s every 0.02 s, for each stretch without a pause of the setpoints."""
    if not len(log.setpoint_time_s):
        return []
    times = np.arange(log.setpoint_time_s[0], log.flown_time_s[-1], _STEP_S)
    held = np.searchsorted(log.setpoint_time_s, times, side="right") - 1
    setpoints = log.setpoint_velocity[held]
    commanded = np.isfinite(setpoints).all(axis=1) & (times >= log.flown_time_s[0])
    edges = np.flatnonzero(np.diff(commanded, prepend=False, append=False))
    flown = np.column_stack([np.interp(times, log.flown_time_s, log.flown_velocity[:, axis]) for axis in (0, 1)])
    return [(setpoints[a:b], flown[a:b]) for a, b in edges.reshape(-1, 2) if (b - a) * _STEP_S >= _SHORTEST_S]


def _squares(setpoints: FloatArray, flown: FloatArray, tau: float, dead_s: float) -> float:
    """Sum of squared errors of the model that begins as flown."""
    late = round(dead_s / _STEP_S)
    asked = np.concatenate([np.repeat(flown[:1], late, axis=0), setpoints[: len(setpoints) - late]])
    keep = np.exp(-_STEP_S / tau)
    model, _ = lfilter([0.0, 1 - keep], [1.0, -keep], asked, axis=0, zi=flown[:1])
    return float(np.sum((model - flown) ** 2))
