"""From a network's depth to metric ranges; if its scale is unknown, flat ground gives it."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import Float32Array, FloatArray
from flockd.flight.geometry import Camera, RangeMap, ZMap, range_map
from flockd.flight.perception.maps import OpenDepth, SceneMaps

_MAX_GROUND_M = 40.0
"""Farthest ground that is used: in the rows above, a degree of attitude halves the range."""
_TOLERANCE = 0.1
"""Largest relative difference of inverse depth at which a pixel agrees with a scale."""
_MIN_SHARE = 0.25
"""Least share of agreeing pixels: on a plain with trees and houses about half is ground."""
_MIN_PIXELS, _MAX_PIXELS = 100, 3000
"""Fewest ground pixels, and the number above which only some are used: the agreeing share is then known to 1 %."""
_HYPOTHESES = 200
"""Pairs drawn: with a quarter of inliers, one of them is free of outliers all but once in 400,000 times."""
_MAX_DEPTH_M = 1e3
"""Largest depth; the sky's inverse depth is about 0, or less."""


def metric_depth(maps: SceneMaps, ground: Float32Array | None, camera: Camera) -> RangeMap:
    """(h, w) metres along the ray: the network's own depth, or with the scale that flat ground gives.

    The scale, ``inverse depth = factor * open + shift``, puts most of the image's lower part onto the ground, by
    RANSAC: things that stand on the ground are outliers.

    Args:
        maps: the networks' maps of the image, along the optical axis.
        ground: (h/stride, w/stride) inverse depth of flat ground, 1/m along that axis, 0 where there is none; None: not
            known.
        camera: of the image. Where its lens images nothing, the range is NaN.

    Raises ValueError if too little of the image is ground.
    """
    if not isinstance(maps.depth, OpenDepth):
        return range_map(maps.depth, camera)
    if ground is None:
        raise ValueError("the network gives its depth no scale")
    (height, width), stride = ground.shape, maps.labels.shape[0] // ground.shape[0]
    blocks = (height, stride, width, stride)
    level = (ground > 1.0 / _MAX_GROUND_M) & (maps.labels.reshape(blocks).max(axis=(1, 3)) == 0)
    open_, target = maps.depth.inverse.reshape(blocks).mean(axis=(1, 3))[level], ground[level]
    finite = np.isfinite(open_) & np.isfinite(target)
    x, y = open_[finite].astype(np.float64), target[finite].astype(np.float64)
    factor, shift = ground_scale(x, y, shift=maps.depth.shift)
    inverse = np.float32(factor) * maps.depth.inverse + np.float32(shift)
    z = ZMap(np.asarray(1.0 / np.maximum(inverse, np.float32(1.0 / _MAX_DEPTH_M)), np.float32))
    return range_map(z, camera)


def ground_scale(x: FloatArray, y: FloatArray, *, shift: bool) -> tuple[float, float]:
    """``y = factor x + shift`` that most pixels (n,) agree with, by RANSAC (Fischler & Bolles 1981), refitted to those.

    A hypothesis goes through two random points, or through one and the origin without ``shift``. Deterministic. Raises
    ValueError if too few agree.
    """
    every = 1 + len(x) // _MAX_PIXELS
    x, y = x[::every], y[::every]
    first, second = np.random.default_rng(0).integers(0, max(len(x), 1), (2, _HYPOTHESES if len(x) else 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = (y[first] - y[second]) / (x[first] - x[second]) if shift else y[first] / x[first]
    shifts = y[first] - factors * x[first] if shift else np.zeros_like(factors)
    usable = np.isfinite(factors) & (factors > 0.0)
    tolerance = _TOLERANCE * np.abs(y)
    near = np.abs(factors[usable, None] * x + shifts[usable, None] - y) < tolerance
    agreeing = near[near.sum(axis=1).argmax()] if len(near) else np.zeros(len(x), np.bool_)
    fitted = [-1.0]
    if agreeing.sum() >= max(_MIN_SHARE * len(x), _MIN_PIXELS):
        weights = 1.0 / np.maximum(tolerance[agreeing], 1e-6)
        design = np.stack([x[agreeing], np.ones(int(agreeing.sum()))][: 1 + shift], axis=1)
        fitted = np.linalg.lstsq(design * weights[:, None], y[agreeing] * weights)[0].tolist()
    if not fitted[0] > 0.0:
        raise ValueError("too little flat ground is in view to fix the scale of depth")
    return fitted[0], fitted[1] if shift else 0.0
