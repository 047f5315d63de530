"""From an observation and the one before it to pairs of points that stand still."""

from __future__ import annotations

import math
from collections.abc import Iterator

from flockd.core.config.geometry import GeometryParameters
from flockd.core.messages import Float32Array
from flockd.flight.geometry import PointPairs, Rig, RigCamera, grid_pixels, lift_matches
from flockd.flight.perception import CameraObservation, Observation

_LEAST_MATCHES = 300
"""Of an image: of each camera of 640x480 pixels 300 gave the own motion as exactly as 4,800."""


def background_pairs(rig: Rig, observation: Observation, parameters: GeometryParameters) -> PointPairs:
    """What stands still, seen by the same camera before and now. ``ValueError`` says why there is nothing."""
    pairs, seen = [], list(_seen_twice(rig, observation))
    for camera, before, after, flow in seen:
        if before.depth is None or after.depth is None:
            continue
        lifted = lift_matches(
            camera, grid_pixels(camera.camera.size, _stride_px(camera, parameters)), flow,
            before.depth, after.depth, before.labels, after.labels, max_depth_m=parameters.max_depth_m,
        )  # fmt: skip
        pairs.append(lifted.select(lifted.labels == 0))
    if not pairs:
        raise ValueError("no depth has a scale" if seen else "no camera has both frames")
    return PointPairs.concatenate(pairs)


def _stride_px(camera: RigCamera, parameters: GeometryParameters) -> int:
    """As configured, or smaller where a small image would give too few matches."""
    width, height = camera.camera.size
    return max(min(parameters.background_stride_px, math.isqrt(width * height // _LEAST_MATCHES)), 1)


def _seen_twice(
    rig: Rig, observation: Observation
) -> Iterator[tuple[RigCamera, CameraObservation, CameraObservation, Float32Array]]:
    """Each camera with an image before and now: the camera, both, and the flow between them."""
    if observation.previous is not None:
        for name, flow in observation.flows.items():
            yield rig.cameras[name], observation.previous.cameras[name], observation.cameras[name], flow
