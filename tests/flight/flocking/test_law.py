"""The flocking law against figures worked out by hand from Eq. 38-43 and against the flock it must form."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flockd.core.config.flocking import FlockingParameters, WeightParameters
from flockd.core.config.mission import MissionParameters
from flockd.flight.flocking.law import FlockingLaw, level_offsets
from flockd.flight.mission.circle_then_tangent import course, desired_velocity
from flockd.review.metrics import min_distance, obj1, obj2, pair_distances

Array = NDArray[np.float64]
NOBODY = np.empty((0, 2))
STILL = np.zeros(2)
ALL_OFF = FlockingParameters(cohesion=0.0, alignment=0.0, separation=0.0, velocity=0.0)

TABLE_1 = np.array([[-0.5, 0.9], [0.5, -2.8], [1.2, 4.5], [3.9, 0.5], [4.5, 1.4]])


def _law(**changes: float | None) -> FlockingLaw:
    """Nothing acts but what is named here."""
    return FlockingLaw(ALL_OFF.model_copy(update=changes))


def _flight(law: FlockingLaw, start: Array, *, duration_s: float, step_s: float = 0.5) -> list[tuple[Array, Array]]:
    """Eq. 38-43 with exact states, everybody at once: position by the new velocity."""
    positions, velocities, states = start.copy(), np.tile([1.0, 0.0], (len(start), 1)), []
    for step in range(round(duration_s / step_s)):
        efv = desired_velocity(MissionParameters(), step * step_s)
        others = [np.arange(len(start)) != i for i in range(len(start))]
        accelerations = [
            law.acceleration(velocities[i], positions[of] - positions[i], velocities[of], efv)
            for i, of in enumerate(others)
        ]
        velocities = velocities + np.array(accelerations) * step_s
        positions = positions + velocities * step_s
        states.append((positions, velocities))
    return states


@pytest.mark.parametrize(
    ("own", "offsets", "theirs", "desired", "changes", "expected"),
    [
        pytest.param([0.2, -0.3], NOBODY, NOBODY, [1.0, 0.5], {"velocity": 1.0}, [0.8, 0.8], id="efv - V"),
        # 0.1 * 7 * ln(7 / 3.5) = 0.7 ln 2 towards it, 0 for the one at 3.5 m
        pytest.param(
            STILL, [[0.0, 7.0], [3.5, 0.0]], np.zeros((2, 2)), STILL, {"cohesion": 0.1}, [0.0, 0.7 * math.log(2)],
            id="cohesion pulls and is nothing at the desired distance",
        ),
        # 0.1 * 1.75 * ln(1/2), away
        pytest.param(
            STILL, [[0.0, 1.75]], [[0.0, 0.0]], STILL, {"cohesion": 0.1}, [0.0, -0.175 * math.log(2)],
            id="cohesion pushes",
        ),
        # the -1 is -V of Eq. 38
        pytest.param(
            [1.0, 0.0], [[5.0, 0.0], [0.0, 5.0]], [[2.0, 1.0], [1.0, -3.0]], STILL, {"alignment": 0.1},
            [0.1 * (1 + 0) - 1.0, 0.1 * (1 - 3)], id="alignment sums the differences of velocities",
        ),
        # d = 0.5: 10 * (1/0.5 - 1/1.5)^2 = 10 * (4/3)^2 = 17.78, along (-3, -4)/5
        pytest.param(
            STILL, [[0.3, 0.4]], [[0.0, 0.0]], STILL, {"separation": 10.0}, [-160 / 9 * 0.6, -160 / 9 * 0.8],
            id="separation pushes inside its distance",
        ),
        pytest.param(STILL, [[1.5, 0.0]], [[0.0, 0.0]], STILL, {"separation": 10.0}, STILL, id="and not at it"),
        pytest.param(
            STILL, NOBODY, NOBODY, [1.0, -1.0], {"velocity": 2.0, "own_weight": 1.5}, [3.0, -3.0], id="own weight"
        ),
    ],
)  # fmt: skip
def test_each_part_of_the_law_is_as_worked_out_by_hand(
    own: Array, offsets: Array, theirs: Array, desired: Array, changes: dict[str, float], expected: Array
) -> None:
    found = _law(**changes).acceleration(own, offsets, theirs, desired)
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_the_pull_of_who_is_new_grows_slowly_and_its_push_is_whole_at_once() -> None:
    law = _law(cohesion=0.1, alignment=0.1, separation=10.0, cohesion_time_s=5.0)
    of_paper = FlockingLaw(law.parameters.model_copy(update={"cohesion_time_s": None}))
    far, theirs, whole = [[0.0, 7.0]], [[0.5, 0.0]], 0.7 * math.log(2)  # 0.485 m/s^2

    def pull(law: FlockingLaw, age_s: float) -> Array:
        return law.acceleration(STILL, far, theirs, STILL, [age_s])

    np.testing.assert_array_equal(pull(law, 0.0), [0.05, 0.0])
    np.testing.assert_allclose(pull(law, 2.0), [0.05, 0.32])  # 2 (2 / 5)^2
    for followed in (
        pull(law, 5.0),
        pull(law, math.inf),
        pull(of_paper, 0.0),
        law.acceleration(STILL, far, theirs, STILL),
    ):
        np.testing.assert_allclose(followed, [0.05, whole])
    near = [[0.0, 1.0]]
    pushed = of_paper.acceleration(STILL, near, STILL[None], STILL)
    np.testing.assert_allclose(law.acceleration(STILL, near, STILL[None], STILL, [0.0]), pushed)


def test_separation_heeds_everybody_though_only_the_nearest_have_weight() -> None:
    ring = [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.2]]
    law = FlockingLaw(FlockingParameters(alignment=0.0, weight=WeightParameters(kind="nearest", nearest=2)))
    u = law.acceleration(STILL, ring, np.zeros((3, 2)), STILL)
    # The third one's share: 10 * (1/1.2 - 1/1.5)^2 = 10 / 36, to the west; its cohesion counts for nothing.
    np.testing.assert_allclose(u, [0.0, -10 / 36], atol=1e-14)


def test_shorter_steps_than_the_papers_ask_for_the_same_velocity_and_longer_ones_for_more() -> None:
    """An error of the own velocity shifts the flight by where u st cancels it: by ten times as much at st = 0.05 s."""
    law = FlockingLaw(FlockingParameters(max_speed_m_s=9.0))
    asked = {step: law.command([0.2, 0.0], NOBODY, NOBODY, [1.0, 0.5], step)[0] for step in (0.05, 0.1, 0.5, 1.0)}
    np.testing.assert_allclose(asked[0.5], [0.2 + 0.8 * 0.5, 0.5 * 0.5])
    assert np.array_equal(asked[0.05], asked[0.5])
    assert np.array_equal(asked[0.1], asked[0.5])
    np.testing.assert_allclose(asked[1.0], [1.0, 0.5])


def test_a_neighbour_exactly_below_pushes_south_and_nothing_overflows() -> None:
    law = FlockingLaw()
    for tiny in (0.0, 1e-300, 1e-9, 1e-3):
        velocity, acceleration = law.command(STILL, [[tiny, 0.0]], np.zeros((1, 2)), STILL, 0.5)
        np.testing.assert_allclose(acceleration, [-2.0, 0.0])
        np.testing.assert_allclose(velocity, [-1.0, 0.0])
    assert np.isfinite(law.acceleration(STILL, [[1e308, 1e308]], np.zeros((1, 2)), STILL)).all()


@pytest.mark.fault("one-spot")
@pytest.mark.parametrize("noise_m", [0.0, 1e-163, 0.02])
def test_two_drones_at_one_level_spot_part_each_to_its_own_right(noise_m: float) -> None:
    """One 0.8 m above the other, both on the same course: they come apart by the separation distance of 1.5 m."""
    law, rng = FlockingLaw(), np.random.default_rng(1)
    places, velocities = np.array([[0.0, 0.0, -5.8], [0.0, 0.0, -5.0]]), np.tile([1.0, 0.0], (2, 1))
    for _ in range(20):
        noise = noise_m * np.array([1.0, 1.0, 0.0]) * rng.normal(size=(2, 1))
        seen = np.array([places[1] - places[0], places[0] - places[1]]) + noise
        told = [
            law.command(velocities[i], level_offsets(seen[i : i + 1]), velocities[[1 - i]], [1.0, 0.0], 0.5)[0]
            for i in range(2)
        ]
        velocities = np.array(told)
        places[:, :2] += 0.5 * velocities
    above, below = places[:, 1]
    assert above > 0.5 > -0.5 > below  # looking down with north overhead, east is at the right; looking up, west
    assert np.linalg.norm(places[0, :2] - places[1, :2]) > 1.5


@pytest.mark.parametrize(
    ("own", "desired", "velocity", "acceleration"),
    [
        ([0.0, 0.0], [30.0, 40.0], [0.6, 0.8], [1.2, 1.6]),
        ([3.0, 0.0], [30.0, 0.0], [3.0, 0.0], [2.0, 0.0]),
        ([1.0, 0.0], [1.4, 0.2], [1.2, 0.1], [0.4, 0.2]),
    ],
)
def test_the_command_limits_first_the_acceleration_and_then_the_speed(
    own: Array, desired: Array, velocity: Array, acceleration: Array
) -> None:
    law = FlockingLaw(FlockingParameters(max_acceleration_m_s2=2.0, max_speed_m_s=3.0))
    np.testing.assert_allclose(law.command(own, NOBODY, NOBODY, desired, 0.5), (velocity, acceleration))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"velocity": [0.0, np.nan]}, "own velocity"),
        ({"velocity": [0.0, 0.0, 0.0]}, "own velocity .*shape"),
        ({"positions": [[1.0, np.inf]]}, "positions"),
        ({"positions": [[1.0, 2.0, 3.0]]}, "positions .*shape"),
        ({"velocities": [[0.0, np.nan]]}, "velocities"),
        ({"velocities": NOBODY}, "velocities .*shape"),
        ({"desired_velocity": [np.nan, 0.0]}, "desired velocity"),
    ],
)
def test_bad_input_is_refused_with_the_reason(changes: dict[str, Array], reason: str) -> None:
    good: dict[str, Any] = {"velocity": STILL, "positions": [[1.0, 2.0]], "velocities": [[0.0, 0.0]]}
    with pytest.raises(ValueError, match=reason):
        FlockingLaw().acceleration(**{**good, "desired_velocity": STILL, **changes})


@pytest.mark.parametrize("step_s", [0.0, -0.5, math.nan, math.inf])
def test_a_step_that_is_no_step_is_refused(step_s: float) -> None:
    with pytest.raises(ValueError, match="step"):
        FlockingLaw().command(STILL, NOBODY, NOBODY, [1.0, 0.0], step_s)


def test_the_desired_velocity_goes_round_at_a_tenth_of_a_radian_a_second_until_66_s() -> None:
    parameters = MissionParameters()
    np.testing.assert_allclose(desired_velocity(parameters, 0.0), [1.0, 0.0])
    np.testing.assert_allclose(desired_velocity(parameters, 5 * math.pi), [0.0, 1.0], atol=1e-12)  # east: clockwise
    assert course(parameters, 30.0) == pytest.approx(3.0)
    assert course(parameters, 66.0) == pytest.approx(6.6 - 2 * math.pi)
    assert course(parameters, 109.5) == course(parameters, 66.0)
    twice = MissionParameters(speed_m_s=2.0, radius_m=5.0)
    assert course(twice, 1.0) == pytest.approx(0.4)
    np.testing.assert_allclose(np.linalg.norm(desired_velocity(twice, 1.0)), 2.0)
    for nonsense in (-0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match="time"):
            course(parameters, nonsense)


def test_five_from_table_1_become_the_pentagon() -> None:
    """The reading notes' own figures: sides 2.47 m, diagonals 4.00 m, obj1 2e-5, obj2 15.2707 with 4e-5 of jitter."""
    parameters = FlockingParameters()
    states = _flight(FlockingLaw(parameters), TABLE_1, duration_s=110.0)
    positions, _ = states[-1]
    distances = np.sort(pair_distances(positions)[np.triu_indices(5, 1)])
    np.testing.assert_allclose(distances[:5], 2.47, atol=0.005)
    np.testing.assert_allclose(distances[5:], 4.00, atol=0.005)
    efv = desired_velocity(MissionParameters(), 110.0)
    tail = states[-20:]
    sums_1 = np.array([obj1(v, efv, circling=False).sum() for _, v in tail])
    sums_2 = np.array([obj2(p, v, parameters).sum() for p, v in tail])
    assert sums_1.max() < 1e-4
    assert sums_2.mean() == pytest.approx(15.2707, abs=2e-4)
    assert np.ptp(sums_2) < 2e-4


def test_twenty_stay_apart_with_weight_on_three_and_crowd_with_weight_on_all() -> None:
    grid = 4.0 * np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1).reshape(-1, 2)
    start = grid + np.random.default_rng(4).normal(0, 0.3, (20, 2))

    def apart(**weight: Any) -> list[float]:
        law = FlockingLaw(FlockingParameters(weight=WeightParameters(**weight)))
        return [min_distance(positions) for positions, _ in _flight(law, start, duration_s=60.0)]

    assert min(apart(kind="nearest", nearest=3)) > 1.5
    assert max(apart(kind="uniform")[60:]) < 1.5  # held apart by Eq. 41 alone
