"""A mission with one velocity."""

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
