"""A mission at a standstill."""

from __future__ import annotations

import numpy as np

from flockd.flight.mission.guidance import Guidance, Moment


class Hover:
    """Wants no velocity; the law still keeps the flock together."""

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        return Guidance(np.zeros(2), "hovers")
