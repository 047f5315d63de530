"""Detection without a second stage: a drone's position from the depth map alone (Eq. 37)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from flockd.core.config.perception import DetectionParameters
from flockd.flight.geometry import RangeMap, Rig, RigCamera, log_polar
from flockd.flight.perception.detection.instances import Instance
from flockd.flight.perception.detection.proposals import Proposal
from flockd.flight.perception.detection.refinement import Candidate
from flockd.flight.perception.detection.roi import Roi, angles_between
from flockd.flight.perception.maps import SceneMaps

_MAX_RADIUS_M = 0.6
"""Pixels whose depth differs by more from the median are not of the drone: it is at most 1.2 m wide."""
_MIN_ANGLE = 1e-3
"""Least angular width of an instance in rad, about a pixel of a 90 degree camera of 1280 pixels."""


def candidates_from_depth(
    rig: Rig, scenes: Mapping[str, SceneMaps], depths: Mapping[str, RangeMap], parameters: DetectionParameters
) -> list[Candidate]:
    """For each instance of the first stage the centre of the bounding box of its points. Empty without depth."""
    found = []
    for name, depth in depths.items():
        camera, scene = rig.cameras[name], scenes[name]
        found += [_candidate(camera, scene, depth, instance, parameters) for instance in scene.instances]
    return [one for one in found if one is not None]


def _candidate(
    camera: RigCamera, scene: SceneMaps, depth: RangeMap, instance: Instance, parameters: DetectionParameters
) -> Candidate | None:
    rows, columns = np.nonzero(scene.labels == instance.label)
    pixels = np.asarray(np.stack([columns, rows], 1) + 0.5, np.float64)
    points = camera.camera.unproject(pixels, np.asarray(depth[rows, columns], np.float64))
    distance = np.linalg.norm(points, axis=1)
    kept = np.abs(distance - np.median(distance)) < _MAX_RADIUS_M
    if not kept.any():
        return None
    centre = (points[kept].min(0) + points[kept].max(0)) / 2
    bearing, log_range = log_polar(camera.T_body_camera.apply(centre[None])[0])
    left, top, right, _ = instance.box
    rays = camera.camera.rays(np.array([[left, top], [right, top]]))
    width = max(float(angles_between(rays[0], rays[1])), _MIN_ANGLE)
    proposal = Proposal((camera.name,), Roi(bearing, width / 2), instance)
    sigma = parameters.depth_map_sigma
    return Candidate(proposal, bearing, log_range, sigma, sigma * width, math.exp(log_range) * width)
