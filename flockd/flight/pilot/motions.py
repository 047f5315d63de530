"""Pairs of background points of an observation and the one before it."""

from __future__ import annotations

import math

from flockd.core.config.geometry import GeometryParameters
from flockd.flight.geometry import PointPairs, Rig, RigCamera, grid_pixels, lift_matches
from flockd.flight.perception import Observation

_LEAST_MATCHES = 300
"""Number of matches of one image: at 640x480 pixels, 300 gave the own motion as precisely as 4,800."""


def background_pairs(rig: Rig, observation: Observation, parameters: GeometryParameters) -> PointPairs:
    """Background points that one camera sees in both frame sets. ValueError gives the reason if there are none."""
    pairs = []
    for name, flow in observation.flows.items():
        assert observation.previous is not None
        camera, before, after = rig.cameras[name], observation.previous.cameras[name], observation.cameras[name]
        if before.depth is None or after.depth is None:
            continue
        pixels = grid_pixels(camera.camera.size, _stride_px(camera, parameters))
        maps = flow, before.depth, after.depth, before.labels, after.labels
        pairs.append(lift_matches(camera, pixels, *maps, max_depth_m=parameters.max_depth_m))
    if not pairs:
        raise ValueError("no depth has a scale" if observation.flows else "no camera has both frames")
    return PointPairs.concatenate(pairs)


def _stride_px(camera: RigCamera, parameters: GeometryParameters) -> int:
    """The configured stride, or a smaller one if a small image would give too few matches."""
    width, height = camera.camera.size
    return max(min(parameters.background_stride_px, math.isqrt(width * height // _LEAST_MATCHES)), 1)
