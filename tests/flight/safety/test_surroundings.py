"""What the gate is told of the neighbours: moved on to now, in the level frame of the drone that has moved too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flockd.core.config.safety import GateParameters
from flockd.core.messages import SECTORS, Neighbour, PossibleMotion
from flockd.flight.safety import Objection, Surroundings
from flockd.flight.safety.surroundings import BEYOND, into_the_unseen, limits_around, limits_towards, surroundings
from tests.make import around, neighbour


def told(*neighbours: Neighbour, obstacles: Sequence[Sequence[float]] = ()) -> Surroundings:
    """Half a second after the step, in which the drone flew 1 m north, 2 m west and 0.5 m up."""
    return surroundings(
        neighbours, 0.5, moved=np.array([1.0, -2.0, -0.5]), position=np.array([30.0, 40.0]),
        velocity=np.array([2.0, -4.0, -1.0]), yaw_rad=0.3, height_m=6.0, obstacles=np.reshape(obstacles, (-1, 2)),
        seen_m=np.full(SECTORS, 9.0),
    )  # fmt: skip


def known(position: list[float], velocity: Sequence[float] = (0, 0, 0), sigma: float = 0.1, **fields: Any) -> Neighbour:
    return neighbour(position, velocity, position_sigma_m=sigma, velocity_sigma_m_s=2 * sigma, **fields)


def may(probability: float, north_m_s: float = 0.0) -> PossibleMotion:
    """6 m ahead, and flies so fast."""
    return PossibleMotion(
        probability, np.array([6.0, 0.0, 0.0]), np.array([north_m_s, 0, 0]), range_sigma_m=0.5, closing_sigma_m_s=1.0
    )


def test_neighbours_fly_on_and_the_drone_has_moved_and_obstacles_stand_still() -> None:
    both = known([5.0, 0.0, 0.0], [2.0, 4.0, 6.0]), known([0.0, 8.0, -1.0], [0.0, -2.0, 1.0], 0.2, confirmed=False)
    near = told(*both, obstacles=[[3.0, 0.0], [0.0, -6.0]])
    np.testing.assert_allclose(near.neighbours, [[5.0, 4.0, 3.5], [-1.0, 9.0, 0.0]])
    np.testing.assert_allclose(near.neighbour_velocities, [[2.0, 4.0], [0.0, -2.0]])
    np.testing.assert_allclose(near.neighbour_margins, [[0.2, 0.4], [0.4, 0.8]])  # two standard deviations
    np.testing.assert_allclose(near.obstacles, [[2.0, 2.0], [-1.0, -4.0]])
    np.testing.assert_array_equal([*near.position, *near.velocity], [30.0, 40.0, 2.0, -4.0])
    assert (near.yaw_rad, near.height_m) == (0.3, 6.0)
    np.testing.assert_allclose(near.seen_m, 9.0 - math.sqrt(5.0))


def test_one_that_is_as_likely_not_there_counts_by_half() -> None:
    """By tables: 0.0228 of 0.5 are 0.0455, beyond 1.690 deviations; of 0.02 it is more than all, and nothing counts."""
    doubted = (known([5.0, 0.0, 0.0], [2.0, 0.0, 0.0], existence_probability=share) for share in (0.5, 0.02))
    np.testing.assert_allclose(told(*doubted).neighbour_margins, [[0.169, 0.338]], atol=1e-3)


def test_one_that_may_move_in_two_ways_counts_as_both_each_by_its_probability() -> None:
    """By tables of the normal distribution: 0.0114 of 0.9 and of 0.1 are 0.0126 and 0.1138, beyond 2.238 and 1.207."""
    near = told(known([6.0, 0.0, 0.0], [1.4, 0.0, 0.0], possible=(may(0.9, 2.0), may(0.1, -4.0))))
    np.testing.assert_allclose(near.neighbours, [[6.0, 2.0, 0.5], [3.0, 2.0, 0.5]])
    np.testing.assert_allclose(near.neighbour_velocities, [[2.0, 0.0], [-4.0, 0.0]])
    np.testing.assert_allclose(near.neighbour_margins, [[1.119, 2.238], [0.603, 1.207]], atol=2e-3)


@pytest.mark.parametrize(("share", "count"), [(0.0113, 1), (BEYOND / 2, 1), (0.0115, 2)])
def test_a_motion_less_probable_than_its_share_of_the_doubt_does_not_count(share: float, count: int) -> None:
    """Half of 2.275 % is 1.1375 %."""
    assert len(told(known([6.0, 0.0, 0.0], possible=(may(1 - share), may(share)))).neighbours) == count


@pytest.mark.parametrize(
    ("place", "velocity", "by_now"),
    [
        ([6.0, -2.0, -0.5], [-4.0, 0.0, 0.0], [3.0, 0.0, 0.0]),
        ([6.0, -2.0, -0.5], [-8.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
        ([6.0, -2.0, -0.5], [-10.0, 2.0, 2.0], [5.0, 0.0, 0.0]),  # exactly abeam
        ([6.0, -2.0, -0.5], [-16.0, 0.0, 0.0], [5.0, 0.0, 0.0]),  # it would be 3 m behind
        ([6.0, -2.0, -0.5], [-16.0, 16.0, 0.0], [5.0, 0.0, 0.0]),
        ([6.0, -2.0, 2.0], [-16.0, 0.0, 0.0], [5.0, 0.0, 2.5]),  # below: for the gate at the drone's height
        ([0.5, -2.0, -0.5], [-2.0, 0.0, 0.0], [-1.5, 0.0, 0.0]),  # the drone has passed it
    ],
)
def test_a_neighbour_that_would_have_flown_through_the_drone_has_braked(
    place: list[float], velocity: list[float], by_now: list[float]
) -> None:
    np.testing.assert_allclose(told(known(place, velocity)).neighbours, [by_now])


@pytest.mark.fault("mate-stops")
@pytest.mark.parametrize(("unseen_s", "left_m"), [(0.0, 3.4), (0.5, 2.4), (1.0, 1.4), (2.0, 0.0)])
def test_one_that_goes_may_have_braked_since_it_was_seen_last(unseen_s: float, left_m: float) -> None:
    """2 m/s ahead at 4 m by its track: it stands 2^2 / 2 / 5 = 0.4 m farther on than where it was seen; 1 m is kept."""
    one = known([4.0, 0.0, 0.0], [2.0, 0.0, 0.0], 0.0, unseen_s=unseen_s)
    flies_on_m_s, brakes_m_s = limits_towards([one], None, GateParameters())[1]
    assert flies_on_m_s == pytest.approx(math.sqrt(1.5**2 + 2 * 1.5 * 3.0 + 2.0**2) - 1.5)
    assert brakes_m_s == pytest.approx(math.sqrt(0.75**2 + 2 * 1.5 * left_m) - 0.75)
    # Two standard deviations of its place, and of its velocity for the reaction time of a second.
    for unsure in (replace(one, position_sigma_m=0.25), replace(one, velocity_sigma_m_s=0.25)):
        slower_m_s = limits_towards([unsure], None, GateParameters())[1][1]
        assert slower_m_s == pytest.approx(math.sqrt(0.75**2 + 3 * max(left_m - 2 * 0.25, 0.0)) - 0.75)
    np.testing.assert_allclose(told(one).neighbour_unseen_s, [unseen_s + 0.5])


def test_of_nobody_and_nothing_there_are_arrays_all_the_same() -> None:
    near, (directions, most_m_s) = told(), limits_towards([], None, GateParameters())
    assert near.neighbours.shape == (0, 3)
    assert near.neighbour_velocities.shape == near.neighbour_margins.shape == near.obstacles.shape == (0, 2)
    assert directions.shape == (0, 2) and most_m_s.shape == (0,)


def test_a_pilot_hears_how_fast_the_gate_lets_it_fly_towards_each() -> None:
    """4 m ahead, 3 m left: sqrt(0.75^2 + 1.5 * 3) - 0.75 = 1.5 m/s, as if it began to come now; below, no limit."""
    p, here = GateParameters(), [4.0, 0.0, 0.0]
    directions, most_m_s = limits_towards([known(here, sigma=0.0), known([0.0, 6.0, 3.5], sigma=0.0)], None, p)
    np.testing.assert_allclose(directions, [[1.0, 0.0], [1.0, 0.0]])  # as flying on, and as braking
    assert most_m_s.min() == pytest.approx(1.5)
    goes = limits_towards([known(here, [1.0, 0.0, 0.0], 0.0)], None, p)[1]
    # sqrt(1.5^2 + 2 * 1.5 * 3 + 1^2) - 1.5: it may brake unseen for a second. Or it does now, and stands 0.1 m on.
    np.testing.assert_allclose(goes, [2.0, math.sqrt(0.75**2 + 2 * 1.5 * 3.1) - 0.75])
    assert limits_towards([known(here, sigma=0.5)], None, p)[1].min() < 1.0, "in doubt"
    directions, most_m_s = limits_towards([], np.array([99.0, 0.0]), p)  # 1 m before the fence, of which 0.6 m are kept
    assert most_m_s[directions[:, 0] > 0.99].tolist() == [pytest.approx(math.sqrt(0.75**2 + 3 * 0.4) - 0.75)]
    directions, most_m_s = limits_towards([], np.array([99.0, 0.0]), p, 2.5)  # 2.5 v + v^2 / 3 = 0.4
    assert most_m_s[directions[:, 0] > 0.99].tolist() == [pytest.approx(math.sqrt(3.75**2 + 3 * 0.4) - 3.75)]


@pytest.mark.parametrize("velocity", [(0.0, 0.0), (math.nan, math.nan), (math.nan, 1.0)])
def test_where_the_own_velocity_is_not_known_the_limits_are_those_of_a_drone_within_them(
    velocity: tuple[float, float],
) -> None:
    """3 m ahead, without the clearance of 0.6 m, are 2.4 m: 0.5 v + v^2 / 3."""
    near = around(velocity=velocity, obstacles=[[3.0, 0.0]])
    _, (most_m_s,), there = limits_around(GateParameters(fence_radius_m=None), near, 1.0, 0.0)
    assert 0.5 * most_m_s + most_m_s**2 / 3.0 == pytest.approx(2.4)
    assert there == [Objection.OBSTACLE]


def test_into_the_unseen_no_faster_than_it_stops_within_what_was_seen() -> None:
    """v r + v^2 / 2b is what was seen that way and in the sectors beside it, less the separation."""
    p, nobody = GateParameters(), np.empty((0, 2))
    free = surroundings(
        (), 0.0, moved=np.zeros(3), position=np.zeros(2), velocity=np.zeros(3), yaw_rad=0.0, height_m=5.0,
        obstacles=nobody, seen_m=np.full(SECTORS, 8.0),
    )  # fmt: skip
    north = np.array([1.0, 0.0])
    v = into_the_unseen(p, free, 1.5, 0.4, north)
    assert v * (p.neighbour_reaction_s + 0.4) + v**2 / (2 * p.braking_m_s2) == pytest.approx(6.5)
    for sector in (-1, 0, 1):
        seen_m = free.seen_m.copy()
        seen_m[sector] = 0.2
        assert into_the_unseen(p, replace(free, seen_m=seen_m), 0.5, 0.0, north) == 0.0
    for apart_m, limited in ((1.5, True), (1.49, False)):
        beside = replace(free, neighbours=np.array([[0.0, apart_m, 0.0]]))
        assert math.isfinite(into_the_unseen(p, beside, 1.5, 0.0, north)) == limited
        clear_m = p.obstacle_clearance_m if limited else p.obstacle_clearance_m - 0.01
        before = replace(free, obstacles=np.array([[0.0, clear_m]]))
        assert math.isfinite(into_the_unseen(p, before, 1.5, 0.0, north)) == limited
