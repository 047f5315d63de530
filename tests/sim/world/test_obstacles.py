"""Ranges and clearances to single solids as worked out by hand, and random worlds made of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.errors import UsageError
from flockd.core.messages import SECTORS
from flockd.sim.scenario import ClearingConfig, ObstaclesConfig
from flockd.sim.world.obstacle_worlds import clearances, generate_obstacles
from flockd.sim.world.obstacles import Box, Capsule, Frustum, Obstacles, true_ranges

HERE = np.array([0.0, 0.0, -4.0])
NORTH, EAST = 0.0, math.pi / 2
POLE = Frustum(north=10.0, east=0.0, foot_radius=0.5, top_radius=0.5, foot=0.0, top=8.0)
WALL = Box(north=0.0, east=6.0, half_length=3.0, half_width=0.2, heading=0.0, foot=0.0, top=5.0)
WIRE = Capsule(5.0, -2.0, 6.0, 5.0, 2.0, 6.0, 0.01)
START = np.array([[0.0, 0.0]])


def _ranges(obstacles: Obstacles, degrees: list[float], half_width_deg: float = 0.0) -> list[float]:
    found = obstacles.ranges(HERE, np.radians(degrees), half_width=math.radians(half_width_deg))
    return [float(range_m) for range_m in found]


def test_a_range_is_that_to_the_surface_along_the_azimuth() -> None:
    obstacles = Obstacles([POLE, WALL])
    # The pole's edge is at asin(0.5 / 10) = 2.87 degrees; the wall's corner at (3, 5.8), 62.65 degrees.
    found = _ranges(obstacles, [0.0, 2.8, 2.9, 90.0, 63.0, 62.0, 180.0])
    assert found[0] == pytest.approx(9.5)
    assert found[1] == pytest.approx(math.sqrt(10**2 - 0.5**2), abs=0.12), "almost a tangent"
    assert found[3] == pytest.approx(5.8)
    assert found[4] == pytest.approx(5.8 / math.sin(math.radians(63.0)))
    assert [found[i] for i in (2, 5, 6)] == [math.inf] * 3


def test_a_turned_house_is_hit_at_its_corner() -> None:
    house = Box(north=10.0, east=0.0, half_length=2.0, half_width=2.0, heading=math.pi / 4, foot=0.0, top=6.0)
    assert _ranges(Obstacles([house]), [0.0]) == pytest.approx([10.0 - 2.0 * math.sqrt(2.0)])


def test_a_trunk_between_two_azimuths_is_found_by_the_sectors() -> None:
    trunk = Frustum(north=15.0 * math.cos(0.03), east=15.0 * math.sin(0.03), foot_radius=0.1, top_radius=0.1,
                    foot=0.0, top=8.0)  # fmt: skip
    obstacles = Obstacles([trunk])
    assert _ranges(obstacles, [0.0, 5.0]) == [math.inf, math.inf]
    assert _ranges(obstacles, [0.0, 5.0], half_width_deg=2.5) == pytest.approx([14.9, math.inf])


def test_what_is_above_or_below_the_drone_does_not_count() -> None:
    obstacles = Obstacles([WIRE, Box(5.0, 0.0, 2.0, 2.0, 0.0, foot=0.0, top=3.0)])
    assert _ranges(obstacles, [0.0]) == [math.inf], "a wire 2 m above, a wall that ends 1 m below"
    assert obstacles.ranges(HERE, np.array([NORTH]), (-0.5, 2.5)) == pytest.approx([4.99])
    assert obstacles.ranges(HERE, np.array([NORTH]), (-1.5, 0.5)) == pytest.approx([3.0])


def test_of_a_cone_the_widest_part_among_the_drones_heights_counts() -> None:
    spruce = Frustum(north=10.0, east=0.0, foot_radius=2.0, top_radius=0.0, foot=0.0, top=8.0)
    # At 3.25 m, 0.75 m below the drone, its radius is 2 * (8 - 3.25) / 8.
    assert _ranges(Obstacles([spruce]), [0.0]) == pytest.approx([10.0 - 2.0 * 4.75 / 8.0])


def test_clearance_is_the_distance_in_three_dimensions() -> None:
    cone = Frustum(north=0.0, east=0.0, foot_radius=3.0, top_radius=0.0, foot=0.0, top=4.0)
    box = Box(north=20.0, east=0.0, half_length=1.0, half_width=2.0, heading=EAST, foot=0.0, top=3.0)
    obstacles = Obstacles([cone, box, WIRE])
    # The cone's side is the line 4 x + 3 y = 12, and from within its floor is nearer; the box's length points east, and
    # its corner is at (22, 1), 3 m high.
    for point, expected in (
        ((2.4, 3.2, -3.0), (4 * 4.0 + 3 * 3.0 - 12) / 5),
        ((23.0, 2.0, -4.0), math.sqrt(3.0)),
        ((20.0, 0.0, -2.5), -0.5),
        ((0.5, 0.0, -1.0), -1.0),
        ((5.0, 0.0, -9.0), 2.99),
        ((5.0, 5.0, -10.0), 4.99),
    ):
        assert obstacles.clearance(np.array(point)) == pytest.approx(expected), point
    assert Obstacles().clearance(HERE) == math.inf


def test_ranges_agree_with_marching_along_the_rays_by_the_clearance() -> None:
    for config in (
        ObstaclesConfig(kind="forest", extent_m=20.0, trees_per_hectare=400.0),
        ObstaclesConfig(kind="village"),
    ):
        obstacles = generate_obstacles(config, 2, START)
        azimuths = np.linspace(0.0, 2 * math.pi, 90)
        rays = np.column_stack([np.cos(azimuths), np.sin(azimuths), np.zeros(90)])
        away = np.zeros(90)
        for _ in range(200):
            away = np.minimum(away + obstacles.clearance(HERE + away[:, None] * rays), 50.0)
        exact = obstacles.ranges(HERE, azimuths, (0.0, 0.0))
        assert np.isfinite(exact).sum() > 9
        np.testing.assert_allclose(np.minimum(exact, 50.0), away, atol=0.02)


def test_the_exact_perception_sees_the_nearest_within_its_reach() -> None:
    behind = Frustum(north=12.0, east=0.0, foot_radius=0.5, top_radius=0.5, foot=0.0, top=8.0)
    far = Frustum(north=0.0, east=25.0, foot_radius=1.0, top_radius=1.0, foot=0.0, top=8.0)
    seen = true_ranges(Obstacles([POLE, behind, far]), 7.0, HERE)
    assert seen.time_s == 7.0
    assert seen.range_m[0] == pytest.approx(9.5)
    assert seen.seen_m[0] == pytest.approx(9.5), "what is behind the pole is not known"
    assert seen.range_m[SECTORS // 4] == math.inf
    assert seen.seen_m[SECTORS // 4] == 20.0
    assert np.array_equal(seen.sigma_m > 0, np.isfinite(seen.range_m))


def test_a_forest_has_its_trees_apart_and_its_start_free() -> None:
    config = ObstaclesConfig(
        kind="forest", trees_per_hectare=200.0, extent_m=30.0, clearings=(ClearingConfig(north_m=20.0, east_m=5.0),)
    )
    forest = generate_obstacles(config, 3, START)
    trunks = np.array([(s.north, s.east, s.foot_radius) for s in forest.solids
                       if isinstance(s, Frustum) and s.material == "bark"])  # fmt: skip
    assert len(trunks) == 72, "200 a hectare on 0.36 hectares"
    gaps = np.hypot(*(trunks[:, None, :2] - trunks[None, :, :2]).transpose(2, 0, 1))
    gaps -= trunks[:, None, 2] + trunks[None, :, 2]
    assert gaps[~np.eye(72, dtype=bool)].min() >= 2.0
    away = np.hypot(trunks[:, 0], trunks[:, 1]) - trunks[:, 2]
    assert away.min() >= 4.0
    assert (np.hypot(trunks[:, 0] - 20.0, trunks[:, 1] - 5.0) - trunks[:, 2]).min() >= 5.0
    assert generate_obstacles(config, 3, START).solids == forest.solids
    assert generate_obstacles(config, 4, START).solids != forest.solids


def test_a_village_has_houses_walls_poles_and_wires_and_a_free_street() -> None:
    village = generate_obstacles(ObstaclesConfig(kind="village"), 1, START)
    materials = {(type(solid), solid.material) for solid in village.solids}
    assert {(Box, "roof"), (Frustum, "wood"), (Capsule, "metal"), (Capsule, "leaves")} <= materials
    norths = np.linspace(-50.0, 50.0, 200)
    lanes = [np.column_stack([norths, np.full(200, east), np.full(200, -4.0)]) for east in np.arange(-8.0, 8.0, 0.5)]
    assert max(village.clearance(lane).min() for lane in lanes) > 1.0, "some lane along the street is free"


def test_a_forest_that_does_not_fit_says_so() -> None:
    config = ObstaclesConfig(kind="forest", trees_per_hectare=400.0, min_gap_m=6.0, extent_m=15.0)
    with pytest.raises(UsageError, match=r"^world.obstacles: only \d+ of 36 trees fit in with 6 m between them; write"):
        generate_obstacles(config, 0, START)


def test_a_pole_that_is_passed_between_two_steps_counts() -> None:
    times, velocity = np.array([0.0, 0.5, 1.0]), np.tile([4.0, 0.0, 0.0], (3, 1, 1))
    position = np.array([[9.0, 1.0, -4.0], [11.0, 1.0, -4.0], [13.0, 1.0, -4.0]])[:, None]
    found = clearances(Obstacles([POLE]), times, position, velocity)
    # Beside the pole, at 10 m north, its surface is 0.5 m away; at the steps it is 0.91 m and more.
    assert found[:, 0] == pytest.approx([0.5, math.sqrt(2.0) - 0.5, math.hypot(3.0, 1.0) - 0.5], abs=1e-9)


def test_between_the_samples_of_a_step_a_clearance_errs_by_half_their_spacing_at_most() -> None:
    """2 m a step, 10 samples: 0.2 m apart. The pole at 10 m is passed 1 m aside, halfway between two of them."""
    times, velocity = np.array([0.0, 0.5]), np.tile([4.0, 0.0, 0.0], (2, 1, 1))
    position = np.array([[9.1, 1.0, -4.0], [11.1, 1.0, -4.0]])[:, None]
    found = clearances(Obstacles([POLE]), times, position, velocity)[0, 0]
    assert found == pytest.approx(math.hypot(0.1, 1.0) - 0.5)
    assert 0.5 <= found <= 0.5 + 0.1
