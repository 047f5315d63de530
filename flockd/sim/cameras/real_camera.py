"""Real cameras: from a view that was drawn to the image that a drone gets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from flockd.core.messages import BoolArray, Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry import Camera
from flockd.sim.cameras.shutter import CameraMotion, LensField, Shaking, exposed
from flockd.sim.renderer.renderer import View
from flockd.sim.scenario.imperfect_cameras import (
    AutomaticConfig,
    CamerasConfig,
    CameraTimingConfig,
    LensFaultsConfig,
    SensorNoiseConfig,
)  # fmt: skip

_STEPS = 1 << 14
"""Of linear light in the table back: each grey level has five at least, so that all 256 come back as they were."""
_GREY = np.arange(256) / 255.0
_LINEAR = np.where(_GREY <= 0.04045, _GREY / 12.92, ((_GREY + 0.055) / 1.055) ** 2.4).astype(np.float32)
_LIGHT = np.arange(_STEPS) / (_STEPS - 1)
_BACK = np.rint(
    255.0 * np.where(_LIGHT <= 0.0031308, 12.92 * _LIGHT, 1.055 * np.maximum(_LIGHT, 1e-9) ** (1 / 2.4) - 0.055)
).astype(np.uint8)


def linear_light(image: UInt8Array) -> Float32Array:
    """Linear light (h, w, 3), 1 for white, of grey levels."""
    return np.asarray(cv2.LUT(image, _LINEAR), np.float32)


def grey_levels(light: Float32Array) -> UInt8Array:
    """(h, w, 3) of linear light; what is beyond white or below black is cut."""
    steps = np.rint(np.clip(light, 0.0, 1.0) * np.float32(_STEPS - 1)).astype(np.uint16)
    return np.asarray(_BACK[steps], np.uint8)


_UNPACKING = {1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4}


def jpeg(image: UInt8Array, quality: int, reduce: Literal[1, 2, 4] = 1) -> UInt8Array:
    """The RGB image (h, w, 3) after a JPEG of a quality from 1 to 100, with half the resolution of colours (4:2:0).

    Unpacked as (h / reduce, w / reduce, 3), as a camera's is (`flockd.onboard.sources.image_formats`).
    """
    _, packed = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    unpacked = cv2.imdecode(packed, _UNPACKING[reduce])
    assert unpacked is not None, "what was just packed can be unpacked"
    return np.asarray(cv2.cvtColor(unpacked, cv2.COLOR_BGR2RGB), np.uint8)


@dataclass(frozen=True)
class Shot:
    """One image's times."""

    stamp_s: float
    """As it says itself."""
    shown_s: float
    """When its middle row was exposed."""
    comes: bool


class CameraClock:
    """One camera's: where in its period it runs is drawn once, jitter and drops for each image."""

    def __init__(self, config: CameraTimingConfig, rng: np.random.Generator) -> None:
        self._config, self._rng = config, rng
        self._before_s = float(config.apart_s * rng.random())

    def shot(self, time_s: float) -> Shot:
        """Of the frame set of a time."""
        jitter, dropped = self._rng.random(2)
        stamp_s = time_s - self._before_s
        shown_s = stamp_s - self._config.delay_s - self._config.jitter_s * float(jitter)
        return Shot(stamp_s, shown_s, bool(dropped >= self._config.dropped))


_TARGET = 0.18
"""Mean of the linear light that exposure meters aim at."""
_MOST_GAIN, _MOST_BALANCE = 4.0, 1.6
_STRIDE = 8
"""Of the pixels that are metered."""
NOISE_TILE = (1031, 1033)


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

    def __init__(self, rng: np.random.Generator) -> None:
        self._tile = rng.standard_normal((*NOISE_TILE, 3), dtype=np.float32)

    def crop(
        self, size: tuple[int, ...], rng: np.random.Generator, within: tuple[int, int] = NOISE_TILE
    ) -> Float32Array:
        """(height, width, 3) of `size` from a place drawn `within` the first rows and columns, on past its borders."""
        rows, columns = (rng.integers(begins) + np.arange(side) for begins, side in zip(within, size, strict=True))
        return self._tile.take(rows, axis=0, mode="wrap").take(columns, axis=1, mode="wrap")


