"""Grey levels of images to linear light and back (sRGB, IEC 61966-2-1): optics and sensors add up light."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import Float32Array, UInt8Array

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
