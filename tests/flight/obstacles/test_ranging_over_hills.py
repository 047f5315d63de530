"""A hillside that rises to the drone's height is no obstacle where ranges to the ground have told its slope."""

from __future__ import annotations

import numpy as np

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.messages import GroundEstimate, VehicleState
from flockd.flight.geometry import RigCamera, ZMap, ground_inverse_depth, range_map
from flockd.flight.obstacles.ranging import ObstacleRanging
from flockd.flight.perception import CameraObservation, Observation
from tests.flight.geometry.synthetic_world import four_camera_rig

HEIGHT_M, SLOPE = 2.5, (0.15, 0.0)
RIG = four_camera_rig()


def _seen(camera: RigCamera) -> CameraObservation:
    """Nothing but the hillside, under the sky."""
    inverse = ground_inverse_depth(camera, np.eye(3), HEIGHT_M, slope=SLOPE)
    nothing = np.zeros(inverse.shape, np.uint8)
    depth = range_map(ZMap((1.0 / np.maximum(inverse, 1e-3)).astype(np.float32)), camera.camera)
    return CameraObservation(np.zeros((*inverse.shape, 3), np.uint8), depth, nothing, None)


def test_a_hillside_ahead_is_ground_and_no_obstacle() -> None:
    vehicle = VehicleState(0.0, np.eye(3), HEIGHT_M)
    cameras = {name: _seen(camera) for name, camera in RIG.cameras.items()}
    level = Observation(0.0, vehicle, cameras, (), None)
    ranging = ObstacleRanging(RIG, ObstacleParameters())
    assert np.isfinite(ranging.ranges(level).range_m[0]), "of level ground below, the hill would stand on it"
    told = GroundEstimate(HEIGHT_M, np.array(SLOPE), "range_finder")
    assert not np.isfinite(ranging.ranges(level, ground=told).range_m).any()
