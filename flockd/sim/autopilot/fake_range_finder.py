"""A simulated range finder that faces down, over a ground of known shape, with the errors of a real one."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from flockd.core.messages import FloatArray, RangeReading
from flockd.sim.scenario import RangeFinderConfig

Ground = Callable[[FloatArray, FloatArray], FloatArray]
"""Height above z = 0 of the ground at points (n,) north and (n,) east, metres."""

LEAST_NOISE_M = 0.01
_CLOSER_M = 1e-3
_MOST_STEPS = 20
_WEAK = 0.0
"""Quality of a reading without a signal."""


def level_ground(north: FloatArray, east: FloatArray) -> FloatArray:
    """A `Ground` at 0 everywhere."""
    return np.zeros(np.broadcast_shapes(north.shape, east.shape))


class FakeRangeFinder:
    """Measures along the body's down axis, off by its mounting error. All errors come from the seed."""

    def __init__(self, config: RangeFinderConfig, ground: Ground, seed: tuple[int, ...]) -> None:
        self._config, self._ground = config, ground
        self._random = np.random.default_rng(seed)
        axis = np.array([*np.tan(math.radians(config.tilt_deg) * self._random.normal(size=2)), 1.0])
        self._axis: FloatArray = axis / np.linalg.norm(axis)
        self._phase_s = float(self._random.uniform(0.0, 1.0 / config.rate_hz))
        self._out_until_s = -math.inf
        self._next_dropout_s: float | None = None

    def read(
        self, time_s: float, position: FloatArray, velocity: FloatArray, R_ned_body: FloatArray
    ) -> RangeReading | None:
        """The newest reading at a time, not before the last, of a drone at `position` (3,) m with `velocity` (3,) m/s
        NED; it was taken up to a period before. None while it gives none.
        """
        period_s = 1.0 / self._config.rate_hz
        taken_s = self._phase_s + math.floor((time_s - self._phase_s) / period_s) * period_s
        if self._is_out(taken_s):
            return None
        config = self._config
        true_m = range_to_ground(position - velocity * (time_s - taken_s), R_ned_body @ self._axis, self._ground)
        noise_m = max(config.noise * min(true_m, config.max_m), LEAST_NOISE_M) * float(self._random.normal())
        inside = config.min_m < true_m < config.max_m
        range_m = min(max(true_m + noise_m, config.min_m), config.max_m)
        return RangeReading(taken_s, range_m, min_m=config.min_m, max_m=config.max_m, quality=1.0 if inside else _WEAK)

    def _is_out(self, now_s: float) -> bool:
        """Dropouts come as a Poisson process, and last for exponentially distributed times."""
        rate_per_s = self._config.dropouts_per_min / 60.0
        if rate_per_s == 0.0:
            return False
        if self._next_dropout_s is None:
            self._next_dropout_s = now_s + self._random.exponential(1.0 / rate_per_s)
        while now_s >= self._next_dropout_s:
            self._out_until_s = self._next_dropout_s + self._random.exponential(self._config.dropout_s)
            self._next_dropout_s = self._out_until_s + self._random.exponential(1.0 / rate_per_s)
        return now_s < self._out_until_s


def range_to_ground(position: FloatArray, direction: FloatArray, ground: Ground) -> float:
    """Metres from `position` (3,) NED along a unit vector (3,) down to a ground of gentle slopes; infinite where the
    direction does not lead down.
    """
    if direction[2] <= 0.0:
        return math.inf
    range_m = 0.0
    for _ in range(_MOST_STEPS):
        north, east, down = position + range_m * direction
        above_m = float(-down - ground(np.array([north]), np.array([east]))[0])
        range_m += above_m / float(direction[2])
        if abs(above_m) < _CLOSER_M:
            break
    return range_m
