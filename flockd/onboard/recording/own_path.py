"""The own path by dead reckoning, for viewers: the integral of the estimated velocity."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray


class OwnPath:
    """Begins at the first step, north and east of which it counts; the height is the autopilot's."""

    def __init__(self) -> None:
        self._north_east = np.zeros(2)
        self._time_s: float | None = None

    def go_on(self, time_s: float, velocity: FloatArray | None, height_m: float) -> FloatArray:
        """(3,) m NED at this step; ``velocity`` (3,) m/s NED since the last one, None: stand still."""
        if velocity is not None and self._time_s is not None:
            self._north_east = self._north_east + velocity[:2] * (time_s - self._time_s)
        self._time_s = time_s
        return np.array([*self._north_east, -height_m])
