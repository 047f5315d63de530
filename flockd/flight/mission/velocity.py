"""A mission with a constant velocity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flockd.flight.mission.guidance import Guidance, Moment, course_of


class Velocity:
    """Always desires the same velocity; with zero the law still moves a drone that follows its flock (W_i = 0)."""

    def __init__(self, velocity_m_s: Sequence[float], sentence: str) -> None:
        """`velocity_m_s`: north and east; `sentence`: what it does, for people."""
        velocity = np.array(velocity_m_s, dtype=float)
        self._guidance = Guidance(velocity, sentence, course_of(velocity))

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        return self._guidance
