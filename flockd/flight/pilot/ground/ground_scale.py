"""The metric scale of the own motion, from the height above the ground.

Two images and the motion between them give the depth of matched points in units of that motion, and with it the plane
of the ground: its slope, and the drone's height above it. A range finder measures that height in metres, which gives
the unit. Real ground is not flat: at 5 m, a bump of 0.2 m straight below would be an error of 4 %. So the plane is
fitted around the middle of the points that the last ranges hit, and its height is their mean.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flockd.core.messages import EgoMotion, FloatArray, GroundEstimate
from flockd.flight.geometry import GroundSamples, Rig, RigCamera, fit_ground, grid_pixels
from flockd.flight.geometry.ego_motion_refinement import FLOW_SIGMA_PX
from flockd.flight.geometry.ground_fit import REACH
from flockd.flight.perception import Observation

MATCHES = 1200
"""Number of matched points of each image; four times as many did not improve the scale. At 640x480 pixels, these are
the points at which the flow is refined."""
MIN_BASELINE_M = 0.08
"""Shortest baseline across the line of sight; below it the depth of the ground is noise."""


def scaled_by_ground(
    rig: Rig, observation: Observation, ego: EgoMotion, ground: GroundEstimate, track: FloatArray
) -> tuple[EgoMotion, FloatArray]:
    """The own motion in the range finder's scale, and the slope of the ground (2,), north and east.

    Args:
        rig: the drone's cameras.
        observation: at the end of the motion, with the one before it.
        ego: in the depth maps' scale.
        ground: below the drone at the motion's end.
        track: (k, 3) metres NED from the drone, where the last ranges hit the ground.

    Raises ValueError with the reason if the ground gives no scale.
    """
    if ground.source != "range_finder":
        raise ValueError("no range to the ground")
    samples = [_samples(rig.cameras[name], observation, ego) for name in observation.flows]
    if not samples:
        raise ValueError("no camera has both frames")
    seen = GroundSamples.concatenate(samples)
    places = track[np.hypot(track[:, 0], track[:, 1]) < 2.0 * REACH * ground.height_m]
    if not len(places):
        raise ValueError("no range hit the ground that is seen")
    height, slope = fit_ground(seen, ground.height_m, ground.slope, places[:, :2].mean(axis=0))
    height_m = float((places[:, 2] + places[:, :2] @ slope).mean())
    return replace(ego, translation=ego.translation * (height_m / height)), slope


def _samples(camera: RigCamera, observation: Observation, ego: EgoMotion) -> GroundSamples:
    """Matched background points of one camera, at their places in the newest image."""
    width, height = camera.camera.size
    start = grid_pixels(camera.camera.size, max(math.isqrt(width * height // MATCHES), 1))
    seen, inverse, baseline = observation.inverse_ranges(camera, start, ego)
    R_ned_body, mount = observation.vehicle.R_ned_body, camera.T_body_camera
    rays = seen @ (R_ned_body @ mount.rotation).T
    clear = (baseline > MIN_BASELINE_M) & (inverse > 0.0)  # NaN compares false
    offsets = np.broadcast_to(R_ned_body @ mount.translation, rays.shape)
    sigma = FLOW_SIGMA_PX * camera.camera.pixel_angle(seen) / np.maximum(baseline, MIN_BASELINE_M)
    return GroundSamples(rays, inverse, offsets, sigma)[clear]
