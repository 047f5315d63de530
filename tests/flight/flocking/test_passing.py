"""Passing: half-planes of optimal reciprocal collision avoidance, by hand and by flying them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from flockd.core.config.flocking import FlockingParameters
from flockd.core.messages import FloatArray
from flockd.flight.flocking import FlockingLaw
from flockd.flight.flocking.passing import Passing
from flockd.flight.safety.half_planes import NO_LIMITS, Limits

pytestmark = pytest.mark.fault("one-that-does-not-avoid")

PARAMETERS = FlockingParameters()
NORTH = np.array([2.0, 0.0])


def passed(
    offset: ArrayLike, theirs: ArrayLike, wanted: FloatArray = NORTH, own: FloatArray | None = None,
    limits: Limits = NO_LIMITS,
) -> FloatArray:  # fmt: skip
    """With one neighbour, met just now by a drone that flies as it wants to, or else at its `own` velocity."""
    law, velocity = FlockingLaw(PARAMETERS), wanted if own is None else own
    return Passing(law, 3.0).clear(wanted, velocity, np.array([offset]), np.array([theirs]), [1], limits)


@pytest.mark.parametrize(
    ("offset", "theirs"),
    [
        ([3.0, 0.0, 0.0], [2.0, 0.0]),  # a mate that flies along
        ([-3.0, 0.0, 0.0], [2.0, 0.0]),
        ([22.0, 0.0, 0.0], [-2.0, 0.0]),  # 20.5 m to the separation at 4 m/s: farther than twice the horizon
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
        velocity, acceleration = Passing(law, 3.0).command(NORTH, offset, theirs[None], NORTH, 0.5, [1])
        of_law = law.command(NORTH, offset[:, :2], theirs[None], NORTH, 0.5)
        assert bool(np.abs(velocity - of_law[0]).max() > 0.1) is passes
        expected = (velocity - NORTH) / 0.5 if passes else of_law[1]
        np.testing.assert_allclose(acceleration, expected)


@pytest.mark.parametrize(("range_m", "share"), [(15.0, 0.5), (6.0, 1.0)])
def test_two_that_meet_head_on_each_turn_to_their_right(range_m: float, share: float) -> None:
    """1.5 m to keep: the cone's side is asin(1.5 / range) off; of 4 m/s its sine is across.

    Half of it is taken while there is time, all of it where the separation is reached within the horizon.
    """
    sine = 1.5 / range_m
    normal = np.array([-sine, math.sqrt(1 - sine**2)])
    np.testing.assert_allclose(passed([range_m, 0.0, 0.0], [-2.0, 0.0]), NORTH + share * 4.0 * sine * normal)
    np.testing.assert_allclose(passed([-range_m, 0.0, 0.0], [2.0, 0.0], -NORTH), -(NORTH + share * 4.0 * sine * normal))


def test_one_that_stays_clear_to_the_left_is_passed_to_the_left() -> None:
    """1 m to the right at 6 m is asin(1.5 / 6.08) - 9.5 = 4.8 degrees into the cone; of 4 m/s times its sine."""
    north_m_s, east_m_s = passed([6.0, 1.0, 0.0], [-2.0, 0.0])
    into = math.asin(1.5 / math.hypot(6.0, 1.0)) - math.atan2(1.0, 6.0)
    assert east_m_s == pytest.approx(-4.0 * math.sin(into) * math.cos(into), rel=0.01)
    assert north_m_s < 2.0


def test_a_side_that_was_taken_stays_while_the_course_is_in_doubt_and_is_forgotten_with_the_neighbour() -> None:
    """One comes at 1.8 m/s, its course now 9 degrees off to one side and now to the other."""
    still, offset = np.array([0.1, 0.0]), np.array([[5.0, 0.0, 0.0]])
    passing, law = Passing(FlockingLaw(PARAMETERS), 3.0), FlockingLaw(PARAMETERS)

    def aside(of: Passing, east_m_s: float, track: int) -> float:
        return float(of.command(still, offset, np.array([[-1.8, east_m_s]]), NORTH, 0.5, [track])[0][1])

    forgetful = [aside(Passing(law, 3.0), east_m_s, 7) for east_m_s in (0.3, -0.3, 0.3)]
    assert [math.copysign(1, one) for one in forgetful] == [-1, 1, -1]
    assert [math.copysign(1, aside(passing, east_m_s, 7)) for east_m_s in (0.3, -0.3, 0.3)] == [-1, -1, -1]
    assert aside(passing, -0.3, 8) > 0, "another one"
    assert aside(passing, -0.3, 7) > 0, "it was away for a step"


def test_for_one_that_comes_by_itself_it_steps_aside_at_once() -> None:
    """12 m away at 3.2 m/s: it is stepped aside for, though a slower approach would do for now, and is none yet."""
    north_m_s, east_m_s = passed([12.0, 0.0, 0.0], [-1.2, 0.0])
    assert east_m_s == pytest.approx(0.5 * 3.2 / 8.0 * math.sqrt(1 - 1 / 64), rel=0.01)
    assert north_m_s > 1.9


@pytest.mark.parametrize(("most_m_s", "east"), [(1.0, 1.0), (0.1, -1.0)])
def test_it_flies_no_faster_to_a_side_than_the_gate_lets_it(most_m_s: float, east: float) -> None:
    """One comes head-on, and it turns to its right, as the rule has it; to its left if the right is blocked."""
    limits = np.array([[0.0, 1.0]]), np.array([most_m_s])
    velocity = passed([6.0, 0.0, 0.0], [-2.0, 0.0], limits=limits)
    assert velocity[1] == pytest.approx(east * math.sqrt(1 - 1 / 16), abs=0.05)  # 4 m/s times the sine, 1.5 m / 6 m


@pytest.mark.parametrize("speed_m_s", [1.0, 2.0])
@pytest.mark.parametrize("offset_deg", [180.0, 150.0])
def test_between_two_that_close_in_it_leaves_to_one_side(offset_deg: float, speed_m_s: float) -> None:
    """Neither avoids. Its right of one is its left of the other: with the usual sides it stayed where both go."""
    passing, angles = Passing(FlockingLaw(PARAMETERS), 3.0), np.radians([0.0, offset_deg])
    velocities = -speed_m_s * np.column_stack([np.cos(angles), np.sin(angles)])
    place, velocity, others, apart_m = np.zeros(2), np.zeros(2), -6.0 * velocities, []
    for _ in range(24):
        offsets = np.column_stack([others - place, np.zeros(2)])
        velocity = passing.clear(np.zeros(2), velocity, offsets, velocities, [1, 2])
        place, others = place + 0.5 * velocity, others + 0.5 * velocities
        apart_m.append(np.hypot(*(others - place).T).min())
    assert min(apart_m) > 1.3


def test_it_does_not_dash_aside_for_a_conflict_that_it_cannot_resolve() -> None:
    """A mate comes from the right, one is faster behind, and the gate blocks the way ahead: seen in a flight by sight,
    which dashed aside at 2 m/s."""
    own, offsets = np.array([0.91, 0.2]), np.array([[-0.67, 1.63, 0.51], [-2.75, -1.49, -0.49]])
    blocked = np.array([[0.895, 0.446], [-0.379, 0.926]]), np.zeros(2)
    passing = Passing(FlockingLaw(PARAMETERS), 3.0)
    velocity = passing.clear(
        np.array([0.89, 0.25]), own, offsets, np.array([[0.83, -0.03], [0.91, 0.34]]), [1, 5], blocked
    )
    assert np.hypot(*velocity) < 1.0
    assert (blocked[0] @ velocity <= 1e-6).all()


@pytest.mark.parametrize("avoids", [True, False])
@pytest.mark.parametrize("angle_deg", [180.0, 135.0, 90.0, 45.0])
def test_two_on_a_course_to_meet_pass_at_the_separation(angle_deg: float, *, avoids: bool) -> None:
    """Points that fly as they are told, half a second later; and one that does not avoid at all."""
    angle = math.radians(angle_deg)
    wanted = np.array([[2.0, 0.0], [2.0 * math.cos(angle), 2.0 * math.sin(angle)]])
    places, velocities, nearest_m = -8.0 * wanted, wanted, math.inf
    for _ in range(40):
        offset = np.append(places[1] - places[0], 0.0)
        told = [passed(offset, velocities[1], wanted[0], velocities[0]), wanted[1]]
        if avoids:
            told[1] = passed(-offset, velocities[0], wanted[1], velocities[1])
        for _ in range(10):
            places = places + 0.05 * velocities
            nearest_m = min(nearest_m, float(np.linalg.norm(places[0] - places[1])))
        velocities = np.array(told)
    assert nearest_m > (1.4 if avoids else 1.0)
