"""Images that a camera of the check shows: made alike wherever they are needed, each with its number."""

from __future__ import annotations

import functools

import cv2
import numpy as np

from flockd.core.messages import UInt8Array

COUNT = 16
"""Then they begin again; no two that follow each other are the same."""
Size = tuple[int, int]
"""Width, height."""
_SKY, _GRASS = (215, 190, 170), (80, 130)
"""The colour, blue first; from how bright to how bright."""
_PASSING_PX = 4


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
    """Sky above grass that passes by. Nothing resembles a drone: to range one takes an emulated processor long."""
    width, height = size
    wide, high = width + _PASSING_PX * COUNT, height - height // 2
    blades = np.random.default_rng(0).integers(*_GRASS, (high // 2, wide // 2, 3), dtype=np.uint8)
    grass = cv2.resize(blades, (wide, high))
    image = np.full((height, width, 3), _SKY, np.uint8)
    image[height // 2 :] = grass[:, _PASSING_PX * number :][:, :width]
    return image
