"""The metric scale of depth that a network leaves open, from flat ground as far below as the height says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flockd.core.messages import Float32Array
from flockd.flight.geometry.robust.line import ransac_line
from flockd.flight.perception.maps import SceneMaps

_MAX_GROUND_M = 40.0
"""Flat ground beyond is a few rows under the horizon: a degree of attitude moves it by half."""
_TOLERANCE = 0.1
"""A pixel agrees with a scale when its inverse depth is off by less than this share."""
_MIN_SHARE = 0.25
"""Of the pixels that have to agree: on a plain with trees and houses about half is ground."""
_MIN_PIXELS = 100
_MAX_DEPTH_M = 1e3
"""Farther is as far: the sky's inverse depth is about 0, or less."""


def fix_by_height(maps: SceneMaps, ground: Float32Array) -> SceneMaps:
    """The maps with metres, from the inverse depth of flat ground (h/stride, w/stride), 1/m, 0 where there is none.

    The scale, ``inverse depth = factor * open + shift``, is the one that brings most of the image's lower part onto the
    ground, by RANSAC: what stands on the ground does not count. Raises ValueError where too little of the image is
    ground.
    """
    if maps.open is None:
        return maps
    (height, width), stride = ground.shape, maps.labels.shape[0] // ground.shape[0]
    blocks = (height, stride, width, stride)
    level = (ground > 1.0 / _MAX_GROUND_M) & (maps.labels.reshape(blocks).max(axis=(1, 3)) == 0)
    open_, target = maps.open.inverse.reshape(blocks).mean(axis=(1, 3))[level], ground[level]
    finite = np.isfinite(open_) & np.isfinite(target)
    x, y = open_[finite].astype(np.float64), target[finite].astype(np.float64)
    scale = ransac_line(
        x, y, _TOLERANCE * np.abs(y), intercept=maps.open.shift, min_inliers=_MIN_PIXELS, min_inlier_ratio=_MIN_SHARE
    )
    if scale is None:
        raise ValueError("too little flat ground is in view to fix the scale of depth")
    inverse = np.float32(scale.slope) * maps.open.inverse + np.float32(scale.intercept)
    depth = 1.0 / np.maximum(inverse, np.float32(1.0 / _MAX_DEPTH_M))
    return replace(maps, depth=np.asarray(depth, np.float32), open=None)
