"""An image sensor: noise by gain (EMVA 1288), and automatic exposure and white balance."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import BoolArray, Float32Array, FloatArray
from flockd.sim.scenario.imperfect_cameras import AutomaticConfig, SensorNoiseConfig

_TARGET = 0.18
"""Mean of the linear light that exposure meters aim at."""
_MOST_GAIN, _MOST_BALANCE = 4.0, 1.6
_STRIDE = 8
"""Of the pixels that are metered."""
_TILE = (1031, 1033)


class Automatic:
    """One camera's automatic gains. They begin where they settle in the first image."""

    def __init__(self, config: AutomaticConfig) -> None:
        self._config = config
        self._log_gains: FloatArray | None = None
        self._time_s = 0.0

    def gains(self, light: Float32Array, imaged: BoolArray, time_s: float) -> FloatArray:
        """(3,) for red, green and blue of the image (h, w, 3) of a time."""
        mean = light[::_STRIDE, ::_STRIDE][imaged[::_STRIDE, ::_STRIDE]].mean(axis=0, dtype=np.float64) + 1e-6
        exposure = np.clip(np.log(_TARGET / mean.mean()), -math.log(_MOST_GAIN), math.log(_MOST_GAIN))
        balance = np.clip(np.log(mean[1] / mean), -math.log(_MOST_BALANCE), math.log(_MOST_BALANCE))
        wanted = self._config.exposure * exposure + self._config.white_balance * balance
        if self._log_gains is None:
            self._log_gains = wanted
        else:
            share = -math.expm1(-max(time_s - self._time_s, 0.0) / self._config.time_s)
            self._log_gains = self._log_gains + share * (wanted - self._log_gains)
        self._time_s = time_s
        return np.asarray(np.exp(self._log_gains), np.float64)


class NoiseTile:
    """Standard normal noise that images take crops of."""

    def __init__(self, seed: int) -> None:
        self._tile = np.random.default_rng([seed, 6]).standard_normal((*_TILE, 3), dtype=np.float32)

    def crop(self, height: int, width: int, rng: np.random.Generator) -> Float32Array:
        """(height, width, 3) from a drawn place, or repeated where the tile is smaller."""
        top, left = (int(rng.integers(side)) for side in _TILE)
        rows, columns = (np.arange(top, top + height) % _TILE[0], np.arange(left, left + width) % _TILE[1])
        return np.asarray(self._tile[rows[:, None], columns], np.float32)


def noisy(light: Float32Array, normal: Float32Array, config: SensorNoiseConfig, brightened: float) -> Float32Array:
    """Linear light (h, w, 3) with a sensor's noise, of standard normal noise of its shape.

    EMVA 1288, equation of the photon transfer: the variance of a grey value is that of reading, times the square of the
    gain, and the gain times the mean. The gain is white over the electrons that give it; ``brightened`` is what the
    automatic exposure amplified beside it.
    """
    per_electron = np.float32(config.gain * max(brightened, 1.0) / config.full_well_e)
    variance = np.maximum(light, 0.0) * per_electron + np.float32((per_electron * config.read_noise_e) ** 2)
    return np.asarray(light + np.sqrt(variance) * normal, np.float32)
