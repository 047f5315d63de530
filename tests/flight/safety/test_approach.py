"""How fast to fly towards obstacles and neighbours, against analytic solutions; the nearest velocity within limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray
from flockd.flight.geometry.level import SAME_SPOT_M
from flockd.flight.safety import Action, Gate
from flockd.flight.safety.approach import stopping_speed, towards_flying_on, towards_neighbours, towards_obstacles
from flockd.flight.safety.half_planes import nearest_within
from tests.make import around, request

PARAMETERS = GateParameters()
EXACT = np.zeros((1, 2))


def test_a_point_without_a_direction_is_left_out() -> None:
    directions, most_m_s = towards_obstacles(
        np.array([[0.0, 0.0], [math.nan, 0.0], [math.inf, 0.0], [0.0, -2.0]]), 0.5, 1.5, 0.5
    )
    np.testing.assert_array_equal(directions, [[0.0, -1.0]])
    assert 0.5 * most_m_s[0] + most_m_s[0] ** 2 / 3.0 == pytest.approx(1.5)


def test_it_can_stop_within_what_is_left() -> None:
    """The way of the reaction, v r, and of braking, v^2 / 2 b, are what is left: 0.5 s and 1.5 m/s^2."""
    left_m = np.array([-1.0, 0.0, 0.2, 0.6, 1.4, 9.0])
    speeds = stopping_speed(left_m, 1.5, 0.5)
    np.testing.assert_allclose(0.5 * speeds + speeds**2 / 3.0, np.maximum(left_m, 0.0), atol=1e-12)


def test_among_random_limits_they_hold_and_no_nearer_velocity_would_do() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        points = rng.uniform(-2.0, 2.0, (int(rng.integers(1, 30)), 2))
        wanted = rng.uniform(-2.0, 2.0, 2)
        directions, most_m_s = towards_obstacles(points, 0.6, 1.5, 0.5)
        velocity = nearest_within(wanted, directions, most_m_s)
        assert (directions @ velocity <= most_m_s + 1e-6).all()
        others = wanted + rng.normal(size=(500, 2)) * np.linalg.norm(wanted - velocity)
        fit = (others @ directions.T <= most_m_s).all(axis=1)
        assert np.linalg.norm(others[fit] - wanted, axis=1).min(initial=9.0) >= np.linalg.norm(velocity - wanted) - 1e-6


@pytest.mark.parametrize(
    ("velocity", "expected"), [([0.3, 0.7], [0.3, 0.7]), ([math.nan, 0.0], [0.0, 0.0])], ids=["within", "not finite"]
)
def test_a_velocity_within_its_limits_is_itself_and_one_that_is_not_finite_does_not_raise(
    velocity: list[float], expected: list[float]
) -> None:
    directions, limits = np.array([[1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]]), np.array([0.5, 0.0, 0.0])
    np.testing.assert_array_equal(nearest_within(np.array(velocity), directions, limits), expected)


def test_the_nearest_obstacle_is_told() -> None:
    assert around().nearest_obstacle_m == math.inf
    assert around(obstacles=[(3.0, 4.0), (-6.0, 0.0)]).nearest_obstacle_m == 5.0


def test_a_neighbour_at_the_same_spot_has_no_direction_and_one_a_little_farther_has() -> None:
    for range_m, count in ((0.9 * SAME_SPOT_M, 0), (SAME_SPOT_M, 1), (1.1 * SAME_SPOT_M, 1)):
        directions, most_m_s = towards_flying_on(PARAMETERS, np.array([[range_m, 0.0, 0.0]]), EXACT, 1.0, EXACT)
        assert len(directions) == len(most_m_s) == count, range_m


def fastest(*neighbours: tuple[float, float], velocities: ArrayLike) -> FloatArray:
    """How fast to fly towards each neighbour at this place north and east, at the drone's height."""
    offsets = np.array([[*place, 0.0] for place in neighbours])
    return towards_flying_on(PARAMETERS, offsets, np.array(velocities), 1.0, np.zeros((len(offsets), 2)))[1]


@pytest.mark.parametrize("velocity", [math.inf, -math.inf, math.nan])
def test_a_neighbour_whose_velocity_is_no_number_counts_as_one_that_hovers(velocity: float) -> None:
    for away_m in (1.2, 3.0):
        there = np.array([[away_m, 0.0, 0.0]])
        it, hovers = (
            towards_neighbours(PARAMETERS, there, np.array([[north_m_s, 0.0]]), 1.0, EXACT, np.zeros(1))[1]
            for north_m_s in (velocity, 0.0)
        )
        np.testing.assert_array_equal(it, hovers)


