"""What the gate is told of the neighbours: moved on to now, in the level frame of the drone that has moved too."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray, Neighbour, PossibleMotion
from flockd.flight.safety import Surroundings
from flockd.flight.safety.surroundings import BEYOND, limits_towards, surroundings
from tests.make import neighbour


def told(neighbours: list[Neighbour], obstacles: FloatArray) -> Surroundings:
    """Half a second after the step, in which the drone flew 1 m north, 2 m west and 0.5 m up."""
    return surroundings(
        neighbours,
        0.5,
        moved=np.array([1.0, -2.0, -0.5]),
        position=np.array([30.0, 40.0]),
        velocity=np.array([2.0, -4.0, -1.0]),
        yaw_rad=0.3,
        height_m=6.0,
        obstacles=obstacles,
    )


def known(number: int, position: list[float], velocity: list[float], *, confirmed: bool) -> Neighbour:
    sigma = {"position_sigma_m": 0.1 * number, "velocity_sigma_m_s": 0.2 * number}
    return neighbour(position, velocity, track=number, age_s=1.0, hits=3, confirmed=confirmed, **sigma)


def test_neighbours_fly_on_and_the_drone_has_moved() -> None:
    both = [
        known(1, [5.0, 0.0, 0.0], [2.0, 4.0, 6.0], confirmed=True),
        known(2, [0.0, 8.0, -1.0], [0.0, -2.0, 1.0], confirmed=False),
    ]
    around = told(both, np.empty((0, 2)))
    np.testing.assert_allclose(around.neighbours, [[5.0, 4.0, 3.5], [-1.0, 9.0, 0.0]])
    np.testing.assert_allclose(around.neighbour_velocities, [[2.0, 4.0], [0.0, -2.0]])
    assert around.neighbour_margins is not None  # two standard deviations
    np.testing.assert_allclose(around.neighbour_margins, [[0.2, 0.4], [0.4, 0.8]])


def test_one_that_is_as_likely_not_there_counts_by_half() -> None:
    """By tables: 0.0228 of 0.5 are 0.0455, beyond 1.690 deviations; of 0.02 it is more than all, and nothing counts."""
    doubted = [
        replace(known(1, [5.0, 0.0, 0.0], [2.0, 0.0, 0.0], confirmed=False), existence_probability=probability)
        for probability in (0.5, 0.02)
    ]
    margins = told(doubted, np.empty((0, 2))).neighbour_margins
    assert margins is not None
    np.testing.assert_allclose(margins, [[0.169, 0.338]], atol=1e-3)


def test_one_that_may_move_in_two_ways_counts_as_both_each_by_its_probability() -> None:
    """By tables of the normal distribution: 0.0114 of 0.9 and of 0.1 are 0.0126 and 0.1138, beyond 2.238 and 1.207."""
    mate, comes = (
        PossibleMotion(
            share,
            np.array([6.0, 0.0, 0.0]),
            np.array([north_m_s, 0.0, 0.0]),
            range_sigma_m=0.5,
            closing_sigma_m_s=1.0,
        )
        for share, north_m_s in ((0.9, 2.0), (0.1, -4.0))
    )
    one = replace(known(1, [6.0, 0.0, 0.0], [1.4, 0.0, 0.0], confirmed=False), possible=(mate, comes))
    around = told([one], np.empty((0, 2)))
    np.testing.assert_allclose(around.neighbours, [[6.0, 2.0, 0.5], [3.0, 2.0, 0.5]])
    np.testing.assert_allclose(around.neighbour_velocities, [[2.0, 0.0], [-4.0, 0.0]])
    assert around.neighbour_margins is not None
    np.testing.assert_allclose(around.neighbour_margins, [[1.119, 2.238], [0.603, 1.207]], atol=2e-3)


def test_a_motion_less_probable_than_its_share_of_the_doubt_does_not_count() -> None:
    """Half of 2.275 % is 1.1375 %."""
    here, still = np.array([6.0, 0.0, 0.0]), np.zeros(3)
    for share, count in ((0.0113, 1), (BEYOND / 2, 1), (0.0115, 2)):
        motions = tuple(
            PossibleMotion(probability, here, still, range_sigma_m=0.5, closing_sigma_m_s=1.0)
            for probability in (1 - share, share)
        )
        one = replace(known(1, [6.0, 0.0, 0.0], [0.0, 0.0, 0.0], confirmed=True), possible=motions)
        assert len(told([one], np.empty((0, 2))).neighbours) == count


@pytest.mark.parametrize(
    ("velocity", "by_now"),
    [
        ([-4.0, 0.0, 0.0], [3.0, 0.0, 0.0]),
        ([-8.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
        ([-10.0, 2.0, 2.0], [5.0, 0.0, 0.0]),  # exactly abeam
        ([-16.0, 0.0, 0.0], [5.0, 0.0, 0.0]),  # it would be 3 m behind
        ([-16.0, 16.0, 0.0], [5.0, 0.0, 0.0]),
    ],
)
def test_a_neighbour_that_would_have_flown_through_the_drone_has_braked(
    velocity: list[float], by_now: list[float]
) -> None:
    around = told([known(1, [6.0, -2.0, -0.5], velocity, confirmed=False)], np.empty((0, 2)))
    np.testing.assert_allclose(around.neighbours, [by_now])


def test_one_that_passes_below_at_the_drones_place_has_braked_too() -> None:
    """The gate takes one that is above or below by less than `vertical_separation_m` for one at its height."""
    around = told([known(1, [6.0, -2.0, 2.0], [-16.0, 0.0, 0.0], confirmed=True)], np.empty((0, 2)))
    np.testing.assert_allclose(around.neighbours, [[5.0, 0.0, 2.5]])


def test_one_that_the_drone_itself_has_passed_is_behind() -> None:
    around = told([known(1, [0.5, -2.0, -0.5], [-2.0, 0.0, 0.0], confirmed=True)], np.empty((0, 2)))
    np.testing.assert_allclose(around.neighbours, [[-1.5, 0.0, 0.0]])


def test_obstacles_stand_still() -> None:
    around = told([], np.array([[3.0, 0.0], [0.0, -6.0]]))
    np.testing.assert_allclose(around.obstacles, [[2.0, 2.0], [-1.0, -4.0]])


@pytest.mark.fault("mate-stops")
@pytest.mark.parametrize(("unseen_s", "left_m"), [(0.0, 3.4), (0.5, 2.4), (1.0, 1.4), (2.0, 0.0)])
def test_one_that_goes_may_have_braked_since_it_was_seen_last(unseen_s: float, left_m: float) -> None:
    """2 m/s ahead at 4 m by its track: it stands 2^2 / 2 / 5 = 0.4 m farther on than where it was seen; 1 m is kept."""
    one = replace(
        known(1, [4.0, 0.0, 0.0], [2.0, 0.0, 0.0], confirmed=True),
        position_sigma_m=0.0,
        velocity_sigma_m_s=0.0,
        unseen_s=unseen_s,
    )
    flies_on_m_s, brakes_m_s = limits_towards([one], GateParameters())[1]
    assert flies_on_m_s == pytest.approx(math.sqrt(1.5**2 + 2 * 1.5 * 3.0 + 2.0**2) - 1.5)
    assert brakes_m_s == pytest.approx(math.sqrt(0.75**2 + 2 * 1.5 * left_m) - 0.75)
    faster = replace(one, velocity_sigma_m_s=0.25)
    left_m = max(left_m - 2 * 0.25 * 1.0, 0.0)  # two standard deviations, for the reaction time
    assert limits_towards([faster], GateParameters())[1][1] == pytest.approx(math.sqrt(0.75**2 + 3 * left_m) - 0.75)
    later = surroundings(
        [replace(one, unseen_s=0.0)], unseen_s, moved=np.zeros(3), position=np.zeros(2), velocity=np.zeros(3),
        yaw_rad=0.0, height_m=5.0, obstacles=np.empty((0, 2)),
    )  # fmt: skip
    assert later.neighbour_unseen_s is not None
    np.testing.assert_allclose(later.neighbour_unseen_s, [unseen_s])


def test_of_nobody_and_nothing_there_are_arrays_all_the_same() -> None:
    around = told([], np.empty((0, 2)))
    assert around.neighbours.shape == (0, 3)
    assert around.neighbour_margins is not None
    assert around.neighbour_velocities.shape == around.neighbour_margins.shape == around.obstacles.shape == (0, 2)


def test_the_drone_itself_is_where_it_is_now() -> None:
    around = told([], np.empty((0, 2)))
    np.testing.assert_array_equal(around.position, [30.0, 40.0])
    np.testing.assert_array_equal(around.velocity, [2.0, -4.0])
    assert (around.yaw_rad, around.height_m) == (0.3, 6.0)


def test_a_pilot_hears_how_fast_the_gate_lets_it_fly_towards_each() -> None:
    """4 m ahead, 3 m left: sqrt(0.75^2 + 1.5 * 3) - 0.75 = 1.5 m/s, as if it began to come now; below, no limit."""
    p, here = GateParameters(), [4.0, 0.0, 0.0]
    stands = [
        replace(known(1, at, [0.0, 0.0, 0.0], confirmed=True), position_sigma_m=0.0, velocity_sigma_m_s=0.0)
        for at in (here, [0.0, 6.0, 3.5])
    ]
    directions, most_m_s = limits_towards(stands, p)
    np.testing.assert_allclose(directions, [[1.0, 0.0], [1.0, 0.0]])  # as flying on, and as braking
    assert most_m_s.min() == pytest.approx(1.5)
    goes = limits_towards([replace(stands[0], velocity=np.array([1.0, 0.0, 0.0]))], p)[1]
    # sqrt(1.5^2 + 2 * 1.5 * 3 + 1^2) - 1.5: it may brake unseen for a second. Or it does now, and stands 0.1 m on.
    np.testing.assert_allclose(goes, [2.0, math.sqrt(0.75**2 + 2 * 1.5 * 3.1) - 0.75])
    in_doubt_m_s = limits_towards([known(5, here, [0.0, 0.0, 0.0], confirmed=False)], p)[1]
    assert in_doubt_m_s.min() < 1.0
    directions, most_m_s = limits_towards([], p)
    assert directions.shape == (0, 2) and most_m_s.shape == (0,)
