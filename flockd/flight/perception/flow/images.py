"""Grey levels, smoothing and smaller images, as several methods of flow need them."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import UInt8Array


def grey(image: UInt8Array) -> UInt8Array:
    """(h, w) grey levels of (h, w, 3) RGB."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def shrunk(image: UInt8Array, size: tuple[int, int]) -> UInt8Array:
    """A grey image (h, w) at (width, height), by means over areas; by halves first, in a fifth of the time."""
    while min(image.shape[1] / size[0], image.shape[0] / size[1]) >= 2.0:
        half = image.shape[1] // 2, image.shape[0] // 2
        image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
