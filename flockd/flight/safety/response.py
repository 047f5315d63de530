"""How well, and how late, the drone's velocity follows its setpoints."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import FloatArray

_MEMORY_S = 10.0
"""Time constant of the mean squares: a few gusts."""
_FASTEST_M_S = 100.0
"""A faster measurement is not a velocity."""
_UNSURE_M_S = 0.2
"""Above the error of PX4's own velocity. Delays whose mean squares differ by less than its square explain the response
equally well; so do those whose errors are at most twice as large."""


class ResponseMonitor:
    """The difference between the measured velocity and the one expected from the setpoints.

    Expected is a first-order lag of the setpoints. The error is a root mean square, so that wind, an autopilot that
    does not follow and one that oscillates all increase it. It measures the deviation, not its cause.

    A delay shows when setpoints change: the response is also compared with delays of up to four time constants. The
    shortest delay that explains the measured velocity nearly as well as the best one is kept for the flight, since
    straight flight shows no delay. Wind and errors of the measured velocity affect all delays equally.
    """

    def __init__(self, response_s: float) -> None:
        """`response_s`: time constant of the lag, the vehicle's dead time included."""
        self._response_s = response_s
        self._delays_s = response_s * np.arange(5)
        self._now_s = 0.0
        self._times_s: FloatArray = np.empty(0)
        self._expected: FloatArray = np.empty((0, 2))
        """m/s, at `_times_s`, of the last seconds; empty: none yet."""
        self._mean_squares = np.zeros(len(self._delays_s))
        self.late_s = 0.0
        """Additional delay, beyond the expected one, with which the vehicle was seen to follow its setpoints."""

    @property
    def error_m_s(self) -> float:
        """Root mean square of the difference's norm over about the last ten seconds."""
        return math.sqrt(self._mean_squares[0])

    def restart(self, velocity: FloatArray) -> None:
        """Starts anew with the measured `velocity` (2,) m/s, while something else flies the drone."""
        self._expect(velocity)
        self._mean_squares = np.zeros_like(self._mean_squares)
        self.late_s = 0.0

    def step(self, velocity: FloatArray, setpoint: FloatArray, elapsed_s: float) -> None:
        """Takes the measured `velocity` (2,) m/s, and the `setpoint` (2,) m/s that was flown for the last `elapsed_s`.

        If a velocity or the time is not known, the monitor starts anew.
        """
        if not len(self._expected) or not _is_known(velocity) or not elapsed_s >= 0:
            self._expect(velocity)
            return
        self._now_s += elapsed_s
        share = -math.expm1(-elapsed_s / self._response_s)
        expected = self._expected[-1] + share * (setpoint - self._expected[-1])
        recent = self._times_s >= self._now_s - 2 * self._delays_s[-1]
        self._times_s = np.append(self._times_s[recent], self._now_s)
        self._expected = np.vstack([self._expected[recent], expected])
        then = np.searchsorted(self._times_s, self._now_s - self._delays_s, side="right") - 1
        squares = ((velocity - self._expected[np.maximum(then, 0)]) ** 2).sum(axis=1)
        self._mean_squares += -math.expm1(-elapsed_s / _MEMORY_S) * (squares - self._mean_squares)
        least = self._mean_squares.min()
        alike = self._mean_squares <= max(4 * least, least + _UNSURE_M_S**2)
        self.late_s = max(self.late_s, float(self._delays_s[np.argmax(alike)]))

    def _expect(self, velocity: FloatArray) -> None:
        known = int(_is_known(velocity))
        self._times_s, self._expected = np.full(known, self._now_s), np.reshape(velocity, (1, 2))[:known]


def _is_known(velocity: FloatArray) -> bool:
    return math.hypot(*velocity) <= _FASTEST_M_S
