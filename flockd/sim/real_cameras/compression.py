"""Compression of images as cameras do it."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import UInt8Array


def jpeg(image: UInt8Array, quality: int) -> UInt8Array:
    """The RGB image (h, w, 3) after a JPEG of a quality from 1 to 100, with half the resolution of colours (4:2:0)."""
    _, packed = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    unpacked = cv2.imdecode(packed, cv2.IMREAD_COLOR)
    assert unpacked is not None, "what was just packed can be unpacked"
    return np.asarray(cv2.cvtColor(unpacked, cv2.COLOR_BGR2RGB), np.uint8)
