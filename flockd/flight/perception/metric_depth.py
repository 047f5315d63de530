"""From a network's depth to metric ranges; if its scale is unknown, flat ground gives it."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import Float32Array
from flockd.flight.geometry import Camera, RangeMap, ZMap, range_map
from flockd.flight.geometry.robust.line import ransac_line
from flockd.flight.perception.maps import OpenDepth, SceneMaps

_MAX_GROUND_M = 40.0
"""Farthest ground that is used: in the rows above, a degree of attitude halves the range."""
_TOLERANCE = 0.1
"""Largest relative difference of inverse depth at which a pixel agrees with a scale."""
_MIN_SHARE = 0.25
"""Least share of agreeing pixels: on a plain with trees and houses about half is ground."""
_MIN_PIXELS = 100
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
    scale = ransac_line(
        x, y, _TOLERANCE * np.abs(y), intercept=maps.depth.shift, min_inliers=_MIN_PIXELS, min_inlier_ratio=_MIN_SHARE
    )
    if scale is None:
        raise ValueError("too little flat ground is in view to fix the scale of depth")
    inverse = np.float32(scale.slope) * maps.depth.inverse + np.float32(scale.intercept)
    z = ZMap(np.asarray(1.0 / np.maximum(inverse, np.float32(1.0 / _MAX_DEPTH_M)), np.float32))
    return range_map(z, camera)
