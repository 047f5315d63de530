"""Hills against their own limits, and a range finder over them against the renderer and plain geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.messages import FloatArray, RangeReading
from flockd.flight.geometry import rotation_from_euler
from flockd.sim.autopilot.fake_range_finder import FakeRangeFinder, level_ground, range_to_ground
from flockd.sim.renderer.renderer import Renderer
from flockd.sim.scenario import RangeFinderConfig, SensorConfig
from flockd.sim.vehicles.vehicles import SimulatedAutopilot
from flockd.sim.world.terrain import hills
from flockd.sim.world.world import World

STILL, LEVEL = np.zeros(3), np.eye(3)


@pytest.fixture(scope="module")
def world() -> World:
    return World.generate(1, hills_m=5.0, keep_out=np.zeros((1, 2)), clearance_m=30.0)


@pytest.mark.parametrize("seed", range(4))
def test_hills_are_as_high_and_as_steep_as_they_may_be_and_level_where_drones_begin(seed: int) -> None:
    heights = hills(np.random.default_rng(seed), 80.0, 5.0, 0.15)
    assert 4.5 < heights.max() - heights.min() <= 5.0 + 1e-9
    slopes = [np.abs(np.diff(heights, axis=axis)).max() / 2.0 for axis in (0, 1)]
    assert 0.09 < max(slopes) <= 0.15
    middle = len(heights) // 2
    np.testing.assert_array_equal(heights[middle - 2 : middle + 3, middle], 0.0)
    np.testing.assert_array_equal(heights[0], 0.0)


def test_the_range_is_that_of_the_ground_which_is_drawn(world: World) -> None:
    """A camera along the body's down axis: the depth of its middle pixel is the range."""
    renderer, random = Renderer(world, []), np.random.default_rng(0)
    matrix = np.array([[400.0, 0.0, 32.5], [0.0, 400.0, 32.5], [0.0, 0.0, 1.0]])
    for north, east in random.uniform(-25.0, 25.0, (6, 2)):
        roll, pitch, yaw = random.uniform(-0.35, 0.35, 3) * [1.0, 1.0, 8.0]
        R = rotation_from_euler(float(roll), float(pitch), float(yaw))
        place = np.array([north, east, -7.0])
        R_body_camera = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        view = renderer.render(
            matrix, (64, 64), R @ R_body_camera, place,
            drone_rotations=np.empty((0, 3, 3)), drone_positions=np.empty((0, 3)), shown=[],
        )  # fmt: skip
        if world.obstacle_distance(np.array([[north, east]]))[0] < 6.0:
            continue
        assert range_to_ground(place, R[:, 2], world.height_at) == pytest.approx(float(view.depth[32, 32]), abs=0.02)


def _hillside(north: FloatArray, east: FloatArray) -> FloatArray:
    return 0.15 * north - 0.05 * east


def _readings(config: RangeFinderConfig, heights_m: FloatArray, step_s: float = 0.5) -> list[RangeReading | None]:
    finder = FakeRangeFinder(config, level_ground, (7,))
    return [finder.read(step_s * k, np.array([0, 0, -h]), STILL, LEVEL) for k, h in enumerate(heights_m)]


def test_over_a_hillside_the_range_solves_the_planes_equation() -> None:
    R, place = rotation_from_euler(0.2, -0.3, 0.7), np.array([10.0, -4.0, -8.0])
    height_m = 8.0 - (0.15 * 10.0 + 0.05 * 4.0)
    expected_m = height_m / (R[2, 2] + 0.15 * R[0, 2] - 0.05 * R[1, 2])
    assert range_to_ground(place, R[:, 2], _hillside) == pytest.approx(expected_m, abs=2e-3)
    assert range_to_ground(place, -R[:, 2], _hillside) == math.inf


def test_noise_age_and_limits_are_those_of_the_configuration() -> None:
    config = RangeFinderConfig(noise=0.02, rate_hz=20.0, min_m=0.2, max_m=12.0, tilt_deg=0.0, dropouts_per_min=0.0)
    found = [one for one in _readings(config, np.full(400, 5.0), 0.513) if one is not None]
    assert len(found) == 400
    ranges = np.array([one.range_m for one in found])
    assert np.mean(ranges) == pytest.approx(5.0, abs=0.02)
    assert np.std(ranges) == pytest.approx(0.1, rel=0.15)
    ages = np.array([0.513 * k - one.time_s for k, one in enumerate(found)])
    assert 0.0 <= ages.min() < 0.005
    assert 0.045 < ages.max() <= 0.05 + 1e-9
    for height_m in (0.15, 13.0):
        outside = _readings(config, np.full(5, height_m))
        assert [one and one.quality for one in outside] == [0.0] * 5


def test_dropouts_are_as_frequent_and_long_as_configured() -> None:
    config = RangeFinderConfig(dropouts_per_min=6.0, dropout_s=1.0)
    missing = np.array([one is None for one in _readings(config, np.full(10_000, 5.0), 0.1)])
    assert missing.mean() == pytest.approx(1.0 / 11.0, rel=0.3)  # 1 s out of every 10 s and 1 s
    begins = np.flatnonzero(np.diff(missing.astype(int)) == 1)
    assert len(begins) == pytest.approx(10_000 * 0.1 / 11.0, rel=0.3)


def test_a_drone_without_a_range_finder_has_no_range_and_its_other_errors_are_the_same() -> None:
    place = np.array([0.0, 0.0, -4.0])
    bare = SimulatedAutopilot(SensorConfig(range_finder=None), seed=3, drone=1).read(0.0, place, STILL, LEVEL)
    full = SimulatedAutopilot(SensorConfig(), seed=3, drone=1).read(0.0, place, STILL, LEVEL)
    assert bare.ground_range is None
    assert full.ground_range is not None
    assert bare.height_m == full.height_m
