"""What cameras do to a picture: colour, exposure, blur, noise, compression."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.sim.cameras.compression import jpeg
from tools.training.camera_effects import drawn_effects, through_camera

Image = NDArray[np.uint8]
UNTOUCHED = 0.5
"""Share of the images that stay as they are, as a good camera in good light gives them."""


def photometric(images: list[Image], rng: np.random.Generator) -> list[Image]:
    """The same lens and light for all ``images`` (h, w, 3), fresh noise for each; or none of it."""
    if rng.random() < UNTOUCHED:
        return images
    gain = np.exp(rng.normal(0, 0.18)) * np.exp(rng.normal(0, 0.07, 3))
    offset = rng.normal(0, 8)
    gamma = np.exp(rng.normal(0, 0.15))
    ramp = np.arange(256) / 255.0
    tables = np.clip(255 * ramp[:, None] ** gamma * gain + offset, 0, 255).astype(np.uint8)
    blur = rng.random() < 0.3
    blur_px = rng.uniform(0.4, 1.0)
    noise = abs(rng.normal(0, 4.0))
    quality = int(rng.integers(50, 95)) if rng.random() < 0.3 else None
    out = []
    for image in images:
        changed: NDArray[Any] = cv2.LUT(image, tables[None])
        if blur:
            changed = cv2.GaussianBlur(changed, (0, 0), blur_px)
        if noise > 0.3:
            height, width = min(256, changed.shape[0]), min(257, changed.shape[1] + 1)
            grain = rng.standard_normal(size=(height, width), dtype=np.float32) * noise
            grain = np.tile(grain, (1 + changed.shape[0] // height, 1 + changed.shape[1] // width))
            grain = np.roll(grain, int(rng.integers(1 << 16)))[: changed.shape[0], : changed.shape[1]]
            changed = cv2.add(changed, cv2.merge([grain] * 3), dtype=cv2.CV_8U)
        if quality is not None:
            changed = jpeg(np.asarray(changed, np.uint8), quality)
        out.append(np.asarray(changed, dtype=np.uint8))
    return out


def as_filmed(image: Image, rng: np.random.Generator) -> Image:
    """The image (h, w, 3) as a camera delivers it: half of them through a cheap one, the others as of `photometric`."""
    if rng.random() < 0.5:
        (changed,) = photometric([image], rng)
        return changed
    return through_camera(image, drawn_effects(float(np.exp(rng.uniform(math.log(0.5), 0.0))), rng), rng)


def motion_blur(images: list[Image], rng: np.random.Generator) -> list[Image]:
    """Half of the time each image smeared along a line of its own, as by a camera that turns while it exposes."""
    if rng.random() < 0.5:
        return images
    return [_smeared(image, rng.uniform(0.0, 0.05) * image.shape[1], rng.uniform(0.0, np.pi)) for image in images]


def _smeared(image: Image, length_px: float, angle: float) -> Image:
    reach = int(np.ceil(length_px / 2)) + 1
    ends = reach + np.outer([-0.5, 0.5], length_px * np.array([np.cos(angle), np.sin(angle)]))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for share in np.linspace(0.0, 1.0, 4 * reach):
        u, v = ends[0] + share * (ends[1] - ends[0])
        kernel[round(v), round(u)] += 1.0
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), dtype=np.uint8)
