"""The own motion with the lenses of the drone that `config/quadrotor.yaml` describes."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.config.loader import load_drone
from flockd.core.data import data_path
from flockd.core.messages import Float32Array, FloatArray
from flockd.flight.geometry import (
    RangeMap,
    ZMap,
    build_rig,
    estimate_ego_motion,
    grid_pixels,
    lift_matches,
    range_map,
)

CONFIG = load_drone(data_path("config") / "quadrotor.yaml")
RIG = build_rig(CONFIG.rig)
FRONT = RIG.cameras["front"]
WALL_M = 6.0
"""Along the optical axis."""


def wall_z(ahead_m: float) -> ZMap:
    """A wall across the front camera's optical axis: its z is the same everywhere."""
    width, height = FRONT.camera.size
    return ZMap(np.full((height, width), ahead_m, np.float32))


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
