"""The effects of a real, cheap camera on a sharp picture, at the camera's own resolution.

A drone is 6 to 60 pixels wide there, so a blur of a pixel or two of the second stage's enlarged crop is far too little.
The crop is shrunk to the size that the camera saw it in, passes the steps of a camera in their order, and is enlarged
again the way the pipeline does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.sim.cameras.real_camera import jpeg

Image = NDArray[np.uint8]
_LEAST_SIDE_PX = 8
UNTOUCHED = 0.5
"""Share of the images that stay as they are, as a good camera in good light gives them."""


@dataclass(frozen=True)
class CameraEffects:
    """One camera at one moment; lengths are pixels of the camera's image."""

    scale: float
    """Camera pixels per pixel of the sharp picture, at most 1."""
    blur_px: float
    """Standard deviation of the point spread of optics and focus."""
    smear_px: float
    smear_angle: float
    """Length and direction (rad) of what motion smears during the exposure."""
    gains: tuple[float, float, float]
    """Exposure and white balance."""
    gamma: float
    offset: float
    has_mosaic: bool
    """Whether each pixel measures one colour only (Bayer) and the others are interpolated."""
    noise: float
    """Standard deviation in grey levels."""
    denoising: float
    """Range sigma of a bilateral filter in grey levels; 0 for none."""
    sharpening: float
    """Share of an unsharp mask of 1 px that is added."""
    quality: int | None
    """JPEG; None for none."""
    resampling: float
    """The picture is scaled by it and back after that, as by a video that is made smaller."""


def drawn_effects(scale: float, rng: np.random.Generator) -> CameraEffects:
    """A random camera; a quarter have almost no faults.

    Width of edges (contrast over the steepest gradient, camera pixels, 10 / 50 / 90 % of the drones of 20-30 px).
    Skydrones' training clips 1.8 / 2.1 / 2.2, renderings merely shrunk 1.5 / 2.0 / 2.7, through these cameras 1.7 / 2.4
    / 3.4. The clips' sharpness is among them, and so are worse lenses.
    """
    is_good = rng.random() < 0.25
    exposure = float(np.exp(rng.normal(0, 0.2)))
    tint = np.exp(rng.normal(0, 0.06, 3))
    return CameraEffects(
        scale=scale,
        blur_px=float(rng.uniform(0.0, 0.4) if is_good else rng.uniform(0.2, 1.0)),
        smear_px=float(rng.exponential(1.2)) if not is_good and rng.random() < 0.3 else 0.0,
        smear_angle=float(rng.uniform(0, math.pi)),
        gains=(exposure * float(tint[0]), exposure * float(tint[1]), exposure * float(tint[2])),
        gamma=float(np.exp(rng.normal(0, 0.15))),
        offset=float(rng.normal(0, 8)),
        has_mosaic=bool(rng.random() < 0.3),
        noise=float(abs(rng.normal(0, 3.5))),
        denoising=float(rng.uniform(5, 25)) if rng.random() < 0.4 else 0.0,
        sharpening=float(rng.uniform(0.2, 1.2)) if rng.random() < 0.45 else 0.0,
        quality=None if is_good else int(rng.integers(30, 96)),
        resampling=float(rng.uniform(0.5, 1.0)) if not is_good and rng.random() < 0.3 else 1.0,
    )


def as_filmed(images: Sequence[Image], rng: np.random.Generator) -> list[Image]:
    """The images (h, w, 3), unchanged with probability ``UNTOUCHED``; else as one camera shows them, each blurred."""
    if rng.random() < UNTOUCHED:
        return list(images)
    effects = drawn_effects(float(np.exp(rng.uniform(math.log(0.5), 0.0))), rng)
    smears = [(effects.smear_px * rng.uniform(0.0, 2.0), rng.uniform(0, math.pi)) for _ in images]
    each = [replace(effects, smear_px=length_px, smear_angle=angle) for length_px, angle in smears]
    return [through_camera(image, one, rng) for image, one in zip(images, each, strict=True)]


