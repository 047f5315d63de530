"""Passing: half-planes of optimal reciprocal collision avoidance, by hand and by flying them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.config.flocking import FlockingParameters
from flockd.core.messages import FloatArray
from flockd.flight.flocking import FlockingLaw
from flockd.flight.flocking.passing import HORIZON_S, clear_of, command

PARAMETERS = FlockingParameters()
NORTH = np.array([2.0, 0.0])
NOBODY = np.empty((0, 3))


def passed(offset: list[float], theirs: list[float], wanted: FloatArray = NORTH) -> FloatArray:
    """With one neighbour, by a drone that flies as it wants to."""
    return clear_of(wanted, wanted, np.array([offset]), np.array([theirs]), PARAMETERS, 3.0)


def test_who_meets_nobody_flies_as_it_wants_to() -> None:
    np.testing.assert_array_equal(clear_of(NORTH, NORTH, NOBODY, NOBODY[:, :2], PARAMETERS, 3.0), NORTH)


@pytest.mark.parametrize(
    ("offset", "theirs"),
    [
        ([3.0, 0.0, 0.0], [2.0, 0.0]),  # a mate that flies along
        ([-3.0, 0.0, 0.0], [2.0, 0.0]),
        ([20.0, 0.0, 0.0], [-2.0, 0.0]),  # 18.5 m to the separation at 4 m/s: farther than the horizon
        ([6.0, 4.0, 0.0], [-2.0, 0.0]),  # passes 4 m aside
        ([6.0, 0.0, -3.0], [-2.0, 0.0]),  # above
        ([-6.0, 0.0, 0.0], [-2.0, 0.0]),  # gone by
    ],
)
def test_who_comes_not_too_near_changes_nothing(offset: list[float], theirs: list[float]) -> None:
    np.testing.assert_array_equal(passed(offset, theirs), NORTH)


def test_the_acceleration_is_the_laws_or_leads_to_the_velocity_that_passes() -> None:
    """The drone flies as it wants to; one 9 m ahead flies along, and then comes at 3 m/s."""
    law, offset = FlockingLaw(PARAMETERS), np.array([[9.0, 0.0, 0.0]])
    for theirs, passes in ((NORTH, False), (-1.5 * NORTH, True)):
        velocity, acceleration = command(law, NORTH, offset, theirs[None], NORTH, 0.5, 3.0)
        of_law = law.command(NORTH, offset[:, :2], theirs[None], NORTH, 0.5)
        assert bool(np.abs(velocity - of_law[0]).max() > 0.1) is passes
        expected = (velocity - NORTH) / 0.5 if passes else of_law[1]
        np.testing.assert_allclose(acceleration, expected)


def test_two_that_meet_head_on_each_turn_half_of_what_is_needed_to_their_right() -> None:
    """6 m away and 1.5 m to keep: the cone's side is asin(1.5 / 6) off; of 4 m/s its sine is across, and half of it."""
    sine = 0.25
    normal = np.array([-sine, math.sqrt(1 - sine**2)])
    np.testing.assert_allclose(passed([6.0, 0.0, 0.0], [-2.0, 0.0]), NORTH + 0.5 * 4.0 * sine * normal)
    np.testing.assert_allclose(passed([-6.0, 0.0, 0.0], [2.0, 0.0], -NORTH), -(NORTH + 0.5 * 4.0 * sine * normal))


def test_one_that_stays_clear_to_the_left_is_passed_to_the_left() -> None:
    """1 m to the right at 6 m is asin(1.5 / 6.08) - 9.5 = 4.8 degrees into the cone; half of 4 m/s times its sine."""
    north_m_s, east_m_s = passed([6.0, 1.0, 0.0], [-2.0, 0.0])
    into = math.asin(1.5 / math.hypot(6.0, 1.0)) - math.atan2(1.0, 6.0)
    assert east_m_s == pytest.approx(-2.0 * math.sin(into) * math.cos(into), rel=0.01)
    assert north_m_s < 2.0


def test_far_away_a_slower_approach_is_enough() -> None:
    """9 m away at 4 m/s, 7.5 m to the separation: it may be 3 m/s; of the 1 m/s too much half is taken off."""
    assert 7.5 / HORIZON_S == 3.0
    np.testing.assert_allclose(passed([9.0, 0.0, 0.0], [-2.0, 0.0])[0], 2.0, atol=0.5)
    slowed = clear_of(NORTH, NORTH, np.array([[9.0, 0.0, 0.0]]), np.array([[-1.2, 0.0]]), PARAMETERS, 3.0)
    np.testing.assert_allclose(slowed, [1.9, 0.0])


def test_nearer_than_the_separation_it_comes_no_nearer() -> None:
    np.testing.assert_allclose(passed([1.2, 0.0, 0.0], [0.5, 0.0], np.array([0.8, 0.3])), [0.5, 0.3])
    np.testing.assert_allclose(passed([1.2, 0.0, 0.0], [0.5, 0.0], np.array([0.2, 0.3])), [0.2, 0.3])


def test_between_two_that_come_it_flies_as_clear_of_both_as_can_be() -> None:
    """From the left and the right, so fast that there is no way out: within the highest speed, and away from none."""
    offsets, theirs = np.array([[0.0, 2.0, 0.0], [0.0, -2.0, 0.0]]), np.array([[2.0, -3.0], [2.0, 3.0]])
    velocity = clear_of(NORTH, NORTH, offsets, theirs, PARAMETERS, 3.0)
    assert math.hypot(*velocity) <= PARAMETERS.max_speed_m_s
    assert velocity[0] > NORTH[0]  # through before they meet


@pytest.mark.parametrize("avoids", [True, False])
@pytest.mark.parametrize("angle_deg", [180.0, 135.0, 90.0, 45.0])
def test_two_on_a_course_to_meet_pass_at_the_separation(angle_deg: float, *, avoids: bool) -> None:
    """Points that fly as they are told, half a second later; and one that does not avoid at all."""
    angle = math.radians(angle_deg)
    wanted = np.array([[2.0, 0.0], [2.0 * math.cos(angle), 2.0 * math.sin(angle)]])
    places, velocities, nearest_m = -8.0 * wanted, wanted, math.inf
    for _ in range(40):
        offset = np.append(places[1] - places[0], 0.0)
        told = [clear_of(wanted[0], velocities[0], offset[None], velocities[1:], PARAMETERS, 3.0), wanted[1]]
        if avoids:
            told[1] = clear_of(wanted[1], velocities[1], -offset[None], velocities[:1], PARAMETERS, 3.0)
        for _ in range(10):
            places = places + 0.05 * velocities
            nearest_m = min(nearest_m, float(np.linalg.norm(places[0] - places[1])))
        velocities = np.array(told)
    assert nearest_m > (1.4 if avoids else 1.0)