def test_each_neighbours_own_velocity_counts() -> None:
    comes, goes = [-3.0, 0.0], [0.0, 1.0]
    both = fastest((4.0, 0.0), (0.0, 4.0), velocities=[comes, goes])
    assert both[0] == fastest((4.0, 0.0), velocities=[comes])[0]
    assert both[1] == fastest((0.0, 4.0), velocities=[goes])[0]
    assert both[0] < both[1]


@pytest.mark.parametrize(("range_m", "goes_m_s"), [(1.5, 0.1), (2.47, 1.28), (3.0, 0.8), (6.0, 2.0)])
def test_behind_one_that_flies_along_it_closes_up_as_far_as_it_still_stops_if_that_one_brakes(
    range_m: float, goes_m_s: float
) -> None:
    """The other brakes at once, the drone a second later, both at 1.5 m/s^2: they stand at the separation of 1 m."""
    v = float(fastest((range_m, 0.0), velocities=[[goes_m_s, 0.0]])[0])
    assert v > goes_m_s
    assert range_m + goes_m_s**2 / 3.0 - v * 1.0 - v**2 / 3.0 == pytest.approx(1.0)


def test_too_near_for_that_it_flies_as_fast_as_the_other_and_at_the_separation_not_at_all() -> None:
    for range_m, most_m_s in ((1.0, 0.0), (1.01, 1.28), (1.5, 1.28), (2.25, 1.28)):
        assert fastest((range_m, 0.0), velocities=[[1.28, 0.0]])[0] == pytest.approx(most_m_s)


def test_one_that_barely_goes_is_met_as_one_that_may_begin_to_come() -> None:
    stands, creeps = (fastest((8.0, 0.0), velocities=[[goes, 0.0]])[0] for goes in (0.0, 0.1))
    assert creeps == pytest.approx(stands + 0.1)


@pytest.mark.parametrize(("distance_m", "comes_m_s"), [(2.0, 3.0), (2.0, 1.4), (9.0, 1.5), (30.0, 2.0)])
@pytest.mark.parametrize("neighbour_reaction_s", [0.6, 1.0, 1.5])
def test_both_stop_within_the_distance_left_and_the_drone_stands_where_no_speed_would_do(
    distance_m: float, comes_m_s: float, neighbour_reaction_s: float
) -> None:
    """(v + w) r + v^2 / 2b + w^2 / 2b = distance left, by bisection; never a speed away from it."""
    p = GateParameters(neighbour_reaction_s=neighbour_reaction_s)
    separation_m = 1.0

    def needed_m(speed: float, other: float, reaction_s: float) -> float:
        return (speed + other) * reaction_s + (speed**2 + other**2) / (2 * p.braking_m_s2)

    def fastest(other: float, reaction_s: float) -> float:
        low, high = 0.0, 50.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            fits = needed_m(middle, middle if math.isnan(other) else other, reaction_s) <= distance_m - separation_m
            low, high = (middle, high) if fits else (low, middle)
        return low

    _, most_m_s = towards_flying_on(
        p, np.array([[distance_m, 0.0, 0.0]]), np.array([[-comes_m_s, 0.0]]), separation_m, EXACT
    )
    expected = min(fastest(comes_m_s, neighbour_reaction_s), fastest(math.nan, p.reaction_s))
    assert most_m_s == pytest.approx([expected], abs=1e-6)


def test_a_vehicle_that_follows_as_expected_has_no_error_at_whatever_time_it_flies() -> None:
    """A first-order lag of `reaction_s` behind a step of the setpoint, in closed form."""
    p = GateParameters(max_acceleration_m_s2=50.0)
    gate, speed, errors = Gate(p), 0.0, []
    for tick in range(100):
        now_s = 500.0 + 0.05 * tick
        gate.step(now_s, request(now_s, [1.0, 0.0], Action.FLY, around(velocity=[speed, 0.0])))
        errors.append(gate.response.error_m_s)
        speed = 1.0 - math.exp(-0.05 * tick / p.reaction_s)
    assert max(errors) < 0.05


def test_one_that_stands_counts_where_it_stands_and_one_at_no_known_distance_nowhere() -> None:
    """0.5 v + v^2 / 3 is what is left of 5 m."""
    p, seen = GateParameters(), np.zeros(1)
    directions, limits = towards_neighbours(p, np.array([[3.0, 4.0, 0.5]]), EXACT, 1.0, EXACT, seen)
    np.testing.assert_allclose(directions, [[0.6, 0.8]] * 2)
    assert limits[1] == pytest.approx(-0.75 + math.sqrt(0.5625 + 3.0 * 4.0))
    for nowhere in (math.inf, -math.inf):
        assert not len(towards_neighbours(p, np.array([[nowhere, 0.0, 0.0]]), EXACT, 1.0, EXACT, seen)[1])


def test_a_limit_that_is_no_number_is_standstill() -> None:
    assert nearest_within(np.array([1.0, 0.0]), np.array([[1.0, 0.0]]), np.array([math.nan])).tolist() == [0.0, 0.0]
