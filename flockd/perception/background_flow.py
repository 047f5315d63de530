"""The flow of the background where an image shows too little to follow: it is told by what is around."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.messages import UNCLASSED, BoolArray, Float32Array, UInt8Array

_CELL_PX = 4
_WINDOW, _LEVELS = 5, 4
"""Cells over which a place's texture is measured; halvings of the map over which places learn from one another."""
_AROUND = 0.1
"""What is around weighs like texture of this much, (grey levels a cell)^2."""
_NOISE = 0.3
"""Grey levels by which the images may differ along the flow before it counts for less."""
_LEAST_WEIGHT = 1e-4
_TEXTURED = 1.0
"""With this much texture a place keeps half of its own flow."""
_NEAR_DRONE_PX = 20
_SAMPLED_CELLS = 8
_LEAST_TEXTURE = 0.5
_LEAST_SAMPLES = 30
_PLANE_TOLERANCE_CELLS = 1.0
_FARTHEST_FROM_PLANE = 0.25
"""A plane is no use that is off by more than this share of the image's width at the median."""


def settle_background(flow: Float32Array, first: UInt8Array, second: UInt8Array, labels: UInt8Array) -> Float32Array:
    """The flow with that of the background settled where the images do not tell it: in the sky, beside drones.

    What the flow differs from the homography that most of it follows is spread from where there is texture, and where
    the images agree along it, to where not (normalised convolution, Knutsson & Westin 1993, over a pyramid).

    Args:
        flow: (h, w, 2) pixels from the first image to the second.
        first: (h, w, 3) RGB.
        second: (h, w, 3) RGB.
        labels: (h, w) of the first image: 0 the background, 255 not to be used, else one value a drone.
    """
    height, width = labels.shape
    size = (width // _CELL_PX, height // _CELL_PX)
    before, after = _shrunk(first, size), _shrunk(second, size)
    coarse = np.asarray(cv2.resize(flow, size, interpolation=cv2.INTER_AREA) / _CELL_PX, np.float32)
    reach = 2 * (_NEAR_DRONE_PX // _CELL_PX) + 1
    drone_pixels = ((labels > 0) & (labels != UNCLASSED)).astype(np.uint8)
    drones = cv2.resize(drone_pixels, size, interpolation=cv2.INTER_NEAREST)
    free = cv2.dilate(drones, np.ones((reach, reach), np.uint8)) == 0
    texture = _texture(before)
    weight = texture * free / (1.0 + (_difference(before, after, coarse) / _NOISE) ** 2) + np.float32(_LEAST_WEIGHT)
    plane = _plane(coarse, (texture > _LEAST_TEXTURE) & free)
    change = _spread(coarse - plane, weight) + plane - coarse
    unknown = np.where(free, 1.0 / (1.0 + (texture / _TEXTURED) ** 2), 1.0).astype(np.float32)
    change *= unknown[..., None]
    full = cv2.resize(_CELL_PX * change, (width, height), interpolation=cv2.INTER_LINEAR)
    if drones.any():
        full[drone_pixels > 0] = 0.0
    return np.asarray(cv2.add(flow, full, dst=full), np.float32)


def _shrunk(image: UInt8Array, size: tuple[int, int]) -> Float32Array:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _texture(image: Float32Array) -> Float32Array:
    """The lesser eigenvalue of the structure tensor: how well a place can be followed both ways (Shi & Tomasi 1994)."""
    right, down = (cv2.Sobel(image, cv2.CV_32F, *way, ksize=3, scale=1 / 8) for way in ((1, 0), (0, 1)))
    uu, uv, vv = (cv2.blur(product, (_WINDOW, _WINDOW)) for product in (right * right, right * down, down * down))
    least = (uu + vv) / 2 - np.sqrt(((uu - vv) / 2) ** 2 + uv**2)
    return np.asarray(np.maximum(least, 0.0), np.float32)


def _difference(before: Float32Array, after: Float32Array, flow: Float32Array) -> Float32Array:
    """Mean grey levels by which the images differ along the flow, over a window."""
    height, width = before.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    moved = cv2.remap(after, u + flow[..., 0], v + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.blur(np.abs(before - moved), (_WINDOW, _WINDOW)), np.float32)


def _plane(flow: Float32Array, sure: BoolArray) -> Float32Array:
    """The flow of the homography that most of what is sure follows; none where there is no such."""
    none = np.zeros_like(flow)
    height, width = sure.shape
    step = np.s_[_SAMPLED_CELLS // 2 :: _SAMPLED_CELLS]
    rows, columns = (axis[step, step][sure[step, step]] for axis in np.mgrid[:height, :width])
    if len(rows) < _LEAST_SAMPLES:
        return none
    start = np.stack([columns, rows], 1).astype(np.float64)
    found, _ = cv2.findHomography(start, start + flow[rows, columns], cv2.USAC_MAGSAC, _PLANE_TOLERANCE_CELLS)
    if found is None:
        return none
    v, u = np.mgrid[:height, :width].astype(np.float64)
    places = np.stack([u, v], 2)
    along = (cv2.perspectiveTransform(places, np.asarray(found, np.float64)) - places).astype(np.float32)
    off = np.linalg.norm(along - flow, axis=2)
    usable = np.isfinite(along).all() and np.median(off) < _FARTHEST_FROM_PLANE * width and off.max() < width
    return along if usable else none


def _spread(values: Float32Array, weight: Float32Array) -> Float32Array:
    """(h, w, 2) each place's own by its weight, what is around by a fixed one."""
    levels: list[tuple[NDArray[Any], NDArray[Any]]] = [(values * weight[..., None], weight)]
    for _ in range(_LEVELS):
        levels.append((cv2.pyrDown(levels[-1][0]), cv2.pyrDown(levels[-1][1])))
    around = levels[-1][0] / levels[-1][1][..., None]
    for sums, weights in levels[-2::-1]:
        wider = cv2.pyrUp(around, dstsize=(weights.shape[1], weights.shape[0]))
        around = (sums + _AROUND * wider) / (weights + _AROUND)[..., None]
    return np.asarray(around, np.float32)
