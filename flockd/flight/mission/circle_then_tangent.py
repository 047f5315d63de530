"""The paper's mission: a circle, then its tangent (Eq. 43)."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.mission import MissionParameters
from flockd.core.messages import FloatArray
from flockd.flight.mission.guidance import Guidance, Moment


class CircleThenTangent:
    """Eq. 43, by the time since the flight began."""

    def __init__(self, parameters: MissionParameters) -> None:
        self._parameters = parameters

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        p, time_s = self._parameters, moment.time_s
        where = "on the circle" if time_s < p.circle_until_s else "along the tangent"
        return Guidance(desired_velocity(p, time_s), where, course(p, time_s))


def desired_velocity(parameters: MissionParameters, t: float) -> FloatArray:
    """efv of Eq. 42: (2,) m/s north and east, at `t` seconds into the flight."""
    yaw = course(parameters, t)
    return parameters.speed_m_s * np.array([math.cos(yaw), math.sin(yaw)])


def course(parameters: MissionParameters, t: float) -> float:
    """The direction of the desired velocity, radians clockwise from north in [0, 2 pi): delta of Eq. 43.

    The dots printed before 2 pi are read as a modulo. With the paper's 10 m of radius and 1 m/s it turns at 0.1 rad/s
    until 66 s and stays at 6.6 - 2 pi = 0.317 rad from there. Raises ValueError for a negative or non-finite time.
    """
    if not (math.isfinite(t) and t >= 0):
        raise ValueError(f"the time into the flight must be finite and not negative, not {t}")
    turned = parameters.speed_m_s / parameters.radius_m * min(t, parameters.circle_until_s)
    return math.fmod(turned, 2 * math.pi)
