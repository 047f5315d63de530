"""Missions with a constant velocity, and without one."""

from __future__ import annotations

import numpy as np

from flockd.core.config.mission import MissionParameters
from flockd.flight.mission.guidance import Guidance, Moment, course_of


class Velocity:
    """Always flies the same velocity."""

    def __init__(self, parameters: MissionParameters) -> None:
        assert parameters.velocity_m_s is not None  # checked by MissionParameters
        self._velocity = np.array(parameters.velocity_m_s)

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        return Guidance(self._velocity, "flies at its velocity", course_of(self._velocity))


class Hover:
    """Desires velocity zero; the law still keeps the flock together."""

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        return Guidance(np.zeros(2), "hovers")


class Follow:
    """Follows the flock: Eq. 42 with W_i = 0, so that only cohesion and alignment move the drone."""

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        return Guidance(np.zeros(2), "follows the flock")
