"""The gate near obstacles: no velocity towards one within the stopping distance; by hand and with random ones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from flockd.core.messages import FloatArray, Wanted
from flockd.flight.geometry.level import SAME_SPOT_M
from flockd.flight.safety import Action, Gate, GateParameters, Objection, Permission, Request, Surroundings, Verdict
from flockd.flight.safety.approach import stopping_speed, towards_neighbours, towards_obstacles
from flockd.flight.safety.half_planes import nearest_within

PARAMETERS = GateParameters(obstacle_clearance_m=0.6, braking_m_s2=1.5, reaction_s=0.5).model_copy(
    update={"max_acceleration_m_s2": 1e6}
)


def among(*points: ArrayLike) -> Surroundings:
    return Surroundings(
        position=np.zeros(2),
        velocity=np.zeros(2),
        yaw_rad=0.0,
        neighbours=np.empty((0, 3)),
        neighbour_velocities=np.empty((0, 2)),
        height_m=5.0,
        obstacles=np.array(points, dtype=float).reshape(-1, 2),
    )


def flown(velocity: ArrayLike, around: Surroundings, action: Action = Action.FLY) -> Verdict:
    """The second of two steps: the first one begins at the drone's own velocity."""
    gate = Gate(PARAMETERS)
    for now_s in (0.05, 0.1):
        wanted = Wanted(np.array(velocity, dtype=float), np.zeros(2), 0.0)
        verdict = gate.step(now_s, Request(Permission(action, now_s), wanted, now_s, 5.0, around))
    return verdict


def velocity_of(verdict: Verdict) -> FloatArray:
    assert verdict.setpoint is not None
    return verdict.setpoint.velocity


def test_nothing_changes_far_from_obstacles() -> None:
    verdict = flown([2.0, 0.0], among([10.0, 0.0], [0.0, 0.7]))
    np.testing.assert_array_equal(velocity_of(verdict), [2.0, 0.0])
    assert verdict.objections == ()


@pytest.mark.parametrize("away_m", [0.6, 0.3, 1e-3])
def test_nearer_than_the_clearance_no_velocity_leads_there(away_m: float) -> None:
    verdict = flown([2.0, 1.0], among([away_m, 0.0]))
    np.testing.assert_allclose(velocity_of(verdict), [0.0, 1.0], atol=1e-9)
    assert verdict.objections == (Objection.OBSTACLE,)


def test_away_from_an_obstacle_it_flies_as_it_likes() -> None:
    np.testing.assert_array_equal(velocity_of(flown([-2.0, 0.5], among([0.2, 0.0]))), [-2.0, 0.5])


@pytest.mark.parametrize("away_m", [0.8, 1.2, 2.0, 2.4])
def test_it_can_stop_before_the_clearance(away_m: float) -> None:
    """The way of the reaction, v r, and of braking, v^2 / 2 b, are what is left: 0.5 s and 1.5 m/s^2."""
    speed = float(velocity_of(flown([3.0, 0.0], among([away_m, 0.0])))[0])
    assert 0.0 < speed < 3.0
    assert 0.5 * speed + speed**2 / 3.0 == pytest.approx(away_m - 0.6)


def test_degraded_drones_and_obstacles_on_both_sides() -> None:
    verdict = flown([0.9, 0.0], among([0.5, 0.5], [0.5, -0.5]), Action.FLY_DEGRADED)
    north, east = velocity_of(verdict)
    towards = north / math.sqrt(2)  # either of them
    assert east == pytest.approx(0.0, abs=1e-9)
    assert 0.5 * towards + towards**2 / 3.0 == pytest.approx(math.sqrt(0.5) - 0.6)


def test_a_drone_that_stands_still_may_stay_beside_an_obstacle() -> None:
    verdict = flown([1.0, 0.0], among([0.1, 0.0]), Action.HOVER)
    np.testing.assert_array_equal(velocity_of(verdict), [0.0, 0.0])
    assert verdict.objections == ()


@pytest.mark.parametrize("point", [[math.nan, 1.0], [1.0, math.inf]])
def test_a_command_among_obstacles_that_are_nowhere_is_refused(point: list[float]) -> None:
    verdict = flown([1.0, 0.0], among([5.0, 0.0], point))
    np.testing.assert_array_equal(velocity_of(verdict), [0.0, 0.0])
    assert verdict.objections == (Objection.OBSTACLE_UNKNOWN,)


def test_a_point_without_a_direction_is_left_out() -> None:
    directions, most_m_s = towards_obstacles(
        np.array([[0.0, 0.0], [math.nan, 0.0], [math.inf, 0.0], [0.0, -2.0]]), 0.5, 1.5, 0.5
    )
    np.testing.assert_array_equal(directions, [[0.0, -1.0]])
    assert 0.5 * most_m_s[0] + most_m_s[0] ** 2 / 3.0 == pytest.approx(1.5)


