"""How propellers shake a camera: four of nearly the same speed, and their blades."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from flockd.core.messages import FloatArray
from flockd.sim.scenario.imperfect_cameras import ShakeConfig

_PROPELLERS, _SPREAD = 4, 0.1
_OF_REVOLUTIONS = 0.8
"""Share of the power; the rest is of blades, two a propeller."""


class Shaking:
    """Angles of one camera about its axes, by time: sums of tones of seeded frequencies and phases."""

    def __init__(self, config: ShakeConfig, rng: np.random.Generator) -> None:
        revolutions = config.frequency_hz * rng.uniform(1 - _SPREAD, 1 + _SPREAD, _PROPELLERS)
        self._rad_s = 2 * math.pi * np.concatenate([revolutions, 2 * revolutions])
        powers = np.repeat([_OF_REVOLUTIONS, 1 - _OF_REVOLUTIONS], _PROPELLERS) / _PROPELLERS
        self._amplitudes = math.radians(config.rms_deg) * np.sqrt(2 * powers)
        self._phases = rng.uniform(0, 2 * math.pi, (3, 2 * _PROPELLERS))

    def at(self, times_s: FloatArray) -> FloatArray:
        """(n, 3) rad at times (n,) s."""
        tones = np.sin(times_s[:, None, None] * self._rad_s + self._phases)
        return np.asarray(tones @ self._amplitudes, np.float64)

    def around(self, time_s: float) -> Callable[[FloatArray], FloatArray]:
        """The same, of times (n,) s that count from `time_s`."""
        return lambda since_s: self.at(time_s + since_s)
