"""How well the drone's velocity follows its setpoints."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import FloatArray

_MEMORY_S = 10.0
"""Of the mean square: a few gusts."""
_FASTEST_M_S = 100.0
"""What is measured to be faster is no velocity."""


class ResponseMonitor:
    """The difference between the measured velocity and the one that is expected of the setpoints.

    Expected is a first-order lag of the setpoints. The error is a root mean square, so that wind, an autopilot that
    does not follow and one that oscillates all show in it. It says how far the velocity is off, not why.
    """

    def __init__(self, response_s: float) -> None:
        """`response_s`: time constant of the lag, the vehicle's dead time included."""
        self._response_s = response_s
        self._expected: FloatArray | None = None
        self._mean_square = 0.0

    @property
    def error_m_s(self) -> float:
        """Root mean square of the difference's norm over the last ten seconds or so."""
        return math.sqrt(self._mean_square)

    def restart(self, velocity: FloatArray) -> None:
        """Begins anew, while something else flies the drone, with its measured `velocity` (2,) m/s."""
        self._expected = velocity if _is_known(velocity) else None
        self._mean_square = 0.0

    def step(self, velocity: FloatArray, setpoint: FloatArray, elapsed_s: float) -> None:
        """With the measured `velocity` (2,) m/s, and the `setpoint` (2,) m/s that was flown for the last `elapsed_s`.

        Where a velocity is not known, or no time, what is expected begins anew.
        """
        if self._expected is None or not _is_known(velocity) or not elapsed_s >= 0:
            self._expected = velocity if _is_known(velocity) else None
            return
        share = -math.expm1(-elapsed_s / self._response_s)
        self._expected = self._expected + share * (setpoint - self._expected)
        square = float(np.sum((velocity - self._expected) ** 2))
        self._mean_square += -math.expm1(-elapsed_s / _MEMORY_S) * (square - self._mean_square)


def _is_known(velocity: FloatArray) -> bool:
    return math.hypot(*velocity) <= _FASTEST_M_S