def through_camera(sharp: Image, effects: CameraEffects, rng: np.random.Generator) -> Image:
    """The picture (h, w, 3), RGB, as that camera shows it, at the same size."""
    height, width = sharp.shape[:2]
    size = (max(_LEAST_SIDE_PX, round(width * effects.scale)), max(_LEAST_SIDE_PX, round(height * effects.scale)))
    small: Image = _resized(sharp, size)
    if effects.blur_px > 0.05:
        small = np.asarray(cv2.GaussianBlur(small, (0, 0), effects.blur_px, borderType=cv2.BORDER_REPLICATE), np.uint8)
    if effects.smear_px > 0.3:
        kernel = smear_kernel(effects.smear_px, effects.smear_angle)
        small = np.asarray(cv2.filter2D(small, -1, kernel, borderType=cv2.BORDER_REPLICATE), np.uint8)
    ramp = np.arange(256) / 255.0
    tables = 255 * ramp[:, None] ** effects.gamma * np.array(effects.gains) + effects.offset
    small = np.asarray(cv2.LUT(small, np.clip(tables, 0, 255).astype(np.uint8)[None]), np.uint8)
    if effects.noise > 0.3:
        small = _clipped(small + effects.noise * rng.standard_normal(small.shape, dtype=np.float32))
    if effects.has_mosaic:
        small = demosaiced(small)
    if effects.denoising > 0:
        small = np.asarray(cv2.bilateralFilter(small, 5, effects.denoising, 1.5), np.uint8)
    if effects.sharpening > 0:
        soft = cv2.GaussianBlur(small, (0, 0), 1.0)
        small = np.asarray(cv2.addWeighted(small, 1 + effects.sharpening, soft, -effects.sharpening, 0), np.uint8)
    if effects.resampling < 1.0:
        less = (max(4, round(size[0] * effects.resampling)), max(4, round(size[1] * effects.resampling)))
        small = _resized(_resized(small, less), size)
    if effects.quality is not None:
        small = _compressed(small, effects.quality, rng)
    return _resized(small, (width, height))


def smear_kernel(length_px: float, angle: float) -> NDArray[np.float32]:
    """Blur kernel of a uniform motion along a line; sums to 1."""
    reach = math.ceil(length_px / 2) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for share in (np.arange(16 * reach) + 0.5) / (16 * reach) - 0.5:
        u, v = reach + share * length_px * math.cos(angle), reach + share * length_px * math.sin(angle)
        left, top = int(u), int(v)
        for du, wu in ((0, 1 - (u - left)), (1, u - left)):
            for dv, wv in ((0, 1 - (v - top)), (1, v - top)):
                if wu * wv > 0:
                    kernel[top + dv, left + du] += wu * wv
    return np.asarray(kernel / kernel.sum(), np.float32)


def demosaiced(image: Image) -> Image:
    """The RGB image as an RGGB sensor measures it, interpolated bilinearly; sizes may be odd."""
    height, width = image.shape[:2]
    even = cv2.copyMakeBorder(image, 2, 2 + height % 2, 2, 2 + width % 2, cv2.BORDER_REFLECT_101)
    raw = even[:, :, 1].copy()
    raw[0::2, 0::2], raw[1::2, 1::2] = even[0::2, 0::2, 0], even[1::2, 1::2, 2]
    # OpenCV names the pattern by its second row and column: this one is RGGB from the corner.
    colours = cv2.cvtColor(raw, cv2.COLOR_BayerBG2RGB)
    return np.asarray(colours[2 : 2 + height, 2 : 2 + width], np.uint8)


def _compressed(image: Image, quality: int, rng: np.random.Generator) -> Image:
    """The image after JPEG, whose blocks begin anywhere, as in a part of a larger image."""
    left, top = int(rng.integers(8)), int(rng.integers(8))
    wide = cv2.copyMakeBorder(image, top, 8, left, 8, cv2.BORDER_REFLECT_101)
    packed = jpeg(np.asarray(wide, np.uint8), quality)
    return np.ascontiguousarray(packed[top : top + image.shape[0], left : left + image.shape[1]])


def _clipped(values: NDArray[np.float32]) -> Image:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _resized(image: Image, size: tuple[int, int]) -> Image:
    shrinks = size[0] < image.shape[1]
    return np.asarray(
        cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR), dtype=np.uint8
    )
