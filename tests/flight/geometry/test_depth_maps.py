"""Depth along the axis and ranges along rays, with the lenses of the drone that `config/quadrotor.yaml` describes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.config.loader import load_drone
from flockd.core.data import data_path
from flockd.core.messages import Detection, Float32Array, FloatArray
from flockd.flight.geometry import (
    RangeMap,
    ZMap,
    build_rig,
    estimate_ego_motion,
    grid_pixels,
    lift_matches,
    range_map,
    z_map,
)
from flockd.flight.perception.detection.masks import depth_of_drones

CONFIG = load_drone(data_path("config") / "quadrotor.yaml")
RIG = build_rig(CONFIG.rig)
FRONT = RIG.cameras["front"]
WALL_M = 6.0
"""Along the optical axis."""


def wall_z(ahead_m: float) -> ZMap:
    """A wall across the front camera's optical axis: its z is the same everywhere."""
    width, height = FRONT.camera.size
    return ZMap(np.full((height, width), ahead_m, np.float32))


@pytest.mark.parametrize("off_axis_deg", [0.0, 30.0, 60.0])
def test_a_map_of_z_lifts_a_pixel_to_where_it_is(off_axis_deg: float) -> None:
    angle = math.radians(off_axis_deg)
    point = 5.0 * np.array([[0.0, math.sin(angle), math.cos(angle)]])
    pixel = FRONT.camera.project(point)
    column, row = pixel[0].astype(int)
    ranges = range_map(wall_z(point[0, 2]), FRONT.camera)
    lifted = FRONT.camera.unproject(pixel, np.array([ranges[row, column]], np.float64))
    assert np.linalg.norm(lifted) == pytest.approx(5.0, rel=0.004)  # half a pixel off
    np.testing.assert_allclose(lifted, point, atol=0.02)


def test_there_and_back_is_the_same_map() -> None:
    np.testing.assert_allclose(z_map(range_map(wall_z(7.0), FRONT.camera), FRONT.camera), 7.0, rtol=1e-6)


def test_a_detected_drone_stands_at_its_range_in_the_map_whichever_way_it_is() -> None:
    bearing = np.array([math.cos(math.radians(50.0)), 0.0, math.sin(math.radians(50.0))])
    position = FRONT.T_body_camera.translation + 5.0 * bearing
    range_m = float(np.linalg.norm(position))
    detection = Detection(position / range_m, math.log(range_m), 1e-4 * np.eye(3), 1.0, 0.5, ("front",), 1)
    column, row = FRONT.pixels_of_points(position[None])[0].astype(int)
    labels = np.zeros((640, 480), np.uint8)
    labels[row - 3 : row + 4, column - 3 : column + 4] = 1
    moved = depth_of_drones(RangeMap(np.full((640, 480), 5.0, np.float32)), labels, FRONT, [detection])
    lifted = FRONT.camera.unproject(np.array([[column + 0.5, row + 0.5]]), moved[row, [column]].astype(np.float64))
    np.testing.assert_allclose(FRONT.T_body_camera.apply(lifted)[0], position, atol=0.02)


def seen_wall(step: FloatArray) -> tuple[Float32Array, RangeMap, RangeMap]:
    """Flow and exact ranges of the wall for a step (3,) of the body, in the front camera's axes."""
    width, height = FRONT.camera.size
    pixels = grid_pixels((width, height), 1)
    rays = FRONT.camera.rays(pixels)
    with np.errstate(invalid="ignore"):
        points = rays * (WALL_M / rays[:, 2:])
    after = FRONT.camera.project(points - step)
    ahead_after = WALL_M - step[2]
    flow = (after - pixels).reshape(height, width, 2).astype(np.float32)
    return flow, range_map(wall_z(WALL_M), FRONT.camera), range_map(wall_z(ahead_after), FRONT.camera)


def test_the_own_motion_before_an_exact_wall_is_as_exact_as_with_a_pinhole() -> None:
    """What an equidistant lens shows of a wall that is exactly known: 0.5 m to the right and ahead."""
    step = np.array([0.4, 0.0, 0.3])
    flow, before, after = seen_wall(step)
    none = np.zeros((640, 480), np.uint8)
    stride = CONFIG.geometry.background_stride_px
    pairs = lift_matches(
        FRONT, grid_pixels(FRONT.camera.size, stride), flow, before, after, none, none, max_depth_m=40.0
    )
    ego = estimate_ego_motion(pairs, RIG, 0.5, CONFIG.geometry)
    np.testing.assert_allclose(ego.translation, FRONT.T_body_camera.rotation @ step, atol=0.005)
    assert ego.inliers == pytest.approx(len(pairs), rel=0.05)
