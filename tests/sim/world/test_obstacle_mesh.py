"""The solids in the pictures are the solids that ranges and clearances are measured to."""

from __future__ import annotations

import math

import numpy as np

from flockd.sim.cameras.camera_simulator import FIELD_GRID_M, field_grid
from flockd.sim.renderer.renderer import Renderer
from flockd.sim.world.obstacles import Box, Capsule, Frustum, Obstacles
from flockd.sim.world.world import World

SIZE = (320, 240)
FOCAL_PX = 160.0
MATRIX = np.array([[FOCAL_PX, 0.0, 160.0], [0.0, FOCAL_PX, 120.5], [0.0, 0.0, 1.0]])
LOOKING_NORTH = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""R_ned_camera of a level camera."""
HERE = np.array([-8.0, 0.0, -4.0])
SOLIDS = (
    Frustum(0.0, -3.0, 0.3, 0.2, -0.6, 8.0, "bark"),
    Frustum(3.0, 3.0, 1.5, 0.0, 0.3, 7.0, "needles"),
    Box(4.0, -2.0, 2.5, 0.2, 0.7, -0.6, 5.0, "stone"),
    Box(8.0, 3.0, 3.0, 2.5, 0.2, -0.6, 6.0, "plaster"),
    Capsule(-1.0, 1.5, 4.0, -1.0, 1.5, 4.6, 0.9, "leaves"),
    Capsule(-4.0, -3.0, 5.0, -4.0, 3.0, 5.0, 0.05, "metal"),
)


def test_depth_ends_on_the_solids_and_on_the_horizon_at_their_ranges() -> None:
    obstacles = Obstacles(SOLIDS)
    world = World.generate(
        4, ground_relief_m=0.0, keep_out=field_grid(16.0), clearance_m=FIELD_GRID_M, extent_m=30.0, obstacles=obstacles
    )
    none = np.zeros((0, 3))
    view = Renderer(world, []).render(
        MATRIX, SIZE, LOOKING_NORTH, HERE, drone_rotations=np.zeros((0, 3, 3)), drone_positions=none, shown=[]
    )
    rows, columns = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    rays = (
        np.stack([columns + 0.5, rows + 0.5, np.ones_like(rows)], axis=-1) @ np.linalg.inv(MATRIX).T @ LOOKING_NORTH.T
    )
    points = HERE + rays * np.where(np.isfinite(view.depth), view.depth, 1e3)[..., None]
    near = (np.abs(points[..., :2]) < 14.0).all(axis=-1) & (points[..., 2] < -0.4)
    off = np.abs(obstacles.clearance(points[near]))
    assert near.sum() > 10_000
    assert np.percentile(off, 80) < 0.02, "walls and trunks"
    assert off.max() < 0.12, "a crown is a polyhedron"
    level = points[120]
    azimuths = np.arctan2(rays[120, :, 1], rays[120, :, 0])
    exact = obstacles.ranges(HERE, azimuths, (0.0, 0.0))
    drawn = np.hypot(level[:, 0] - HERE[0], level[:, 1] - HERE[1])
    seen = np.isfinite(exact)
    assert seen.mean() > 0.3
    agree = np.abs(np.minimum(drawn, 1e3) - np.where(seen, exact, 1e3)) < 0.12
    assert (~agree[seen]).mean() < 0.05, "but for the columns on an edge"
    assert math.isclose(float(rays[120, 0, 2]), 0.0)
