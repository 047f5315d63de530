"""Faults on and in a lens: scattered light, specks of dirt, drops of water."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from flockd.core.messages import BoolArray, Float32Array, FloatArray
from flockd.sim.cameras.shutter import LensField
from flockd.sim.scenario.imperfect_cameras import LensFaultsConfig

_SPECK_SHARE, _DROP_SHARE = (0.008, 0.03), (0.02, 0.07)
"""Smallest and largest radius, as shares of the image's longer side: a speck of a tenth of a millimetre on a lens
of some millimetres' aperture is out of focus, and as large as a hundredth of the image."""
_SPECK_DARKENS = (0.2, 0.8)
_SOFT = 0.25
"""Standard deviation of their edges, as a share of the radius."""
_DROP_BLURS = 0.02
"""Standard deviation of what a drop blurs, as a share of the longer side."""
_HALO_RAD = 0.15
"""Over which the light around the sun falls by e."""


@dataclass(frozen=True, eq=False)
class Glass:
    """One lens with what sticks to it."""

    flare: float
    darkens: Float32Array
    """(h, w) share of the light that dirt takes."""
    wet: Float32Array
    """(h, w) 1 where a drop is."""

    @classmethod
    def of(cls, config: LensFaultsConfig, size: tuple[int, int], rng: np.random.Generator) -> Glass:
        """Dirt and drops of a seeded lens; (width, height)."""
        dirt = _spots(config.dirt, size, _SPECK_SHARE, rng, _SPECK_DARKENS)
        return cls(config.flare, dirt, _spots(config.drops, size, _DROP_SHARE, rng, (1.0, 1.0)))

    def passed(self, light: Float32Array, lens: LensField, sky: BoolArray, sun: FloatArray) -> Float32Array:
        """What is left of light (h, w, 3) as it falls on the lens.

        ``sky`` (h, w): where nothing hides it; ``sun`` (3,): unit vector towards it, in the camera's axes.
        """
        mean = light[lens.imaged].mean(axis=0)
        if self.wet.any():
            sigma = _DROP_BLURS * max(light.shape[:2])
            blurred = cv2.GaussianBlur(light, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
            light = light + self.wet[..., None] * (blurred - light)
        if self.darkens.any():
            # What the dirt takes of the image it scatters: half of a mean's light is back.
            light = light * (1 - self.darkens[..., None]) + 0.5 * self.darkens[..., None] * mean
        if self.flare > 0:
            scattered = self.flare * (mean + self._of_sun(lens, sky, sun)[..., None])
            light = np.where(lens.imaged[..., None], (1 - self.flare) * light + scattered, light)
        return np.asarray(light, np.float32)

    def _of_sun(self, lens: LensField, sky: BoolArray, sun: FloatArray) -> Float32Array:
        """(h, w) of its light, all scattered over the image: half evenly, half around it; 0 where it is not seen.

        On the scale where white paper, square to the sun, is 1: it gets pi times as much light as it has radiance.
        """
        cosine = np.where(lens.imaged, lens.rays @ sun.astype(np.float32), -1.0)
        row, column = np.unravel_index(int(cosine.argmax()), cosine.shape)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0)).astype(np.float32)
        if angle[row, column] > _PIXELS * math.sqrt(lens.solid_angle_sr / lens.imaged.sum()) or not sky[row, column]:
            return np.zeros(lens.u.shape, np.float32)
        falls_in = math.pi * max(float(lens.z_share[row, column]), 0.0)
        around = np.exp(-angle / _HALO_RAD) / (2 * math.pi * _HALO_RAD**2)
        return np.asarray(falls_in * (0.5 / lens.solid_angle_sr + 0.5 * around), np.float32)


_PIXELS = 2.0
"""The sun is in the image where a pixel is so near to it, in pixels."""


def _spots(
    share: float, size: tuple[int, int], radii: tuple[float, float], rng: np.random.Generator,
    depths: tuple[float, float],
) -> Float32Array:  # fmt: skip
    """(h, w) round spots with soft edges that cover about a share of the image, each of its own depth."""
    width, height = size
    spots: Float32Array = np.zeros((height, width), np.float32)
    covered, longer = 0.0, max(size)
    while covered < share * width * height:
        radius = longer * rng.uniform(*radii)
        centre, depth = rng.uniform((0, 0), size), float(rng.uniform(*depths))
        spot = np.zeros((height, width), np.float32)
        cv2.circle(spot, (round(centre[0]), round(centre[1])), round(radius), (depth,), cv2.FILLED)
        spot = np.asarray(cv2.GaussianBlur(spot, (0, 0), _SOFT * radius), np.float32)
        spots = 1 - (1 - spots) * (1 - spot)
        covered += math.pi * radius**2
    return spots
