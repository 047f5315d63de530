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


class Still:
    """Desires velocity zero: the law still keeps the flock together, and moves a drone that follows it (W_i = 0)."""

    def __init__(self, sentence: str) -> None:
        """`sentence`: what it does, for people."""
        self._guidance = Guidance(np.zeros(2), sentence)

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        return self._guidance
