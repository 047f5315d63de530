"""Missions of one velocity, or of none of their own."""

from __future__ import annotations

import numpy as np

from flockd.core.config.mission import MissionParameters
from flockd.flight.mission.guidance import Guidance, Moment, course_of


class Velocity:
    """Wants the same velocity at all times."""

    def __init__(self, parameters: MissionParameters) -> None:
        assert parameters.velocity_m_s is not None  # its own check asks for it
        self._velocity = np.array(parameters.velocity_m_s)

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        return Guidance(self._velocity, "flies at its velocity", course_of(self._velocity))


class Hover:
    """Wants no velocity; the law still keeps the flock together."""

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        return Guidance(np.zeros(2), "hovers")


class Follow:
    """Goes where the flock goes: Eq. 42 with W_i = 0, so that cohesion and alignment alone move the drone."""

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        return Guidance(np.zeros(2), "follows the flock")
