"""The flow of the background where an image has no texture to follow: inpainted from what is around."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import UNCLASSED, BoolArray, Float32Array, FloatArray, UInt8Array
from flockd.flight.perception.flow.images import gradients, grey

_CELL_PX = 4
"""Cell size of the map that all of this works on."""
_WINDOW_CELLS = 5
"""Over which texture is measured."""
_PYRAMID_LEVELS = 4
"""Halvings of the map over which flow spreads."""
_SURROUNDINGS_WEIGHT = 0.1
"""What is around weighs like texture of this much, (grey levels a cell)^2."""
_NOISE_LEVELS = 0.3
"""Grey levels by which the images may differ along the flow before it counts for less."""
_MIN_WEIGHT = 1e-4
_HALF_TEXTURE = 1.0
"""With this much texture a cell keeps half of its own flow."""
_DRONE_MARGIN_PX = 20
"""So near to a drone no flow is used: it mixes with the drone's own."""
_HOMOGRAPHY_STRIDE_CELLS = 8
_HOMOGRAPHY_MIN_TEXTURE = 0.5
_HOMOGRAPHY_MIN_CELLS = 30
_HOMOGRAPHY_TOLERANCE_CELLS = 1.0
_HOMOGRAPHY_MAX_ERROR = 0.25
"""A homography is no use that is off by more than this share of the image's width at the median."""


def background_flow(
    flow: Float32Array,
    first: UInt8Array,
    second: UInt8Array,
    labels: UInt8Array,
) -> Float32Array:
    """The flow with that of the background inpainted where the images do not show it: in the sky, beside drones.

    What the flow differs from the homography that most of it follows is spread from where there is texture, and where
    the images agree along it, to where not (normalised convolution, Knutsson & Westin 1993, over a pyramid).

    Args:
        flow: (h, w, 2) pixels from the first image to the second.
        first: (h, w, 3) RGB.
        second: (h, w, 3) RGB.
        labels: (h, w) of the first image: 0 the background, 255 not to be used, else one value a drone.
    """
    height, width = labels.shape
    cell = _CELL_PX
    size = (width // cell, height // cell)
    before, after = _small_grey(first, size), _small_grey(second, size)
    coarse = np.asarray(cv2.resize(flow, size, interpolation=cv2.INTER_AREA) / cell, np.float32)
    reach = 2 * (_DRONE_MARGIN_PX // cell) + 1
    drone_pixels = ((labels > 0) & (labels != UNCLASSED)).astype(np.uint8)
    drones = cv2.resize(drone_pixels, size, interpolation=cv2.INTER_NEAREST)
    free = cv2.dilate(drones, np.ones((reach, reach), np.uint8)) == 0
    window = (_WINDOW_CELLS, _WINDOW_CELLS)
    texture = _texture(before, window)
    difference = _difference(before, after, coarse, window)
    weight = texture * free / (1.0 + (difference / _NOISE_LEVELS) ** 2) + np.float32(_MIN_WEIGHT)
    plane = _homography_flow(coarse, (texture > _HOMOGRAPHY_MIN_TEXTURE) & free)
    change = _spread(coarse - plane, weight) + plane - coarse
    unknown = np.where(free, 1.0 / (1.0 + (texture / _HALF_TEXTURE) ** 2), 1.0).astype(np.float32)
    change *= unknown[..., None]
    full = cv2.resize(cell * change, (width, height), interpolation=cv2.INTER_LINEAR)
    if drones.any():
        full[drone_pixels > 0] = 0.0
    return np.asarray(cv2.add(flow, full, dst=full), np.float32)


def _small_grey(image: UInt8Array, size: tuple[int, int]) -> Float32Array:
    return np.asarray(cv2.resize(grey(image), size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _texture(image: Float32Array, window: tuple[int, int]) -> Float32Array:
    """The lesser eigenvalue of the structure tensor: how well a cell can be followed both ways (Shi & Tomasi 1994)."""
    right, down = gradients(image, "sobel")
    uu, uv, vv = (cv2.blur(product, window) for product in (right * right, right * down, down * down))
    least = (uu + vv) / 2 - np.sqrt(((uu - vv) / 2) ** 2 + uv**2)
    return np.asarray(np.maximum(least, 0.0), np.float32)


def _difference(before: Float32Array, after: Float32Array, flow: Float32Array, window: tuple[int, int]) -> Float32Array:
    """Mean grey levels by which the images differ along the flow, over a window."""
    height, width = before.shape
    to = _cells(height, width).astype(np.float32) + flow
    warped = cv2.remap(after, to[..., 0], to[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.blur(np.abs(before - warped), window), np.float32)


def _homography_flow(flow: Float32Array, sure: BoolArray) -> Float32Array:
    """The flow of the homography that most of what is sure follows; none where there is no such."""
    none = np.zeros_like(flow)
    height, width = sure.shape
    stride = _HOMOGRAPHY_STRIDE_CELLS
    some = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    cells = _cells(height, width)
    start = cells[some][sure[some]]
    if len(start) < _HOMOGRAPHY_MIN_CELLS:
        return none
    end = start + flow[some][sure[some]]
    found, _ = cv2.findHomography(start, end, cv2.USAC_MAGSAC, _HOMOGRAPHY_TOLERANCE_CELLS)
    if found is None:
        return none
    along = (cv2.perspectiveTransform(cells, np.asarray(found, np.float64)) - cells).astype(np.float32)
    off = np.linalg.norm(along - flow, axis=2)
    allowed = _HOMOGRAPHY_MAX_ERROR * width
    usable = np.isfinite(along).all() and np.median(off) < allowed and off.max() < width
    return along if usable else none


@lru_cache(maxsize=8)
def _cells(height: int, width: int) -> FloatArray:
    """(h, w, 2) column and row of each cell; not to be changed."""
    v, u = np.mgrid[:height, :width].astype(np.float64)
    return np.stack([u, v], 2)


def _spread(values: Float32Array, weight: Float32Array) -> Float32Array:
    """(h, w, 2) each cell's own by its weight, what is around by a fixed one."""
    levels: list[tuple[NDArray[Any], NDArray[Any]]] = [(values * weight[..., None], weight)]
    for _ in range(_PYRAMID_LEVELS):
        levels.append((cv2.pyrDown(levels[-1][0]), cv2.pyrDown(levels[-1][1])))
    around = levels[-1][0] / levels[-1][1][..., None]
    share = _SURROUNDINGS_WEIGHT
    for sums, weights in levels[-2::-1]:
        wider = cv2.pyrUp(around, dstsize=(weights.shape[1], weights.shape[0]))
        around = (sums + share * wider) / (weights + share)[..., None]
    return np.asarray(around, np.float32)
