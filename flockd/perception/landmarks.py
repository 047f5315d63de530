"""A coarse flow from corners that look alike: where the images differ more than a flow can follow."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.messages import Float32Array, FloatArray, UInt8Array

_MOST_CORNERS = 2000
_LEAST_CONTRAST = 5
"""Grey levels; a blurred image has no strong corners."""
_CELL_PX = 32
_MOST_A_CELL = 25
"""Else all corners are in one plant."""
_MOST_MATCHES = 1000
_NEIGHBOURS = 12
_LEAST_MATCHES = 20
_AGREE_PX, _AGREE_SHARE = 6.0, 0.2
"""A match stays that differs from the median of those around it by less than this, and this share of it."""
_PLANE_TOLERANCE_PX = 8.0
_GRID_PX = 16
_REACH_PX = 100.0
"""Farther from all matches than this, the plane counts for more than they do."""


def flow_of_landmarks(first: UInt8Array, second: UInt8Array) -> Float32Array | None:
    """(h, w, 2) pixels from grey ``first`` (h, w) to grey ``second``; None where too few corners agree.

    ORB corners (Rublee et al. 2011) that are each other's best match and move like those around them. Between them
    goes the motion of the plane that most lie on, and what they differ from it nearby.
    """
    start, moved = _agreeing(*_matches(first, second))
    if len(start) < _LEAST_MATCHES:
        return None
    found, _ = cv2.findHomography(start, start + moved, cv2.USAC_MAGSAC, _PLANE_TOLERANCE_PX)
    if found is None:
        return None
    plane = np.asarray(found, np.float64)
    height, width = first.shape
    u, v = np.meshgrid(_middles(width), _middles(height))
    places = np.stack([u.ravel(), v.ravel()], 1)
    off_plane = moved - _along(plane, start)
    nearest, distance2 = _nearest(places, start, _NEIGHBOURS)
    weight = 1.0 / (distance2 + 0.01 * _REACH_PX**2)
    coarse = _along(plane, places)
    coarse += (weight[..., None] * off_plane[nearest]).sum(1) / (weight.sum(1, keepdims=True) + 1.0 / _REACH_PX**2)
    if not np.isfinite(coarse).all():  # a plane seen edge-on
        return None
    grid = np.asarray(coarse.reshape(*u.shape, 2), np.float32)
    return np.asarray(cv2.resize(grid, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _matches(first: UInt8Array, second: UInt8Array) -> tuple[FloatArray, FloatArray]:
    """(n, 2) places in the first image, and how far each is from its match in the second."""
    (before, looks_before), (after, looks_after) = _corners(first), _corners(second)
    if not len(before) or not len(after):
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(looks_before, looks_after)
    pairs = sorted(pairs, key=lambda pair: pair.distance)[:_MOST_MATCHES]
    start = before[[pair.queryIdx for pair in pairs]]
    return start, after[[pair.trainIdx for pair in pairs]] - start


def _corners(image: UInt8Array) -> tuple[FloatArray, UInt8Array]:
    """(n, 2) places and (n, 32) descriptors, spread over the image."""
    orb = cv2.ORB.create(_MOST_CORNERS, fastThreshold=_LEAST_CONTRAST)
    counts: dict[tuple[int, int], int] = {}
    kept = []
    for corner in sorted(orb.detect(image, None), key=lambda corner: -corner.response):
        cell = int(corner.pt[0]) // _CELL_PX, int(corner.pt[1]) // _CELL_PX
        counts[cell] = counts.get(cell, 0) + 1
        if counts[cell] <= _MOST_A_CELL:
            kept.append(corner)
    corners, looks = orb.compute(image, kept)
    if looks is None:
        return np.empty((0, 2)), np.empty((0, 32), np.uint8)
    return np.array([corner.pt for corner in corners], np.float64), np.asarray(looks, np.uint8)


def _agreeing(start: FloatArray, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The matches that move like those around them, of which those around must themselves agree."""
    for _ in range(2):
        if len(start) < _LEAST_MATCHES:
            break
        nearest, _ = _nearest(start, start, _NEIGHBOURS + 1)
        around = moved[nearest]
        median = np.median(around, axis=1)
        allowed = _AGREE_SHARE * np.abs(median).sum(1)
        spread = np.median(np.abs(around - median[:, None]).sum(2), axis=1)
        agrees = np.abs(moved - median).sum(1) < _AGREE_PX + allowed
        agrees &= spread < 2 * _AGREE_PX + allowed
        start, moved = start[agrees], moved[agrees]
    return start, moved


def _middles(length: int) -> FloatArray:
    """Of cells of about the grid's size that together are so long."""
    count = max(1, round(length / _GRID_PX))
    return np.asarray((np.arange(count) + 0.5) * (length / count), np.float64)


def _nearest(places: FloatArray, others: FloatArray, count: int) -> tuple[NDArray[np.int64], FloatArray]:
    """For each place (n, 2), the ``count`` nearest of the others (n, count), and their squared distances."""
    distance2 = ((places[:, None] - others[None]) ** 2).sum(2)
    nearest = np.argpartition(distance2, count - 1, axis=1)[:, :count]
    return nearest, np.take_along_axis(distance2, nearest, axis=1)


def _along(plane: FloatArray, places: FloatArray) -> FloatArray:
    """How far a homography moves each place."""
    return np.asarray(cv2.perspectiveTransform(places[None], plane)[0] - places, np.float64)
