"""The two kinds of depth map, and the border between them: ranges inside flockd, z where others measure it."""

from __future__ import annotations

from functools import lru_cache
from typing import NewType

import numpy as np

from flockd.core.messages import BoolArray, Float32Array
from flockd.flight.geometry.cameras import Camera

ZMap = NewType("ZMap", Float32Array)
"""(h, w) metres along the optical axis: what networks, renderers and depth cameras give."""
RangeMap = NewType("RangeMap", Float32Array)
"""(h, w) metres along each pixel's ray, as `Camera.unproject` takes them: what all of flockd computes with."""


def range_map(z: ZMap, camera: Camera) -> RangeMap:
    """The ranges of a map of the camera's size; NaN where the lens images nothing, or 90 degrees off its axis."""
    return RangeMap(z / _axial_share(camera))


def z_map(ranges: RangeMap, camera: Camera) -> ZMap:
    """The way back, for what shows depth as others do."""
    return ZMap(ranges * _axial_share(camera))


@lru_cache(maxsize=32)
def _axial_share(camera: Camera) -> Float32Array:
    """(h, w) z over range of each pixel; NaN where there is none, or it is not positive."""
    width, height = camera.size
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    share = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))[:, 2].reshape(height, width)
    return np.where(share > 0.0, share, np.nan).astype(np.float32)


@lru_cache(maxsize=64)
def blind_pixels(camera: Camera, stride: int = 1) -> BoolArray:
    """(h / stride, w / stride) blocks of pixels in which the lens images nothing, by their centres."""
    width, height = camera.size
    u, v = np.meshgrid(np.arange(0, width, stride) + stride / 2.0, np.arange(0, height, stride) + stride / 2.0)
    rays = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))
    return np.isnan(rays[:, 0]).reshape(u.shape)