def noisy(light: Float32Array, normal: Float32Array, config: SensorNoiseConfig, brightened: float) -> Float32Array:
    """Linear light (h, w, 3) with a sensor's noise, of standard normal noise of its shape.

    EMVA 1288, equation of the photon transfer: the variance of a grey value is that of reading, times the square of the
    gain, and the gain times the mean. The gain is white over the electrons that give it; ``brightened`` is what the
    automatic exposure amplified beside it.
    """
    per_electron = np.float32(config.gain * max(brightened, 1.0) / config.full_well_e)
    variance = np.maximum(light, 0.0) * per_electron + np.float32((per_electron * config.read_noise_e) ** 2)
    return np.asarray(light + np.sqrt(variance) * normal, np.float32)


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


class RealCamera:
    """One camera of one drone, with its own dirt, phases and noise. Its images depend on no other camera's."""

    def __init__(self, config: CamerasConfig, lens: LensField, tile: NoiseTile, seed: tuple[int, ...]) -> None:
        """``seed`` is of this camera alone."""
        height, width = lens.u.shape
        self._config, self._lens, self._tile = config, lens, tile
        self.clock = CameraClock(config.timing, np.random.default_rng([*seed, 0]))
        self.shaking = Shaking(config.shake, np.random.default_rng([*seed, 1]))
        self._glass = Glass.of(config.lens, (width, height), np.random.default_rng([*seed, 2]))
        self._automatic = Automatic(config.automatic)
        self._rng = np.random.default_rng([*seed, 3])

    def image(self, view: View, motion: CameraMotion, time_s: float, sun: FloatArray) -> UInt8Array:
        """What the sensor sees, in the order of light: shutter, glass, automatics, noise by gain.

        ``sun`` (3,) is the unit vector towards it in the camera's axes. What is not configured changes no bit.
        """
        config, lens = self._config, self._lens
        light = linear_light(view.rgb)
        light = exposed(light, view, lens, motion, config.shutter)
        if config.lens.flare or config.lens.dirt or config.lens.drops:
            light = self._glass.passed(light, lens, np.isinf(view.depth), sun)
        brightened = 1.0
        if config.automatic.exposure or config.automatic.white_balance:
            gains = self._automatic.gains(light, lens.imaged, time_s)
            light, brightened = light * gains.astype(np.float32), float(gains[1])
        height, width = (config.reduce * side for side in lens.u.shape)
        if config.reduce > 1:
            light = np.asarray(cv2.resize(light, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)
        if config.noise.gain > 0:
            light = noisy(light, self._tile.crop((height, width), self._rng), config.noise, brightened)
        return grey_levels(light)

    def compressed(self, image: UInt8Array) -> UInt8Array:
        """The image as the camera sends it."""
        quality, reduce = self._config.compression.jpeg_quality, self._config.reduce
        if quality is not None:
            return jpeg(image, quality, reduce)
        height, width = self._lens.u.shape
        return image if reduce == 1 else np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def real_cameras(
    config: CamerasConfig, cameras: Mapping[str, Camera], drones: int, seed: int
) -> dict[tuple[int, str], RealCamera]:
    """The same lenses on each of so many drones, by drone (from 0) and name."""
    tile = NoiseTile(np.random.default_rng([seed, 6]))
    lenses = {name: LensField.of(camera) for name, camera in cameras.items()}
    return {
        (drone, name): RealCamera(config, lens, tile, (seed, 4, drone, number))
        for drone in range(drones)
        for number, (name, lens) in enumerate(lenses.items())
    }
