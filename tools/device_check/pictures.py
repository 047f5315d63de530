"""Pictures that a camera of the check shows: made alike wherever they are needed, each with its number."""

from __future__ import annotations

import functools

import cv2
import numpy as np

from flockd.messages import UInt8Array

COUNT = 16
"""Then they begin again; no two that follow each other are the same."""
Size = tuple[int, int]
"""Width, height."""


@functools.cache
def mjpeg(size: Size, number: int) -> bytes:
    """One JPEG."""
    done, encoded = cv2.imencode(".jpg", _scene(size, number), [cv2.IMWRITE_JPEG_QUALITY, 90])
    assert done
    return encoded.tobytes()


@functools.cache
def yuyv(size: Size, number: int) -> bytes:
    """Every byte by chance, within what video allows."""
    return np.random.default_rng(number).integers(16, 236, size[0] * size[1] * 2, np.uint8).tobytes()


def _scene(size: Size, number: int) -> UInt8Array:
    """Soft blobs that move a little from one to the next, as a landscape does that is flown over."""
    width, height = size
    coarse = np.random.default_rng(0).integers(0, 256, (height // 8 + 4, width // 8 + 2 * COUNT, 3), np.uint8)
    whole = cv2.resize(coarse, None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(whole[:height, 2 * number : 2 * number + width])
