"""The metric scale of depth, from flat ground that is as far below as the autopilot says."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import Float32Array
from flockd.flight.perception.depth.scale import DEFAULTS, ScaleParameters, fit_scale
from flockd.flight.perception.maps import SceneMaps

_MAX_GROUND_M = 40.0
"""Flat ground beyond is a few rows under the horizon: a degree of attitude moves it by half."""


def fix_by_height(maps: SceneMaps, ground: Float32Array, parameters: ScaleParameters = DEFAULTS) -> SceneMaps:
    """The maps with metres, from the inverse depth of flat ground (h/stride, w/stride), 1/m, 0 where there is none.

    The scale is the one that brings most of the image's lower part onto the ground. Raises ValueError where too little
    of the image is ground.
    """
    if maps.open is None:
        return maps
    (height, width), stride = ground.shape, maps.labels.shape[0] // ground.shape[0]
    blocks = (height, stride, width, stride)
    level = (ground > 1.0 / _MAX_GROUND_M) & (maps.labels.reshape(blocks).max(axis=(1, 3)) == 0)
    open_ = maps.open.inverse.reshape(blocks).mean(axis=(1, 3))[level]
    scale = fit_scale(open_, ground[level], np.zeros(len(open_)), shift=maps.open.shift, parameters=parameters)
    if scale is None:
        raise ValueError("too little flat ground is in view to fix the scale of depth")
    return scale.metric(maps, parameters)