def test_neighbours_and_obstacles_are_both_heeded() -> None:
    around = replace(among([0.4, 0.0]), neighbours=np.array([[0.0, 0.9, 0.0]]), neighbour_velocities=np.zeros((1, 2)))
    verdict = flown([1.0, 1.0], around)
    np.testing.assert_allclose(velocity_of(verdict), [0.0, 0.0], atol=1e-9)
    assert set(verdict.objections) == {Objection.SEPARATION, Objection.OBSTACLE}


def test_among_random_obstacles_the_limits_hold_and_no_nearer_velocity_would_do() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        points = rng.uniform(-2.0, 2.0, (int(rng.integers(1, 30)), 2))
        wanted = rng.uniform(-2.0, 2.0, 2)
        velocity = velocity_of(flown(wanted, among(*points)))
        away_m = np.hypot(*points.T)
        directions = points / away_m[:, None]
        most = stopping_speed(away_m - 0.6, 1.5, 0.5)
        assert (directions @ velocity <= most + 1e-6).all()
        others = wanted + rng.normal(size=(500, 2)) * np.linalg.norm(wanted - velocity)
        fit = (others @ directions.T <= most).all(axis=1)
        if fit.any():
            assert np.linalg.norm(others[fit] - wanted, axis=1).min() >= np.linalg.norm(velocity - wanted) - 1e-6


def test_the_stopping_speed_of_no_way_is_none() -> None:
    np.testing.assert_array_equal(stopping_speed(np.array([0.0, -1.0]), 1.5, 0.5), [0.0, 0.0])


def test_a_velocity_that_is_not_finite_does_not_raise() -> None:
    np.testing.assert_array_equal(nearest_within(np.array([np.nan, 0.0]), np.array([[1.0, 0.0]]), np.zeros(1)), [0, 0])


def test_a_velocity_within_its_limits_is_itself() -> None:
    directions, limits = np.array([[1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]]), np.array([0.5, 0.0, 0.0])
    np.testing.assert_array_equal(nearest_within(np.array([0.3, 0.7]), directions, limits), [0.3, 0.7])


def test_a_gap_between_two_walls_is_flown_through_in_its_middle() -> None:
    points = [(0.1 * k, side) for k in range(-20, 21) for side in (-0.9, 0.9)]
    np.testing.assert_allclose(velocity_of(flown([1.0, 0.0], among(*points))), [1.0, 0.0])


def test_the_nearest_obstacle_is_told() -> None:
    assert among().nearest_obstacle_m == math.inf
    assert among((3.0, 4.0), (-6.0, 0.0)).nearest_obstacle_m == 5.0


def test_a_neighbour_at_the_same_spot_has_no_direction_and_one_a_little_farther_has() -> None:
    for range_m, count in ((0.9 * SAME_SPOT_M, 0), (SAME_SPOT_M, 1), (1.1 * SAME_SPOT_M, 1)):
        directions, most_m_s = towards_neighbours(PARAMETERS, np.array([[range_m, 0.0, 0.0]]), np.zeros((1, 2)), 1.0)
        assert len(directions) == len(most_m_s) == count, range_m


def fastest(*neighbours: tuple[float, float], velocities: ArrayLike, separation_m: float = 1.0) -> FloatArray:
    """How fast to fly towards each neighbour at this place north and east, at the drone's height."""
    offsets = np.array([[*place, 0.0] for place in neighbours])
    return towards_neighbours(PARAMETERS, offsets, np.array(velocities, dtype=float), separation_m)[1]


@pytest.mark.parametrize("velocity", [math.inf, -math.inf, math.nan])
def test_a_neighbour_whose_velocity_is_no_number_counts_as_one_that_hovers(velocity: float) -> None:
    for away_m in (1.2, 3.0):
        assert fastest((away_m, 0.0), velocities=[[velocity, 0.0]]) == fastest((away_m, 0.0), velocities=[[0.0, 0.0]])


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


def test_too_near_for_that_it_flies_as_fast_as_the_other() -> None:
    for range_m in (1.01, 1.5, 2.25):
        assert fastest((range_m, 0.0), velocities=[[1.28, 0.0]])[0] == pytest.approx(1.28)


def test_one_that_barely_goes_is_met_as_one_that_may_begin_to_come() -> None:
    stands, creeps = (fastest((8.0, 0.0), velocities=[[goes, 0.0]])[0] for goes in (0.0, 0.1))
    assert creeps == pytest.approx(stands + 0.1)


def test_nobody_follows_a_neighbour_at_the_separation_itself() -> None:
    assert fastest((1.0, 0.0), velocities=[[2.0, 0.0]], separation_m=1.0) == 0.0
    assert fastest((1.001, 0.0), velocities=[[2.0, 0.0]], separation_m=1.0) > 0.0
