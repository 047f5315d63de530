"""Around obstacles: which way, how fast, and what is asked for in the end."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.config.flocking import FlockingParameters
from flockd.core.config.mission import MissionParameters
from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray, ObstacleRanges
from flockd.flight.flocking import FlockingLaw
from flockd.flight.obstacles import Avoidance
from flockd.flight.obstacles.avoidance import free_way
from flockd.sim.flock.exact_states import ExactFlock
from flockd.sim.vehicles.vehicles import Vehicles
from flockd.sim.world.obstacles import Box, Frustum, Obstacles, Solid, true_ranges
from tests.make import changed, scenario

PARAMETERS = ObstacleParameters(enabled=True)
GATE = GateParameters()
NOBODY = np.empty((0, 3))
STILL = np.zeros(2)
FREE = true_ranges(Obstacles(), 0.0, np.array([0.0, 0.0, -4.0]), limit_m=15.0)


def around(*solids: Solid) -> ObstacleRanges:
    """What a drone at the origin sees."""
    return true_ranges(Obstacles(solids), 0.0, np.array([0.0, 0.0, -4.0]), limit_m=15.0)


def trunk(north: float, east: float, radius: float = 0.2) -> Frustum:
    return Frustum(north, east, radius, radius, -0.5, 10.0)


def wall(north: float, east: float, half_north: float, half_east: float) -> Box:
    return Box(north, east, half_north, half_east, 0.0, -0.5, 8.0)


def steered(wanted: tuple[float, float], ranges: ObstacleRanges, flock: FloatArray = STILL) -> FloatArray:
    return Avoidance(PARAMETERS, GATE, 0.5).steered(np.array(wanted), ranges, flock)


# The free way.


def test_a_disc_meets_a_point_where_geometry_says() -> None:
    """10 m ahead and 3 m aside, a disc of 5 m touches 4 m before it is abreast: a triangle of 3, 4 and 5 m."""
    points = np.array([[10.0, 3.0]])
    np.testing.assert_allclose(free_way(points, 5.0, np.array([0.0])), [10.0 - 4.0])
    np.testing.assert_array_equal(free_way(points, 2.9, np.array([0.0])), [np.inf])
    np.testing.assert_array_equal(free_way(points, 5.0, np.array([math.pi])), [np.inf])


# Steering.


def test_where_nothing_stands_the_wanted_velocity_is_flown() -> None:
    np.testing.assert_array_equal(steered((1.0, 1.0), FREE), [1.0, 1.0])
    np.testing.assert_array_equal(steered((1.0, 0.0), around(trunk(3.0, 2.5), trunk(-1.2, 0.0))), [1.0, 0.0])
    np.testing.assert_array_equal(steered((0.0, 0.0), around(trunk(3.0, 2.5))), [0.0, 0.0])


def test_a_drone_that_its_flock_pulls_takes_the_way_that_is_free_for_the_flocks_speed() -> None:
    """A wall 6.5 m away: at 3 m/s the way to it is too short, at the flock's 1.2 m/s it is not. Alone it turns off."""
    ahead = around(wall(6.7, 0.0, 0.2, 6.0))
    north, east = steered((3.0, 0.0), ahead, np.array([1.2, 0.0]))
    assert abs(math.atan2(east, north)) < 0.1
    assert 1.5 < math.hypot(north, east) < (6.5 - PARAMETERS.clearance_m) / PARAMETERS.horizon_s
    north, east = steered((3.0, 0.0), ahead)
    assert abs(math.atan2(east, north)) > 0.7
    north, east = steered((3.0, 0.0), ahead, np.array([2.8, 0.0]))
    assert abs(math.atan2(east, north)) > 0.7


@pytest.mark.parametrize(("east", "side"), [(0.3, -1.0), (-0.3, 1.0), (0.0, 1.0)])
def test_a_trunk_is_passed_on_the_nearer_side_and_in_the_middle_on_the_right(east: float, side: float) -> None:
    north, aside = steered((1.5, 0.0), around(trunk(4.0, east)))
    assert north > 1.0
    assert math.copysign(1.0, aside) == side
    speed = math.hypot(north, aside)
    assert speed == pytest.approx(1.5 * math.cos(math.atan2(aside, north) / 2) ** 2)
    clearance_m = abs(4.0 * aside - east * north) / speed - 0.2  # of the straight way to the trunk
    assert clearance_m >= PARAMETERS.clearance_m


def test_into_what_was_not_looked_at_it_does_not_fly() -> None:
    unseen = ObstacleRanges(0.0, FREE.range_m, FREE.sigma_m, np.where(np.arange(72) < 36, 0.0, 15.0))
    east = steered((0.0, 1.5), unseen)[1]  # the eastern half
    assert east <= 1.5 * math.sin(math.radians(2.5)) + 1e-9  # half a sector
    blind = ObstacleRanges(0.0, FREE.range_m, FREE.sigma_m, np.zeros(72))
    np.testing.assert_array_equal(steered((0.0, 1.5), blind), [0.0, 0.0])


def test_too_near_it_flies_off() -> None:
    away = steered((0.0, 0.0), around(trunk(0.7, 0.0)))
    assert away[0] == pytest.approx(-(0.9 - 0.5 + 2 * 0.01))  # the sigma of exact ranges is a centimetre
    assert away[1] == pytest.approx(0.0, abs=1e-9)


# The command.


def test_the_command_can_be_stopped_a_step_later() -> None:
    """From full speed towards a wall: however the law pulls, the way of a step, reaction and braking is left."""
    avoidance, law = Avoidance(PARAMETERS, GATE, 0.5), FlockingLaw(FlockingParameters())
    for away_m in np.arange(1.0, 8.0, 0.25):
        ahead = around(wall(away_m + 0.2, 0.0, 0.2, 30.0))
        command, _ = avoidance.command(law, np.array([1.5, 0.0]), NOBODY, NOBODY[:, :2], np.array([3.0, 0.0]), ahead)
        speed = max(float(command[0]), 0.0)
        assert speed * 1.0 + speed**2 / 3.0 <= max(away_m - PARAMETERS.clearance_m, 0.0) + 1e-6


# A flock on exact states.


def flight(solids: list[Solid], duration_s: float) -> tuple[float, FloatArray]:
    """The smallest clearance of five drones that fly north at 1.5 m/s, and where they end, (5, 3) m."""
    mission = MissionParameters(kind="velocity", velocity_m_s=(1.5, 0.0))
    given = changed(scenario({"ideal": True}, "square"), drone__mission=mission, drone__obstacles=PARAMETERS)
    flock, vehicles, nearest_m = ExactFlock(given), Vehicles(given.vehicles, given.vehicle), math.inf
    flock._obstacles = obstacles = Obstacles(solids)
    for step in range(round(duration_s / 0.5)):
        commands = flock.step(0.5 * step, vehicles.position, vehicles.velocity)
        for _ in range(5):
            vehicles.step(commands.velocity, np.zeros(5), 0.1)
            nearest_m = min(nearest_m, float(obstacles.clearance(vehicles.position).min()))
    return nearest_m, vehicles.position


def test_a_flock_flies_between_trunks_and_hits_none() -> None:
    trunks = [trunk(6.0 + 4.0 * row, 4.0 * column + 2.0 * (row % 2)) for row in range(4) for column in range(-4, 5)]
    nearest_m, ends = flight(list(trunks), 16.0)
    assert nearest_m > 0.6
    assert ends[:, 0].min() > 6.0
