"""Faults of simulated cameras, which a scenario orders."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flockd.core.messages import UInt8Array
from flockd.sim.scenario import CameraFaultConfig

_BANDS, _BAND_SHARE = 4, 8
"""Bands of interference in an image, each an eighth of it high; they may overlap."""


class CameraFaults:
    """The faults of one scenario. The same seed gives the same images."""

    def __init__(self, faults: Sequence[CameraFaultConfig], seed: int) -> None:
        self._faults = faults
        self._rng = np.random.default_rng([seed, 3])
        self._began_s: float | None = None

    def applied(self, drone: int, camera: str, time_s: float, image: UInt8Array) -> UInt8Array:
        """The RGB image (h, w, 3) as the camera of the drone, counted from 0, sends it at a time."""
        self._began_s = time_s if self._began_s is None else self._began_s
        passed_s = time_s - self._began_s
        for fault in self._faults:
            if (fault.drone, fault.camera) == (drone + 1, camera) and fault.begin_s <= passed_s < fault.end_s:
                image = noisy_image(image, fault, self._rng)
        return image


def noisy_image(image: UInt8Array, fault: CameraFaultConfig, rng: np.random.Generator) -> UInt8Array:
    """A noisy copy of an RGB image (h, w, 3)."""
    if fault.kind == "gaussian":
        added = image + fault.sigma * rng.standard_normal(image.shape)
        return np.clip(np.rint(added), 0, 255).astype(np.uint8)
    noise = rng.integers(0, 256, image.shape, dtype=np.uint8)
    if fault.kind == "uniform":
        return noise
    copy, height = image.copy(), len(image) // _BAND_SHARE
    for top in rng.integers(0, len(image) - height + 1, _BANDS):
        copy[top : top + height] = noise[top : top + height]
    return copy
