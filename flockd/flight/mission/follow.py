"""A mission without a goal of its own."""

from __future__ import annotations

import numpy as np

from flockd.flight.mission.guidance import Guidance, Moment


class Follow:
    """Goes where the flock goes: Eq. 42 with W_i = 0, so that cohesion and alignment alone move the drone."""

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        return Guidance(np.zeros(2), "follows the flock")
