"""Real cameras: from a view that was drawn to the image that a drone gets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from flockd.core.messages import BoolArray, Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry import Camera
from flockd.sim.cameras.imperfect_cameras import CamerasConfig, CameraTimingConfig, SensorNoiseConfig
from flockd.sim.cameras.shutter import CameraMotion, LensField, Shaking, exposed
from flockd.sim.renderer.renderer import View

_STEPS = 1 << 14
"""Steps of linear light in the table of grey levels: at least five a level, so that all 256 survive both ways."""
_GREY = np.arange(256) / 255.0
_LINEAR = np.where(_GREY <= 0.04045, _GREY / 12.92, ((_GREY + 0.055) / 1.055) ** 2.4).astype(np.float32)
_LIGHT = np.minimum(np.arange(1 << 16) / (_STEPS - 1), 1.0)
_BACK = np.rint(
    255.0 * np.where(_LIGHT <= 0.0031308, 12.92 * _LIGHT, 1.055 * np.maximum(_LIGHT, 1e-9) ** (1 / 2.4) - 0.055)
).astype(np.uint8)


def linear_light(image: UInt8Array) -> Float32Array:
    """Linear light (h, w, 3), 1 for white, of an image in grey levels (h, w, 3)."""
    return np.asarray(cv2.LUT(image, _LINEAR), np.float32)


def grey_levels(light: Float32Array) -> UInt8Array:
    """Grey levels (h, w, 3) of linear light; light beyond white or below black is cut."""
    steps = cv2.multiply(light, np.full(4, _STEPS - 1.0), dtype=cv2.CV_16U)
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
    """The times of one image."""

    stamp_s: float
    """Its own time stamp."""
    shown_s: float
    """When its middle row was exposed."""
    comes: bool


class CameraClock:
    """The times of one camera's images: its phase is drawn once, jitter and losses for each image."""

    def __init__(self, config: CameraTimingConfig, rng: np.random.Generator) -> None:
        self._config, self._rng = config, rng
        self._before_s = float(config.apart_s * rng.random())

    def shot(self, time_s: float) -> Shot:
        """The times of its image in the frame set of a time."""
        jitter, dropped = self._rng.random(2)
        stamp_s = time_s - self._before_s
        shown_s = stamp_s - self._config.delay_s - self._config.jitter_s * float(jitter)
        return Shot(stamp_s, shown_s, bool(dropped >= self._config.dropped))


NOISE_TILE = (1031, 1033)


class NoiseTile:
    """A tile of standard normal noise, of which images take crops."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.normal: Float32Array = rng.standard_normal((*NOISE_TILE, 3), dtype=np.float32)

    def crop(self, size: tuple[int, ...], rng: np.random.Generator) -> Float32Array:
        """(height, width, 3) of `size` at a drawn place."""
        return np.asarray(self.normal[place_in_tile(size, rng)], np.float32)


def place_in_tile(size: tuple[int, ...], rng: np.random.Generator, within: tuple[int, int] = NOISE_TILE) -> Any:
    """Index of (height, width) of `size`, from a place drawn `within` the first rows and columns, on past borders."""
    (top, left), (height, width) = (int(rng.integers(begins)) for begins in within), size
    if top + height <= NOISE_TILE[0] and left + width <= NOISE_TILE[1]:
        return np.s_[top : top + height, left : left + width]
    return np.ix_(np.arange(top, top + height) % NOISE_TILE[0], np.arange(left, left + width) % NOISE_TILE[1])


def noisy(light: Float32Array, normal: Float32Array, config: SensorNoiseConfig) -> Float32Array:
    """Linear light (h, w, 3) with a sensor's noise, made from standard normal noise (h, w, 3).

    EMVA 1288, equation of the photon transfer: the variance of a grey value is that of reading, times the square of the
    gain, and the gain times the mean. The gain is white over the electrons that give it.
    """
    per_electron = np.float32(config.gain / config.full_well_e)
    noise = np.maximum(light, 0.0)  # in place from here on: an image of twice the size fills the cache
    noise *= per_electron
    noise += np.float32((per_electron * config.read_noise_e) ** 2)
    np.sqrt(noise, out=noise)
    noise *= normal
    noise += light
    return noise


_HALO_RAD = 0.15
"""Over which the light around the sun falls by e."""


_PIXELS = 2.0
"""The sun is in the image if a pixel is within this distance of it, in pixels."""


def veiled(light: Float32Array, flare: float, lens: LensField, sky: BoolArray, sun: FloatArray) -> Float32Array:
    """Light (h, w, 3) as it falls on the lens, with a share ``flare`` of it scattered over the image. ``sky`` (h, w):
    where nothing hides the sky; ``sun`` (3,): unit vector towards the sun, in the camera's axes."""
    imaged = lens.imaged.view(np.uint8)
    shown = np.asarray(cv2.add((1 - flare) * light, flare * np.array(cv2.mean(light, imaged))), np.float32)
    of_sun = _of_sun(lens, sky, sun)
    if of_sun is not None:
        shown += flare * of_sun[..., None]
    return shown if lens.imaged.all() else np.where(lens.imaged[..., None], shown, light)


