"""Compression of images as cameras do it."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from flockd.core.messages import UInt8Array

_UNPACKING = {1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4}


def jpeg(image: UInt8Array, quality: int, reduce: Literal[1, 2, 4] = 1) -> UInt8Array:
    """The RGB image (h, w, 3) after a JPEG of a quality from 1 to 100, with half the resolution of colours (4:2:0).

    Unpacked as (h / reduce, w / reduce, 3), as a camera's is (`flockd.onboard.sources.image_formats`).
    """
    _, packed = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    unpacked = cv2.imdecode(packed, _UNPACKING[reduce])
    assert unpacked is not None, "what was just packed can be unpacked"
    return np.asarray(cv2.cvtColor(unpacked, cv2.COLOR_BGR2RGB), np.uint8)
