"""How a drone moves that weaves: what it asks its autopilot for, and how its height answers."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import FloatArray

ASKED_M = 0.43
"""A weaving drone asks for heights this much above and below its own, ..."""
PERIOD_S = 6.0
"""... in a sine of this period, ..."""
DURATION_S = 12.0
"""... for so long."""
SETTLES_S = 3.0
"""So long afterwards it is still on its way back."""
HEIGHT_GAIN_PER_S, _ANSWERS_S = 1.0, 0.25
"""A setpoint asks for so much climb for each metre that is missing, which the drone takes up with this time constant:
it moves by 0.34 m up and down. Autopilots differ: `AMPLITUDE_SIGMA`."""
AMPLITUDE_SIGMA = 0.06
"""By how much the amplitude of another's weave may differ, as a share: a standard deviation."""
_TABLE_S = 0.01


def asked_lift_m(elapsed_s: float) -> float:
    """The height to ask for above where the weave began, so long after that."""
    return ASKED_M * math.sin(2 * math.pi * elapsed_s / PERIOD_S) if 0.0 <= elapsed_s < DURATION_S else 0.0


def lift_m(elapsed_s: float) -> float:
    """How high a drone is above where its weave began, so long after that."""
    return float(np.interp(elapsed_s, _TIMES_S, _LIFTS_M))


def climb_m_s(elapsed_s: float) -> float:
    """The derivative of `lift_m`."""
    return float(np.interp(elapsed_s, _TIMES_S, _CLIMBS_M_S))


def _path() -> tuple[FloatArray, FloatArray, FloatArray]:
    times_s = np.arange(0.0, DURATION_S + 2 * SETTLES_S, _TABLE_S)
    lifts_m, climbs_m_s = np.zeros(len(times_s)), np.zeros(len(times_s))
    for i, time_s in enumerate(times_s[:-1].tolist()):
        wanted_m_s = HEIGHT_GAIN_PER_S * (asked_lift_m(time_s) - lifts_m[i])
        climbs_m_s[i + 1] = climbs_m_s[i] + (wanted_m_s - climbs_m_s[i]) * _TABLE_S / _ANSWERS_S
        lifts_m[i + 1] = lifts_m[i] + climbs_m_s[i + 1] * _TABLE_S
    return times_s, lifts_m, climbs_m_s


_TIMES_S, _LIFTS_M, _CLIMBS_M_S = _path()