def _of_sun(lens: LensField, sky: BoolArray, sun: FloatArray) -> Float32Array | None:
    """(h, w) of its light, all scattered over the image: half evenly, half around it; None where it is not seen.

    On the scale where white paper, square to the sun, is 1: it gets pi times as much light as it has radiance.
    """
    cosine = np.where(lens.imaged, lens.rays @ sun.astype(np.float32), np.float32(-1.0))
    row, column = np.unravel_index(int(cosine.argmax()), cosine.shape)
    nearest = math.acos(min(1.0, float(cosine[row, column])))
    if nearest > _PIXELS * math.sqrt(lens.solid_angle_sr / lens.imaged.sum()) or not sky[row, column]:
        return None
    falls_in = math.pi * max(float(lens.z_share[row, column]), 0.0)
    around = np.exp(np.arccos(np.clip(cosine, -1.0, 1.0)) / -_HALO_RAD) / (2 * math.pi * _HALO_RAD**2)
    return np.asarray(falls_in * (0.5 / lens.solid_angle_sr + 0.5 * around), np.float32)


class RealCamera:
    """One camera of one drone, with its own phases and noise. Its images depend on no other camera's."""

    def __init__(self, config: CamerasConfig, lens: LensField, tile: NoiseTile, seed: tuple[int, ...]) -> None:
        """``seed``: of this camera alone."""
        self._config, self._lens, self._tile = config, lens, tile
        self.clock = CameraClock(config.timing, np.random.default_rng([*seed, 0]))
        self.shaking = Shaking(config.shake, np.random.default_rng([*seed, 1]))
        self._rng = np.random.default_rng([*seed, 3])

    @property
    def changes_views(self) -> bool:
        """Whether `image` is another than the view that was drawn."""
        config = self._config
        faults = config.shutter.exposure_s, config.shutter.readout_s, config.lens.flare, config.noise.gain
        return any(faults) or config.reduce > 1

    def image(self, view: View, motion: CameraMotion, sun: FloatArray) -> UInt8Array:
        """What the sensor sees, in the order of light: shutter, glass, noise by gain.

        ``sun`` (3,) is the unit vector towards it in the camera's axes. What is not configured changes no bit.
        """
        config, lens = self._config, self._lens
        light = linear_light(view.rgb)
        light = exposed(light, view, lens, motion, config.shutter)
        if config.lens.flare:
            light = veiled(light, config.lens.flare, lens, np.isinf(view.depth), sun)
        height, width = (config.reduce * side for side in lens.u.shape)
        if config.reduce > 1:
            light = np.asarray(cv2.resize(light, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)
        if config.noise.gain > 0:
            light = noisy(light, self._tile.crop((height, width), self._rng), config.noise)
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
    """The cameras of all drones, with the same lenses on each, by drone (from 0) and name."""
    tile = NoiseTile(np.random.default_rng([seed, 6]))
    lenses = {name: LensField.of(camera) for name, camera in cameras.items()}
    return {
        (drone, name): RealCamera(config, lens, tile, (seed, 4, drone, number))
        for drone in range(drones)
        for number, (name, lens) in enumerate(lenses.items())
    }
