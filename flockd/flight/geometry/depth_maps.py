"""The two kinds of depth map: range along the ray inside flockd, z along the optical axis outside."""

from __future__ import annotations

from functools import lru_cache
from typing import NewType

import numpy as np

from flockd.core.messages import Float32Array
from flockd.flight.geometry.cameras import Camera

ZMap = NewType("ZMap", Float32Array)
"""(h, w) metres along the optical axis: the output of networks, renderers and depth cameras."""
RangeMap = NewType("RangeMap", Float32Array)
"""(h, w) metres along each pixel's ray, as `Camera.unproject` takes them: used everywhere in flockd."""


def range_map(z: ZMap, camera: Camera) -> RangeMap:
    """The ranges of a map of the camera's size; NaN outside the lens's image, and 90 degrees or more off its axis."""
    return RangeMap(z / _axial_share(camera))


@lru_cache(maxsize=32)
def _axial_share(camera: Camera) -> Float32Array:
    """(h, w) z over range of each pixel; NaN outside the lens's image, or if it is not positive."""
    share = camera.block_rays(1)[..., 2]
    return np.where(share > 0.0, share, np.nan).astype(np.float32)
