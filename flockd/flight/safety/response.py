"""How the drone follows its setpoints, by what it measures of its velocity: what carries it off, and how fast."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.level import limit_norm

_POLE_PER_S = 10.0
"""Both poles of the observer: gusts of a second are followed, and a response that is 0.2 s late, or of a time constant
half or twice the one that is configured, stays stable."""
_GUSTS_S = 10.0
"""Memory of the mean strength of gusts: a few of them."""
_FASTEST_M_S = 100.0
"""What is measured to be faster is no velocity."""


class ResponseObserver:
    """The drift of one drone: the velocity at which it settles, less its setpoint.

    A Luenberger observer of v' = (setpoint - v) / tau + g, with g constant: what wind, and an autopilot that is weak,
    add (D. Luenberger, "Observers for multivariable systems", IEEE Transactions on Automatic Control 11(2), 1966). Such
    a disturbance observer is the usual answer to wind (W. Chen et al., "Disturbance-observer-based control and related
    methods: an overview", IEEE Transactions on Industrial Electronics 63(2), 2016).
    """

    def __init__(self, response_s: float, max_drift_m_s: float) -> None:
        """`response_s`: tau; `max_drift_m_s`: the drift's largest norm, beyond which velocity or model is wrong."""
        self._response_s, self._max_drift_m_s = response_s, max_drift_m_s
        self._velocity: FloatArray | None = None
        self._push = self.drift = np.zeros(2)
        """(2,) m/s, north and east."""
        self._mean_square = 0.0

    @property
    def gusts_m_s(self) -> float:
        """Root mean square of the drift's norm over the last ten seconds or so."""
        return math.sqrt(self._mean_square)

    def restart(self, velocity: FloatArray) -> None:
        """Begins anew, while something else flies the drone, with its measured `velocity` (2,) m/s."""
        self._begin(velocity)
        self._mean_square = 0.0

    def step(self, velocity: FloatArray, setpoint: FloatArray, elapsed_s: float) -> None:
        """With the measured `velocity` (2,) m/s, and the `setpoint` (2,) m/s that was flown for the last `elapsed_s`.

        Where a velocity is not known, or no time, the drift begins anew.
        """
        if self._velocity is None or not _is_known(velocity) or not elapsed_s >= 0:
            self._begin(velocity)
        elif elapsed_s > 0:
            wanted = (setpoint - self._velocity) / self._response_s
            predicted = self._velocity + elapsed_s * (wanted + self._push)
            keep = math.exp(-_POLE_PER_S * elapsed_s)
            error = velocity - predicted
            self._velocity = predicted + (1 - keep**2) * error
            self._push = self._push + (1 - keep) ** 2 / elapsed_s * error
            square = float(np.sum((self._response_s * self._push) ** 2))
            self._mean_square += (1 - math.exp(-elapsed_s / _GUSTS_S)) * (square - self._mean_square)
            self.drift = limit_norm(self._response_s * self._push, self._max_drift_m_s)

    def _begin(self, velocity: FloatArray) -> None:
        self._velocity = velocity.copy() if _is_known(velocity) else None
        self._push = self.drift = np.zeros(2)


def _is_known(velocity: FloatArray) -> bool:
    return math.hypot(*velocity) <= _FASTEST_M_S
