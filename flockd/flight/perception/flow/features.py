"""A coarse flow from matched features: where the images differ more than a dense flow can follow."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import Float32Array, FloatArray, UInt8Array

_MAX_FEATURES = 2000
_MIN_CONTRAST = 5
"""Grey levels, of FAST; a blurred image has no strong corners. OpenCV's default is 20."""
_BUCKET_PX = 32
_MAX_FEATURES_PER_BUCKET = 25
"""Else all features are in one plant."""
_MAX_MATCHES = 1000
_MIN_MATCHES = 20
_NEIGHBOURS = 12
"""Matches around, which one is compared with and which are interpolated between."""
_NEIGHBOUR_TOLERANCE_PX = 6.0
_NEIGHBOUR_TOLERANCE = 0.2
"""A match stays that differs from the median of those around it by less than the first, and this share of it."""
_HOMOGRAPHY_TOLERANCE_PX = 8.0
_GRID_PX = 16
_REACH_PX = 100.0
"""Farther from all matches than this, the homography counts for more than they do."""


def feature_flow(first: UInt8Array, second: UInt8Array) -> Float32Array | None:
    """(h, w, 2) pixels from grey ``first`` (h, w) to grey ``second``; None where too few features agree.

    ORB features (Rublee et al. 2011) that are each other's best match and move like those around them. Between them
    goes the homography that most follow, and what they differ from it nearby.
    """
    start, moved = _consistent(*_matches(first, second))
    if len(start) < _MIN_MATCHES:
        return None
    found, _ = cv2.findHomography(start, start + moved, cv2.USAC_MAGSAC, _HOMOGRAPHY_TOLERANCE_PX)
    if found is None:
        return None
    homography = np.asarray(found, np.float64)
    height, width = first.shape
    u, v = np.meshgrid(_cell_centres(width, _GRID_PX), _cell_centres(height, _GRID_PX))
    coarse = _interpolated(np.stack([u.ravel(), v.ravel()], 1), start, moved, homography)
    if not np.isfinite(coarse).all():  # a plane seen edge-on
        return None
    grid = np.asarray(coarse.reshape(*u.shape, 2), np.float32)
    return np.asarray(cv2.resize(grid, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _matches(first: UInt8Array, second: UInt8Array) -> tuple[FloatArray, FloatArray]:
    """(n, 2) pixels in the first image, and how far each is from its match in the second."""
    (before, descriptors_before), (after, descriptors_after) = (_features(image) for image in (first, second))
    if not len(before) or not len(after):
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(descriptors_before, descriptors_after)
    pairs = sorted(pairs, key=lambda pair: pair.distance)[:_MAX_MATCHES]
    start = before[[pair.queryIdx for pair in pairs]]
    return start, after[[pair.trainIdx for pair in pairs]] - start


def _features(image: UInt8Array) -> tuple[FloatArray, UInt8Array]:
    """(n, 2) pixels and (n, 32) descriptors, spread over the image."""
    orb = cv2.ORB.create(_MAX_FEATURES, fastThreshold=_MIN_CONTRAST)
    counts: dict[tuple[int, int], int] = {}
    kept = []
    for feature in sorted(orb.detect(image, None), key=lambda feature: -feature.response):
        bucket = int(feature.pt[0]) // _BUCKET_PX, int(feature.pt[1]) // _BUCKET_PX
        counts[bucket] = counts.get(bucket, 0) + 1
        if counts[bucket] <= _MAX_FEATURES_PER_BUCKET:
            kept.append(feature)
    features, descriptors = orb.compute(image, kept)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 32), np.uint8)
    return np.array([feature.pt for feature in features], np.float64), np.asarray(descriptors, np.uint8)


def _consistent(start: FloatArray, moved: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The matches that move like those around them, of which those around must themselves agree."""
    tolerance_px = _NEIGHBOUR_TOLERANCE_PX
    for _ in range(2):  # the first time false matches still spoil the medians
        if len(start) < _MIN_MATCHES:
            break
        nearest, _ = _nearest(start, start, _NEIGHBOURS + 1)
        around = moved[nearest]
        median = np.median(around, axis=1)
        allowed = _NEIGHBOUR_TOLERANCE * np.abs(median).sum(1)
        spread = np.median(np.abs(around - median[:, None]).sum(2), axis=1)
        agrees = np.abs(moved - median).sum(1) < tolerance_px + allowed
        agrees &= spread < 2 * tolerance_px + allowed
        start, moved = start[agrees], moved[agrees]
    return start, moved


def _interpolated(
    pixels: FloatArray,
    start: FloatArray,
    moved: FloatArray,
    homography: FloatArray,
) -> FloatArray:
    """(n, 2) how far pixels (n, 2) move: a homography's flow, and by inverse distance what matches differ from it."""
    off_homography = moved - _homography_flow(homography, start)
    nearest, distance2 = _nearest(pixels, start, _NEIGHBOURS)
    weight = 1.0 / (distance2 + 0.01 * _REACH_PX**2)
    flow = _homography_flow(homography, pixels)
    differs = (weight[..., None] * off_homography[nearest]).sum(1)
    flow += differs / (weight.sum(1, keepdims=True) + 1.0 / _REACH_PX**2)
    return flow


def _cell_centres(length: int, cell_px: int) -> FloatArray:
    """Centres of cells of about this size that together are so long."""
    count = max(1, round(length / cell_px))
    return np.asarray((np.arange(count) + 0.5) * (length / count), np.float64)


def _nearest(pixels: FloatArray, others: FloatArray, count: int) -> tuple[NDArray[np.int64], FloatArray]:
    """For each pixel (n, 2), the ``count`` nearest of the others (n, count), and their squared distances."""
    distance2 = ((pixels[:, None] - others[None]) ** 2).sum(2)
    nearest = np.argpartition(distance2, count - 1, axis=1)[:, :count]
    return nearest, np.take_along_axis(distance2, nearest, axis=1)


def _homography_flow(homography: FloatArray, pixels: FloatArray) -> FloatArray:
    """(n, 2) how far a homography moves each pixel."""
    return np.asarray(cv2.perspectiveTransform(pixels[None], homography)[0] - pixels, np.float64)
