"""The tracker in stories: noise, dropouts, crossings, outliers, false detections, and its own opinion of its errors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from flockd.core.config.safety import GateParameters
from flockd.core.messages import Detection, Neighbour
from flockd.flight.geometry import log_polar, log_polar_covariance, rotation_from_euler
from flockd.flight.safety.approach import towards_neighbours
from flockd.flight.safety.surroundings import surroundings
from flockd.flight.tracking import Measurement, Shown, Tracker, TrackingParameters
from flockd.flight.tracking.manoeuvres import Manoeuvres

Array = NDArray[np.float64]
STEP_S = 0.5
STEADY = 0.3
"""m/s^2, of acceleration: as much at first as later."""
AHEAD = np.array([4.0, 0.0, 0.0])
CRUISE = np.array([1.0, 0.0, 0.0])


def _seen(position: Array, sigma_m: float = 0.05, size_m: float = 0.6) -> Measurement:
    """With the same standard deviation in metres along each axis."""
    bearing, log_range = log_polar(np.asarray(position, dtype=float))
    return Measurement(bearing, log_range, (sigma_m / math.exp(log_range)) ** 2 * np.eye(3), size_m)


def _step(tracker: Tracker, time_s: float, *positions: Array, sigma_m: float = 0.05) -> tuple[int, ...]:
    """One step of an own drone that cruises north at 1 m/s."""
    if time_s > 0:
        tracker.predict(STEP_S, CRUISE * STEP_S)
    return tracker.update(time_s, [_seen(position, sigma_m) for position in positions], CRUISE)


def _confirmed(tracker: Tracker) -> list[Neighbour]:
    return [neighbour for neighbour in tracker.neighbours() if neighbour.confirmed]


def _settled(position: Array = AHEAD, *, steps: int = 10, sigma_m: float = 0.05) -> tuple[Tracker, float]:
    """A tracker that has followed one flock mate at `position`, and the time now, when the start is forgotten."""
    tracker = Tracker(TrackingParameters(first_acceleration_sigma_m_s2=STEADY))
    for step in range(steps):
        _step(tracker, step * STEP_S, position, sigma_m=sigma_m)
    return tracker, (steps - 1) * STEP_S


def _steps_until_confirmed(sigma_m: float, *, beside_sigma_m: float | None) -> int:
    """Of something ahead, beside a neighbour that is confirmed and detected with another standard deviation."""
    tracker, begins = Tracker(TrackingParameters(confirm_hits=3, vague_factor=4.0)), 0
    beside = np.array([0.0, 5.0, 0.0])
    if beside_sigma_m is not None:
        begins = 10
        for k in range(begins):
            _step(tracker, k * STEP_S, beside, sigma_m=beside_sigma_m)
    for k in range(begins, begins + 30):
        tracker.predict(STEP_S, CRUISE * STEP_S)
        known = [] if beside_sigma_m is None else [_seen(beside, beside_sigma_m)]
        tracker.update(k * STEP_S, [*known, _seen(AHEAD, sigma_m)], CRUISE)
        if len(_confirmed(tracker)) == 1 + len(known):
            return k + 1 - begins
    return 30


@pytest.mark.parametrize(
    ("sigma_m", "beside_sigma_m", "steps"),
    [
        pytest.param(0.8, None, 3, id="nothing is known of how certain drones' ranges are"),
        pytest.param(0.8, 1.0, 3, id="as certain as those of another drone, which nobody knows well either"),
        pytest.param(0.05, 0.0625, 3, id="as certain, of known drones"),
        pytest.param(0.8, 0.13, 6, id="8 times less certain: each counts as a half"),
        pytest.param(0.15, 0.0005, 3, id="certain, beside one that a network is too sure of"),
    ],
)
def test_what_is_seen_less_well_than_drones_are_takes_longer_to_be_one(
    sigma_m: float, beside_sigma_m: float | None, steps: int
) -> None:
    """Standard deviations in metres, at 4 m ahead and 5 m beside: of the log range a fourth and a fifth."""
    assert _steps_until_confirmed(sigma_m, beside_sigma_m=beside_sigma_m) == steps


def test_what_the_network_doubts_is_not_confirmed_however_often_it_is_detected() -> None:
    tracker = Tracker(TrackingParameters(drone_probability_memory_s=5.0, confirm_probability=0.9))
    confirmed = []
    for k in range(60):  # average 0.7, then 1 - 0.3 exp(-t / 5 s): above 0.9 from t = 5.5 s on
        tracker.predict(STEP_S, np.zeros(3))
        tracker.update(k * STEP_S, [replace(_seen(AHEAD), drone_probability=0.7 if k < 40 else 1.0)])
        confirmed.append(tracker.neighbours()[0].confirmed)
    first = confirmed.index(True)
    assert 50 <= first <= 53
    assert all(confirmed[first:])


def test_existence_after_a_miss_is_bayes_rule() -> None:
    """By hand: P_D = 0.75, survival 0.5 s of 10 s: p = e^-0.05; missed: p / 4 / (1 - p + p / 4)."""
    tracker = Tracker(TrackingParameters(detection_probability=0.75, survival_time_s=10.0))
    for k in range(20):
        _step(tracker, k * STEP_S, AHEAD)
    _step(tracker, 20 * STEP_S)
    (neighbour,) = tracker.neighbours()
    p = math.exp(-0.05)
    assert neighbour.existence_probability == pytest.approx(p / 4 / (1 - p + p / 4), abs=1e-3)


def test_existence_depends_on_time_and_not_on_the_rate_of_frame_sets() -> None:
    found = []
    for step_s in (0.5, 0.1):
        tracker = Tracker(TrackingParameters())
        for k in range(round(5.0 / step_s)):
            tracker.predict(step_s, np.zeros(3))
            tracker.update(k * step_s, [_seen(AHEAD)])
        start_s = (round(5.0 / step_s) - 1) * step_s
        for k in range(1, round(1.0 / step_s) + 1):
            tracker.predict(step_s, np.zeros(3))
            tracker.update(start_s + k * step_s, [])
        found.append(tracker.neighbours()[0].existence_probability)
    assert found[0] == pytest.approx(found[1], abs=0.05), "but for how often survival is taken in"
    assert found[0] < 0.95


def test_dense_clutter_makes_a_detection_say_less() -> None:
    """The innovation's own density is at most 1 / (2 pi)^2 / 0.09^3 / (0.0125 sqrt(2)) = 1,965."""
    probability = {}
    for density in (1e-3, 1e5):
        tracker = Tracker(TrackingParameters(clutter_density=density, birth_probability=0.5))
        _step(tracker, 0.0, AHEAD)
        _step(tracker, STEP_S, AHEAD)
        probability[density] = tracker.neighbours()[0].existence_probability
    assert probability[1e-3] > 0.99
    assert probability[1e5] < 0.5


def _missed(tracker: Tracker, first: int, last: int, shown: Shown) -> list[float]:
    """The existence probability of the one neighbour after each step without a detection, while it is known."""
    found = []
    for k in range(first, last):
        tracker.predict(STEP_S, CRUISE * STEP_S)
        tracker.update(k * STEP_S, [], CRUISE, shown)
        found += [neighbour.existence_probability for neighbour in tracker.neighbours()]
    return found


@pytest.mark.parametrize("seen_ahead", [True, False])
def test_a_neighbour_out_of_view_is_as_probable_as_before_and_is_remembered(seen_ahead: bool) -> None:
    tracker = Tracker(TrackingParameters(max_unseen_s=1.5, survival_time_s=3600.0))
    for k in range(4):
        _step(tracker, k * STEP_S, AHEAD)
    (before,) = tracker.neighbours()

    def shown(places: Array, radius_m: float) -> NDArray[np.bool_]:
        seen: NDArray[np.bool_] = (places[:, 0] > 0.0) == seen_ahead
        return seen

    found = _missed(tracker, 4, 8, shown)
    if seen_ahead:
        assert len(found) == 3, "after 1.5 s it is gone"
        assert found[2] < found[1] < found[0] < before.existence_probability
    else:
        assert found == pytest.approx([before.existence_probability] * 4, abs=1e-3)
        _step(tracker, 8 * STEP_S, AHEAD)
        (again,) = tracker.neighbours()
        assert again.track == before.track and again.confirmed


def test_who_is_out_of_view_is_forgotten_when_it_should_have_come_back() -> None:
    """Most of its possible places grow to be in view, beyond a border 1 m behind where it was last seen."""
    tracker = Tracker(TrackingParameters(max_unseen_s=1.5, survival_time_s=3600.0))
    for k in range(4):
        _step(tracker, k * STEP_S, AHEAD)

    def shown(places: Array, radius_m: float) -> NDArray[np.bool_]:
        seen: NDArray[np.bool_] = np.abs(places[:, 0] - AHEAD[0]) > 1.0
        return seen

    found = _missed(tracker, 4, 60, shown)
    assert 4 < len(found) < 50
    assert found[-1] < found[0]


def test_one_that_was_never_confirmed_is_not_remembered_out_of_view() -> None:
    tracker = Tracker(TrackingParameters(max_unseen_s=1.5, survival_time_s=3600.0))
    _step(tracker, 0.0, AHEAD)
    assert len(_missed(tracker, 1, 10, lambda places, radius_m: np.zeros(len(places), dtype=np.bool_))) <= 3


def test_a_prediction_is_where_the_flock_mate_flies_to() -> None:
    tracker = Tracker(TrackingParameters(confirm_hits=3))
    for k in range(2):
        _step(tracker, k * STEP_S, AHEAD + np.array((0.1 * k, 0.0, 0.0)), sigma_m=0.01)
    assert tracker.predictions(STEP_S, CRUISE) == ()  # not confirmed yet
    for k in range(2, 20):  # it gains 0.2 m/s on the own drone
        _step(tracker, k * STEP_S, AHEAD + np.array((0.1 * k, 0.0, 0.0)), sigma_m=0.01)
    now = AHEAD + np.array((1.9, 0.0, 0.0))
    (prediction,) = tracker.predictions(1.0, CRUISE)
    np.testing.assert_allclose(prediction.position, now + np.array((0.2, 0.0, 0.0)), atol=0.03)
    assert prediction.size_m == pytest.approx(0.6)
    before = tracker.neighbours()[0]
    assert prediction.covariance.shape == (3, 3)
    assert np.trace(prediction.covariance) > 3 * before.position_sigma_m**2
    assert prediction.existence_probability == pytest.approx(math.exp(-1.0 / 60.0), abs=1e-3)
    (still,) = tracker.predictions(1.0, None)
    np.testing.assert_allclose(still.position, now, atol=0.03)


def test_five_noisy_frames_and_then_a_dropout() -> None:
    rng = np.random.default_rng(1)
    tracker = Tracker(TrackingParameters(max_unseen_s=2.0))
    numbers = {_step(tracker, k * STEP_S, AHEAD + rng.normal(0, 0.05, 3)) for k in range(5)}
    assert len(numbers) == 1
    (neighbour,) = tracker.neighbours()
    assert neighbour.confirmed
    assert (neighbour.hits, neighbour.age_s, neighbour.unseen_s) == (5, 2.0, 0.0)
    np.testing.assert_allclose(neighbour.position, AHEAD, atol=0.15)
    seen_sigma_m = neighbour.position_sigma_m

    for k in range(5, 9):  # unseen for 0.5 ... 2.0 s: it flies on as it flew
        _step(tracker, k * STEP_S)
    (neighbour,) = tracker.neighbours()
    assert neighbour.unseen_s == pytest.approx(2.0)
    assert (neighbour.hits, neighbour.age_s) == (5, 4.0)
    np.testing.assert_allclose(neighbour.position, AHEAD, atol=0.5)
    assert neighbour.position_sigma_m > 4 * seen_sigma_m

    _step(tracker, 9 * STEP_S)
    assert tracker.neighbours() == ()


@pytest.mark.parametrize("steps", [8, 80])
def test_who_was_followed_for_long_is_still_there_after_a_longer_dropout(steps: int) -> None:
    """Two seconds without a detection, then one whose range is 40 % too long: of the mate of 40 s, no stranger."""
    tracker, time_s = _settled(steps=steps)
    for _ in range(4):
        time_s += STEP_S
        _step(tracker, time_s)
    numbers = _step(tracker, time_s + STEP_S, 1.4 * AHEAD, sigma_m=0.3 * float(np.linalg.norm(AHEAD)))
    followed = [one.track for one in tracker.neighbours()]
    assert (numbers == (1,)) == (followed == [1]) == (steps == 80)


def test_a_detection_that_contradicts_a_track_does_not_confirm_it() -> None:
    """A third detection within the gate, at half the size and half the range as the track has it, but not near."""
    tracker = Tracker(TrackingParameters(confirm_hits=3))
    _step(tracker, 0.0, AHEAD, sigma_m=0.5)
    _step(tracker, STEP_S, AHEAD, sigma_m=0.5)
    tracker.predict(STEP_S, CRUISE * STEP_S)
    assert tracker.update(2 * STEP_S, [_seen(0.5 * AHEAD, 0.25, size_m=0.3)], CRUISE) == (1,)
    assert tracker.neighbours()[0].hits == 3
    assert not tracker.neighbours()[0].confirmed
    _step(tracker, 3 * STEP_S, AHEAD, sigma_m=0.5)
    (neighbour,) = _confirmed(tracker)
    assert neighbour.position[0] > 3.0


def test_a_single_detection_is_dropped_after_two_misses_and_two_survive_one_miss() -> None:
    tracker = Tracker(TrackingParameters(birth_probability=0.5, detection_probability=0.7, drop_probability=0.1))
    (first,) = _step(tracker, 0.0, AHEAD)
    _step(tracker, 0.5)  # 0.5 * 0.3 / (0.5 + 0.5 * 0.3) = 0.23
    assert tracker.neighbours()[0].existence_probability == pytest.approx(0.23, abs=0.01)
    _step(tracker, 1.0)  # 0.08
    assert tracker.neighbours() == ()
    (second,) = _step(tracker, 1.5, AHEAD)
    assert second != first  # a number is never given twice
    _step(tracker, 2.0, AHEAD)
    _step(tracker, 2.5)
    assert _step(tracker, 3.0, AHEAD) == (second,)
    assert _confirmed(tracker)


@pytest.mark.fault("false-neighbour")
def test_false_detections_of_one_frame_are_never_confirmed() -> None:
    tracker, now_s = _settled()
    spots = [np.array([x, y, -1.0]) for x in (-9.0, 9.0) for y in (-6.0, 0.0, 6.0)]
    for k in range(60):
        now_s += STEP_S
        _step(tracker, now_s, AHEAD, spots[k % len(spots)])
        assert len(_confirmed(tracker)) == 1
    assert len(tracker.neighbours()) <= 3, "of two frame sets at most"


def test_two_drones_that_cross_at_one_metre_keep_their_numbers() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        tracker = Tracker(TrackingParameters())
        given = []
        for k in range(25):
            along = -6.0 + 0.5 * k  # each at 1 m/s relative to the own drone, opposite ways, 1 m apart when level
            truth = [np.array([along, 4.5, 0.0]), np.array([-along, 5.5, 0.0])]
            shuffled = rng.permutation(2)
            numbers = _step(tracker, k * STEP_S, *(truth[i] + rng.normal(0, 0.05, 3) for i in shuffled))
            given.append([numbers[int(np.flatnonzero(shuffled == i)[0])] for i in range(2)])
        assert np.all(np.array(given) == given[0])


@pytest.mark.fault("false-neighbour")
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sigma_m", [0.05, 0.3])
def test_one_frame_three_metres_off_moves_a_confirmed_track_little(axis: int, sigma_m: float) -> None:
    position = np.array([10.0, 0.0, 0.0])
    tracker, now_s = _settled(position, sigma_m=sigma_m)
    _step(tracker, now_s + STEP_S, position + 3.0 * np.eye(3)[axis], sigma_m=sigma_m)
    assert np.linalg.norm(_confirmed(tracker)[0].position - position) < 0.3
    _step(tracker, now_s + 2 * STEP_S, position, sigma_m=sigma_m)
    (neighbour,) = _confirmed(tracker)
    assert np.linalg.norm(neighbour.position - position) < 0.3


def test_inside_the_gate_an_outlier_moves_a_track_the_less_the_farther_off_it_is() -> None:
    moved_m = []
    for off_m in (1.0, 2.5, 3.0):
        tracker, now_s = _settled(sigma_m=0.7)
        numbers = _step(tracker, now_s + STEP_S, AHEAD + np.array([0.0, off_m, 0.0]), sigma_m=0.7)
        assert numbers == (1,)
        moved_m.append(float(tracker.neighbours()[0].position[1]))
    gain = moved_m[0] / 1.0  # 1 m is honest here: the plain Kalman gain
    assert moved_m[2] < 0.75 * gain * 3.0
    assert moved_m[1] * 2.5 == pytest.approx(moved_m[2] * 3.0, rel=0.02)  # beyond 2.5 sigma it falls as 1 / distance


def _towards(tracker: Tracker) -> float:
    """How fast, m/s, the gate lets the drone fly north, as soon as the neighbours are known."""
    around = surroundings(
        tracker.neighbours(),
        0.1,
        moved=0.1 * CRUISE,
        position=np.zeros(2),
        velocity=CRUISE,
        yaw_rad=0.0,
        height_m=5.0,
        obstacles=np.empty((0, 2)),
    )
    _, most_m_s = towards_neighbours(
        GateParameters(), around.neighbours, around.neighbour_velocities, 1.0, around.neighbour_margins
    )
    return float(most_m_s.min(initial=math.inf))


def test_one_wrong_range_of_a_known_neighbour_does_not_stop_the_drone() -> None:
    """3.4 m instead of 4.2 m, a range of 2 % by its own account: more than six deviations, so that it fits no track."""
    place = np.array([4.2, 0.0, 0.0])
    tracker, now_s = _settled(place, sigma_m=0.06)
    numbers = _step(tracker, now_s + STEP_S, np.array([3.4, 0.0, 0.0]), sigma_m=0.06)
    assert numbers == (2,)
    assert _towards(tracker) > 1.0
    _step(tracker, now_s + 2 * STEP_S, place, sigma_m=0.06)
    assert _towards(tracker) > 1.0


def test_one_false_detection_ahead_slows_for_a_step_and_does_not_stop() -> None:
    """As seen in flight: 5.4 m ahead, once. One that comes at 2 m/s is seen twice, and stops it."""
    ahead, limits_m_s = np.array([5.4, 0.0, 0.0]), []
    for second in ((), (ahead - 1.5 * CRUISE,)):
        tracker, now_s = _settled(np.array([2.5, 4.0, 0.0]))
        _step(tracker, now_s + STEP_S, np.array([2.5, 4.0, 0.0]), ahead, sigma_m=0.15)
        assert 0.3 < _towards(tracker) < 1.0
        _step(tracker, now_s + 2 * STEP_S, np.array([2.5, 4.0, 0.0]), *second, sigma_m=0.15)
        limits_m_s.append(_towards(tracker))
    assert limits_m_s[0] > 1.0
    assert limits_m_s[1] < 0.3


def test_a_stranger_beside_a_known_neighbour_still_slows_at_once() -> None:
    place = np.array([4.2, 0.0, 0.0])
    for both_seen, where in ((True, [3.4, 0.0, 0.0]), (False, [3.4, 0.6, 0.0])):
        tracker, now_s = _settled(place, sigma_m=0.06)
        seen = [np.array(where), place] if both_seen else [np.array(where)]
        _step(tracker, now_s + STEP_S, *seen, sigma_m=0.06)
        assert _towards(tracker) < 0.8


@pytest.mark.parametrize("comes_m_s", [2.0, 0.0])
def test_a_stranger_that_hides_a_known_neighbour_is_believed_in_time(comes_m_s: float) -> None:
    """It came out from behind something in front of the neighbour, hovers or comes: the gate brakes before 1 m."""
    place, stranger_m = np.array([8.0, 0.0, 0.0]), 5.5
    tracker, now_s = _settled(place, sigma_m=0.06)
    for step in range(1, 20):
        _step(tracker, now_s + step * STEP_S, np.array([stranger_m, 0.0, 0.0]), sigma_m=0.06)
        limit_m_s = _towards(tracker)
        if limit_m_s < 0.5:
            break
        stranger_m -= STEP_S * (1.0 + comes_m_s)
    assert stranger_m > 1.0 + 0.5 * (1.0 + comes_m_s)


def test_a_track_follows_a_jump_that_stays() -> None:
    """One bad frame moves nothing, but a lasting 0.45 m, many sigmas off, is believed within 3 s."""
    tracker, now_s = _settled()
    jumped = AHEAD + np.array([0.0, 0.45, 0.0])
    errors_m = []
    for k in range(1, 9):
        _step(tracker, now_s + k * STEP_S, jumped)
        (neighbour,) = tracker.neighbours()
        errors_m.append(np.linalg.norm(neighbour.position - jumped))
    assert errors_m[0] > 0.2
    assert max(errors_m[6:]) < 0.1


def test_the_first_update_is_the_textbook_kalman_filter() -> None:
    """By hand: 0.1 m at first sight, velocity +-0.7 m/s, 1 s on: 0.01 + 0.49 + 0.4^2 * 0.5 / 3 = 0.526667 m^2."""
    tracker = Tracker(
        TrackingParameters(
            acceleration_sigma_m_s2=0.4,
            first_acceleration_sigma_m_s2=0.4,
            size_correlation=1e-6,
            stranger_probability=1e-9,  # the range of a mate alone
        )
    )
    tracker.update(0.0, [_seen(AHEAD, 0.1)], CRUISE)
    tracker.predict(1.0, np.array([0.6, 0.0, 0.0]))
    (before,) = tracker.neighbours()
    np.testing.assert_allclose(before.position, [4.4, 0.0, 0.0])  # 4 + 1 - 0.6
    assert before.position_sigma_m == pytest.approx(math.sqrt(0.526667), rel=1e-5)
    tracker.update(1.0, [_seen(np.array([4.9, 0.0, 0.0]), 0.1)], CRUISE)
    (after,) = tracker.neighbours()
    gain = 0.526667 / 0.536667
    velocity_gain = (0.49 + 0.08 / 2) / 0.536667  # cross covariance: 0.7^2 * 1 s + q / 2
    np.testing.assert_allclose(after.position, [4.4 + 0.5 * gain, 0.0, 0.0], rtol=1e-5)
    np.testing.assert_allclose(after.velocity, [1.0 + 0.5 * velocity_gain, 0.0, 0.0], rtol=1e-4)
    assert after.position_sigma_m == pytest.approx(math.sqrt((1 - gain) * 0.526667), rel=0.01)


def test_prediction_in_two_halves_is_prediction_in_one() -> None:
    whole, halves = _settled()[0], _settled()[0]
    whole.predict(0.5, 0.5 * CRUISE)
    halves.predict(0.2, 0.2 * CRUISE)
    halves.predict(0.3, 0.3 * CRUISE)
    (a,), (b,) = whole.neighbours(), halves.neighbours()
    np.testing.assert_allclose(a.position, b.position, atol=1e-12)
    assert a.position_sigma_m == pytest.approx(b.position_sigma_m)
    assert a.velocity_sigma_m_s == pytest.approx(b.velocity_sigma_m_s)


def test_without_the_own_displacement_tracks_stay_put_and_grow_uncertain() -> None:
    tracker, _ = _settled()
    (before,) = tracker.neighbours()
    tracker.predict(STEP_S, None)
    (after,) = tracker.neighbours()
    np.testing.assert_array_equal(after.position, before.position)
    np.testing.assert_array_equal(after.velocity, before.velocity)
    assert after.position_sigma_m**2 > before.position_sigma_m**2 + (0.7 * STEP_S) ** 2


def test_a_new_track_is_a_flock_mates_or_a_strangers() -> None:
    """A mate at 1 +- 0.7 m/s by 0.8, a stranger at 0 +- 2 m/s by 0.2: north 0.8 m/s, 0.8 * 0.49 + 0.2 * 4 + 0.16.

    Half of the strangers are on a course to meet, and as uncertain across it as a mate.
    """
    tracker = Tracker(TrackingParameters())
    tracker.update(0.0, [_seen(AHEAD)], CRUISE)
    (neighbour,) = tracker.neighbours()
    np.testing.assert_allclose(neighbour.velocity, [0.8, 0.0, 0.0], atol=1e-12)
    north, across = 0.8 * 0.49 + 0.2 * 4.0 + 0.8 * 0.2, 0.9 * 0.49 + 0.1 * 4.0
    assert neighbour.velocity_sigma_m_s == pytest.approx(math.sqrt((north + 2 * across) / 3))
    assert neighbour.possible is not None
    mate, meets, stranger = neighbour.possible
    assert (mate.probability, meets.probability, stranger.probability) == (0.8, 0.1, 0.1)
    assert (mate.closing_sigma_m_s, meets.closing_sigma_m_s, stranger.closing_sigma_m_s) == (0.7, 2.0, 2.0)
    np.testing.assert_array_equal(
        [mate.velocity, meets.velocity, stranger.velocity], [CRUISE, np.zeros(3), np.zeros(3)]
    )


def test_one_on_a_course_to_meet_is_taken_for_no_mate_by_its_constant_bearing() -> None:
    """Two at right angles, 3 m/s each, meet in 7 s: a bearing that does not change, and ranges 20 % uncertain.

    What ranges say of a mate, which would keep its bearing too, is no proof in the first three seconds.
    """
    faster = []
    own = np.array([3.0, 0.0, 0.0])
    covariance = np.diag([0.04, 2.5e-5, 2.5e-5])
    for seed in range(20):
        tracker, rng = Tracker(TrackingParameters()), np.random.default_rng(seed)
        for step in range(7):
            place = (20.0 - 0.5 * step * 3.0 * math.sqrt(2)) * np.array([1.0, -1.0, 0.0]) / math.sqrt(2)
            if step:
                tracker.predict(STEP_S, STEP_S * own, 0.02)
            bearing = place / np.linalg.norm(place)
            frame = np.column_stack([bearing, [bearing[1], -bearing[0], 0.0], [0.0, 0.0, 1.0]])
            log_range = math.log(np.linalg.norm(place)) + 0.2 * rng.normal()
            seen = Measurement(bearing, log_range, frame @ covariance @ frame.T, 0.6)
            tracker.update(0.5 * step, [seen], own)
            (neighbour,) = tracker.neighbours()
            assert neighbour.possible is not None
            comes_m_s = [-bearing @ one.velocity + 2 * one.closing_sigma_m_s for one in neighbour.possible]
            faster.append(max(comes_m_s) < 3.0 / math.sqrt(2))
    assert np.mean(faster) < 0.05


def test_a_track_whose_motions_agree_has_one() -> None:
    tracker, _ = _settled()
    (neighbour,) = tracker.neighbours()
    assert neighbour.possible is not None
    assert [one.probability for one in neighbour.possible] == [1.0]
    assert neighbour.possible[0].range_sigma_m < 3**0.5 * neighbour.position_sigma_m


def test_where_the_own_velocity_is_not_known_all_are_strangers() -> None:
    tracker = Tracker(TrackingParameters())
    tracker.update(0.0, [_seen(AHEAD)], None)
    (neighbour,) = tracker.neighbours()
    np.testing.assert_array_equal(neighbour.velocity, np.zeros(3))
    assert neighbour.velocity_sigma_m_s == pytest.approx(2.0)


@pytest.mark.parametrize("comes_m_s", [-3.0, 0.0, 1.0])
def test_whom_a_track_is_of_is_known_after_a_few_detections(comes_m_s: float) -> None:
    """Head-on at 3 m/s, hovering, or along with the own drone at 1 m/s: 20 m ahead, a detection each half second."""
    tracker = Tracker(TrackingParameters())
    rng = np.random.default_rng(1)
    for step in range(5):
        place = np.array([20.0 + 0.5 * step * (comes_m_s - 1.0), 0.0, 0.0])
        if step:
            tracker.predict(STEP_S, STEP_S * CRUISE, 0.02)
        tracker.update(0.5 * step, [_seen(place * math.exp(0.05 * rng.normal()), 0.05 * place[0])], CRUISE)
    (neighbour,) = tracker.neighbours()
    assert neighbour.confirmed
    assert abs(neighbour.velocity[0] - comes_m_s) < 2.5 * neighbour.velocity_sigma_m_s
    assert neighbour.velocity_sigma_m_s < 1.2


def test_a_measured_velocity_counts_by_its_variance() -> None:
    tracker = Tracker(TrackingParameters(stranger_probability=1e-9))
    measured = replace(_seen(AHEAD), velocity=np.array([1.0, 0.7, 0.0]), velocity_sigma_m_s=math.sqrt(0.49 / 3))
    tracker.update(0.0, [measured], CRUISE)
    (neighbour,) = tracker.neighbours()
    np.testing.assert_allclose(neighbour.velocity, [1.0, 0.7 * 3 / 4, 0.0])  # prior variance 0.49, thrice as large


def test_the_filtered_velocity_beats_differences_on_a_circle() -> None:
    """A flock mate on the paper's circle (10 m, 1 m/s), seen with 3 cm of noise."""
    rng = np.random.default_rng(3)
    times = np.arange(0.0, 60.0, STEP_S)
    course = 0.1 * times
    own = np.column_stack([10 * np.sin(course), 10 - 10 * np.cos(course), np.zeros_like(times)])
    velocity = np.column_stack([np.cos(course), np.sin(course), np.zeros_like(times)])
    tracker = Tracker(TrackingParameters())
    errors: list[list[Array]] = []
    offset = np.array([2.0, 1.5, 0.5])  # both fly the same way: the offset stays
    seen = offset + rng.normal(0, 0.03, (len(times), 3))
    for k, time_s in enumerate(times):
        if k:
            tracker.predict(STEP_S, own[k] - own[k - 1])
        tracker.update(float(time_s), [_seen(seen[k], 0.03)], velocity[k])
        if k >= 10:
            (neighbour,) = tracker.neighbours()
            raw = (own[k] + seen[k] - own[k - 1] - seen[k - 1]) / STEP_S
            errors.append([neighbour.velocity - velocity[k], raw - velocity[k]])
    filtered_m_s, raw_m_s = np.sqrt((np.array(errors) ** 2).sum(axis=2).mean(axis=0))
    assert raw_m_s == pytest.approx(0.03 * math.sqrt(2 * 3) / STEP_S, rel=0.3)
    assert filtered_m_s < 0.9 * raw_m_s


def test_the_filter_knows_its_own_error() -> None:
    """Truth drawn from the filter's own model: the squared error over its variance averages to 1."""
    rng = np.random.default_rng(5)
    parameters = TrackingParameters(first_acceleration_sigma_m_s2=STEADY)
    density = parameters.acceleration_sigma_m_s2**2 * 0.5
    noise = np.linalg.cholesky(density * np.array([[STEP_S**3 / 3, STEP_S**2 / 2], [STEP_S**2 / 2, STEP_S]]))
    position_errors, velocity_errors = [], []
    for _ in range(60):
        tracker = Tracker(parameters)
        position = np.array([8.0, 0.0, 0.0])
        velocity = CRUISE + rng.normal(0, 0.7, 3)
        for k in range(12):
            if k:
                kick = noise @ rng.normal(size=(2, 3))
                position = position + velocity * STEP_S + kick[0] - CRUISE * STEP_S
                velocity = velocity + kick[1]
                tracker.predict(STEP_S, CRUISE * STEP_S + rng.normal(0, 0.02, 3), 0.02)
            tracker.update(k * STEP_S, [_seen(position + rng.normal(0, 0.1, 3), 0.1)], CRUISE)
        neighbour = _confirmed(tracker)[0]
        position_errors.append((neighbour.position - position) / neighbour.position_sigma_m)
        velocity_errors.append((neighbour.velocity - velocity) / neighbour.velocity_sigma_m_s)
    # Mean of 180 squares of a standard normal: 1 +- 0.105; the robust update costs some per cent.
    assert np.mean(np.square(position_errors)) == pytest.approx(1.0, abs=0.3)
    assert np.mean(np.square(velocity_errors)) == pytest.approx(1.0, abs=0.3)


def test_a_wrong_range_moves_a_track_by_the_share_that_its_covariance_says() -> None:
    """Log ranges of 4 m and 4.5 m, equally sure: the mean is halfway in the logarithm, thus sqrt(4 * 4.5)."""
    tracker = Tracker(TrackingParameters(acceleration_sigma_m_s2=1e-6))
    covariance = log_polar_covariance(np.array([1.0, 0.0, 0.0]), 0.2, 0.001)
    ahead = Measurement(np.array([1.0, 0.0, 0.0]), math.log(4.0), covariance, 0.6)
    tracker.update(0.0, [ahead], CRUISE)
    assert tracker.update(1e-6, [replace(ahead, log_range=math.log(4.5))], CRUISE) == (1,)
    np.testing.assert_allclose(tracker.neighbours()[0].position, [math.sqrt(18.0), 0.0, 0.0], rtol=0.02)


def test_a_vague_prediction_ends_at_a_sharp_measurement_far_to_the_side() -> None:
    """A single linearisation at the prediction would leave the circle: 27 degrees to the side are 12 % of the range."""
    tracker = Tracker(TrackingParameters(speed_sigma_m_s=3.0))
    tracker.update(0.0, [_seen(np.array([2.0, 0.0, 0.0]), 0.02)])
    tracker.predict(STEP_S, np.zeros(3))
    moved = 2.0 * np.array([math.cos(0.6), math.sin(0.6), 0.0])
    assert tracker.update(STEP_S, [_seen(moved, 0.02)]) == (1,)
    np.testing.assert_allclose(tracker.neighbours()[0].position, moved, atol=0.01)


def test_assignment_is_the_best_of_all_and_not_the_nearest_pair_first() -> None:
    """Tracks at 0 and 1 m, detections at 0.9 and 2.1 m: the nearest pair first would leave 0 with 2.1."""
    parameters = TrackingParameters(gate_sigma=20.0)
    tracker = Tracker(parameters)
    base = np.array([30.0, 0.0, 0.0])
    east = np.array([0.0, 1.0, 0.0])
    for k in range(4):
        numbers = _step(tracker, k * STEP_S, base, base + 1.0 * east, sigma_m=0.2)
    assert _step(tracker, 4 * STEP_S, base + 0.9 * east, base + 2.1 * east, sigma_m=0.2) == numbers


def test_a_detection_of_another_size_is_of_another_drone() -> None:
    """The range of a drone that is taken for one of half its size is halved; a vague young track would follow it."""
    tracker = Tracker(TrackingParameters())
    for k, sigma_m in enumerate((0.4, 1.0)):
        _step(tracker, k * STEP_S, AHEAD, sigma_m=sigma_m)
    tracker.predict(STEP_S, CRUISE * STEP_S)
    small = _seen(0.5 * AHEAD, 0.1, size_m=0.3)
    assert tracker.update(2 * STEP_S, [small], CRUISE) == (2,)
    assert tracker.update(2 * STEP_S, [replace(small, size_m=0.6)], CRUISE) == (1,), "the same range, the track's size"


def test_the_size_predicted_is_averaged_over_the_detections() -> None:
    """Equally sure: the mean of the logarithms, sqrt(0.5 * 0.7)."""
    tracker = Tracker(TrackingParameters(confirm_hits=2, size_drift=1e-6))
    for k, size_m in enumerate((0.5, 0.7)):
        tracker.predict(STEP_S, CRUISE * STEP_S)
        tracker.update(k * STEP_S, [_seen(AHEAD, 0.2 * 4, size_m)], CRUISE)
    (prediction,) = tracker.predictions(STEP_S, CRUISE)
    assert prediction.size_m == pytest.approx(math.sqrt(0.5 * 0.7), rel=0.01)


def test_a_size_that_was_last_seen_long_ago_counts_little() -> None:
    """After 100 s the log size has drifted by 0.5, and is seen to 0.1: 26 parts of the new to one of the old."""
    tracker = Tracker(TrackingParameters(confirm_hits=2, survival_time_s=3600.0, clutter_density=1e-9))
    tracker.update(0.0, [_seen(AHEAD, 0.4, 0.5)], CRUISE)
    tracker.predict(100.0, 100.0 * CRUISE)
    assert tracker.update(100.0, [_seen(AHEAD, 0.4, 0.7)], CRUISE) == (1,)
    (prediction,) = tracker.predictions(STEP_S, CRUISE)
    assert prediction.size_m == pytest.approx(0.7 * (0.5 / 0.7) ** (1 / 27), rel=0.01)


def test_a_range_is_the_track_s_size_over_the_apparent_size() -> None:
    """Twenty looks tell 0.6 m. A last one takes the drone for one of 0.72 m at 1.2 times its range: it looks as large
    as before, so that it has not moved. Where it looks smaller by as much and of the same size, it has moved."""
    parameters = TrackingParameters(size_correlation=0.999, size_drift=1e-3, relative_speed_sigma_m_s=3.0)
    found = []
    for size_m in (0.72, 0.6):
        tracker = Tracker(parameters)
        for k in range(20):
            _step(tracker, k * STEP_S, AHEAD, sigma_m=0.4)
        tracker.predict(10 * STEP_S, 10 * STEP_S * CRUISE)  # vague by now
        assert tracker.update(20 * STEP_S, [_seen(1.2 * AHEAD, 0.4, size_m)], CRUISE) == (1,)
        found.append(tracker.neighbours()[0].position[0])
    assert found == pytest.approx([4.0, 4.8], abs=0.1)


@pytest.mark.parametrize("sigma", [-0.1, math.nan, math.inf])
def test_a_size_s_sigma_is_a_number(sigma: float) -> None:
    with pytest.raises(ValueError, match="size's sigma"):
        replace(_seen(AHEAD), log_size_sigma=sigma)


def test_a_track_at_the_own_position_is_no_error() -> None:
    tracker = Tracker(TrackingParameters())
    tracker.update(0.0, [_seen(np.array([1.0, 0.0, 0.0]))], np.zeros(3))
    tracker.predict(STEP_S, np.array([1.0, 0.0, 0.0]))
    np.testing.assert_array_equal(tracker.neighbours()[0].position, np.zeros(3))
    tracker.update(STEP_S, [_seen(np.array([0.3, 0.0, 0.0]))], np.zeros(3))
    assert all(np.isfinite(one.position).all() for one in tracker.neighbours())


def test_a_detection_is_turned_into_level_axes() -> None:
    """Nose to the east: what is ahead of the body is east, and its covariance turns with it."""
    detection = Detection(
        bearing=np.array([1.0, 0.0, 0.0]),
        log_range=math.log(5.0),
        covariance=np.diag([0.01, 0.0001, 0.0004]),
        drone_probability=0.9,
        size_m=0.6,
        cameras=("front",),
        label=1,
        log_size_sigma=0.08,
    )
    assert detection.way_sigma_m == pytest.approx(5.0 * 0.1)
    assert detection.range_sigma_m == pytest.approx(5.0 * math.hypot(0.1, 0.08))
    measurement = Measurement.of(detection, rotation_from_euler(0.0, 0.0, math.pi / 2))
    np.testing.assert_allclose(measurement.position, [0.0, 5.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(measurement.covariance, np.diag([0.0001, 0.01, 0.0004]), atol=1e-12)
    assert (measurement.drone_probability, measurement.size_m, measurement.log_size_sigma) == (0.9, 0.6, 0.08)


def test_a_position_is_measured_in_range_and_bearing() -> None:
    """5 m to the east: 10 cm are 2 % of the range, whose logarithm they move by 0.02."""
    east = np.array([0.0, 5.0, 0.0])
    measurement = Measurement.of_position(east, range_sigma_m=0.1, bearing_sigma_rad=0.01, size_m=0.6)
    np.testing.assert_allclose(measurement.position, east, atol=1e-12)
    np.testing.assert_allclose(measurement.covariance, np.diag([0.0001, 0.0004, 0.0001]), atol=1e-12)
    assert (measurement.size_m, measurement.drone_probability) == (0.6, 1.0)
    with pytest.raises(ValueError, match="no bearing"):
        Measurement.of_position(np.zeros(3), range_sigma_m=0.1, bearing_sigma_rad=0.01, size_m=0.6)


def test_probabilities_that_do_not_increase_are_refused() -> None:
    with pytest.raises(ValueError, match="keep_probability"):
        TrackingParameters(keep_probability=0.9, confirm_probability=0.8)


def test_a_measurement_that_is_no_number_is_refused() -> None:
    good = {"bearing": np.array([1.0, 0.0, 0.0]), "log_range": 1.0, "covariance": np.eye(3), "size_m": 0.6}
    for bad, reason in (
        ({"bearing": np.array([np.nan, 0, 0])}, "bearing"),
        ({"bearing": np.array([2.0, 0, 0])}, "bearing"),
        ({"log_range": math.inf}, "log range"),
        ({"covariance": np.full((3, 3), np.inf)}, "covariance"),
        ({"size_m": 0.0}, "size"),
        ({"drone_probability": 1.2}, "probability"),
        ({"velocity": np.array([np.nan, 0, 0])}, "velocity"),
        ({"velocity_sigma_m_s": 0.0}, "sigma"),
    ):
        with pytest.raises(ValueError, match=reason):
            Measurement(**{**good, **bad})  # type: ignore[arg-type]


def test_a_drone_that_turns_out_larger_is_farther_and_faster_in_proportion() -> None:
    """0.9 m instead of 0.6: half as far again, and so its velocity relative to the own one; the bearing stays."""
    tracker = Tracker(TrackingParameters())
    for step in range(20):
        _step(tracker, step * STEP_S, AHEAD + 0.2 * step * STEP_S * np.array([0.0, 1.0, 0.0]))
    (before,) = tracker.neighbours()
    tracker.resize(0.5, 1.0, CRUISE)
    assert tracker.neighbours()[0].position.tolist() == before.position.tolist(), "it is none of those"
    tracker.resize(0.9, 0.6, CRUISE)
    (after,) = tracker.neighbours()
    assert after.position == pytest.approx(1.5 * before.position, rel=0.01)
    assert after.velocity - CRUISE == pytest.approx(1.5 * (before.velocity - CRUISE), abs=0.01)
    assert after.position_sigma_m == pytest.approx(1.5 * before.position_sigma_m, rel=0.05)
    (prediction,) = tracker.predictions(STEP_S, CRUISE)
    assert prediction.size_m == pytest.approx(0.9)


@pytest.mark.parametrize("step_s", [0.5, 0.1])
@pytest.mark.parametrize("hits", [1, 2, 3])
def test_the_parameters_say_with_which_step_a_neighbour_is_confirmed(step_s: float, hits: int) -> None:
    tracker, k = Tracker(TrackingParameters(confirm_hits=hits)), 0
    while not _confirmed(tracker) and k < 50:
        if k:
            tracker.predict(step_s, CRUISE * step_s)
        tracker.update(k * step_s, [_seen(AHEAD)], CRUISE)
        k += 1
    assert k >= tracker.parameters.confirm_steps(step_s) == {0.5: hits, 0.1: 1 + 5 * (hits - 1)}[step_s]
    assert k <= tracker.parameters.confirm_steps(step_s) + 1


# Neighbours are taken to manoeuvre as hard as the own drone does, and are followed in gusts.


LEAST = 0.3**2 * 0.5
CALM = TrackingParameters(first_acceleration_sigma_m_s2=0.3)
"""Nothing is left of the start."""
SUBSTEPS = 50


def _ways(density: float, steps: int, seed: int) -> Array:
    """(steps, 3) m in each step of a body that white noise of this density accelerates to the north and to the east."""
    dt = STEP_S / SUBSTEPS
    kicks = np.random.default_rng(seed).normal(0.0, math.sqrt(density * dt), (steps * SUBSTEPS, 2))
    ways: Array = (np.cumsum(kicks, axis=0) * dt).reshape(steps, SUBSTEPS, 2).sum(axis=1)
    return np.column_stack([ways, np.zeros(steps)])


def test_steady_flight_has_the_density_of_the_parameters() -> None:
    manoeuvres = Manoeuvres(TrackingParameters())
    for _ in range(20):
        manoeuvres.see(np.array([0.5, 0.1, 0.0]), 0.0, STEP_S)
    np.testing.assert_allclose(manoeuvres.density, LEAST)


def test_the_start_is_wild_until_the_own_motion_says_otherwise() -> None:
    """0.8 m/s^2 for 0.5 s at first; steady flight is told from it after some of the 3 s of memory."""
    manoeuvres = Manoeuvres(TrackingParameters(first_acceleration_sigma_m_s2=0.8, own_manoeuvre_memory_s=3.0))
    assert manoeuvres.density[0] == pytest.approx(0.32)
    for _ in range(9):
        manoeuvres.see(np.array([0.5, 0.1, 0.0]), 0.0, STEP_S)
    assert manoeuvres.density[0] == pytest.approx(0.32 * math.exp(-8 * STEP_S / 3.0))


@pytest.mark.parametrize("density", [0.1, 1.0])
def test_white_noise_is_found_again(density: float) -> None:
    manoeuvres = Manoeuvres(TrackingParameters(own_manoeuvre_memory_s=500.0))
    for way in _ways(density, 10_000, seed=1):
        manoeuvres.see(way, 0.0, STEP_S)
    north, east, down = manoeuvres.density
    assert north == east == pytest.approx(density, rel=0.15)
    assert down == LEAST


def test_errors_of_the_own_motion_are_no_manoeuvres() -> None:
    """A drone that stands still, with displacements that err by 2 cm in steps of 0.1 s."""
    manoeuvres = Manoeuvres(TrackingParameters(own_manoeuvre_memory_s=500.0))
    for error in np.random.default_rng(3).normal(0.0, 0.02, (20_000, 3)):
        manoeuvres.see(error, 0.02, 0.1)
    np.testing.assert_allclose(manoeuvres.density, LEAST, atol=0.03)


def test_two_frame_sets_at_nearly_the_same_time_are_no_manoeuvre() -> None:
    """Steady flight at 1 m/s; one step takes 2 ms, in which an error of 2 cm would be 10 m/s."""
    manoeuvres = Manoeuvres(CALM)
    for _ in range(5):
        manoeuvres.see(np.array([0.5, 0.0, 0.0]), 0.02, STEP_S)
    manoeuvres.see(np.array([0.022, 0.0, 0.0]), 0.02, 0.002)
    manoeuvres.see(np.array([0.5, 0.0, 0.0]), 0.02, STEP_S)
    np.testing.assert_allclose(manoeuvres.density, LEAST)


def test_it_is_forgotten_in_calm_air() -> None:
    manoeuvres = Manoeuvres(TrackingParameters())
    ways = _ways(1.0, 20, seed=2)
    for way in ways:
        manoeuvres.see(way, 0.0, STEP_S)
    gusty = manoeuvres.density[0]
    for _ in range(6):
        manoeuvres.see(ways[-1], 0.0, STEP_S)
    assert gusty > 0.3
    assert manoeuvres.density[0] == pytest.approx(gusty * math.exp(-1))  # 6 steps of 0.5 s, 3 s of memory


def test_an_unknown_motion_is_no_manoeuvre() -> None:
    manoeuvres = Manoeuvres(CALM)
    manoeuvres.see(np.array([2.0, 0.0, 0.0]), 0.0, STEP_S)
    manoeuvres.see(None, 0.0, STEP_S)
    manoeuvres.see(np.zeros(3), 0.0, STEP_S)
    np.testing.assert_allclose(manoeuvres.density, LEAST)


def test_the_tracker_knows_its_errors_in_gusts() -> None:
    """Both drones fly in gusts; the squared error over the filter's variance has a mean of about 1 an axis."""
    ratios: list[float] = []
    for seed in range(10):
        own, other = _ways(1.0, 60, 2 * seed), _ways(1.0, 60, 2 * seed + 1)
        noise = np.random.default_rng([seed, 5]).normal(0.0, 0.05, (60, 3))
        tracker, place = Tracker(TrackingParameters(max_unseen_s=30.0)), np.array([400.0, 0.0, 0.0])
        for step in range(60):
            if step:
                tracker.predict(STEP_S, own[step])
                place = place + other[step] - own[step]
            bearing, log_range = log_polar(place + noise[step])
            covariance = (0.05 / math.exp(log_range)) ** 2 * np.eye(3)
            tracker.update(step * STEP_S, [Measurement(bearing, log_range, covariance, 0.6)], own[step] / STEP_S)
            if step > 10:
                track = max(tracker.neighbours(), key=lambda one: one.hits)
                error = track.position[:2] - place[:2]
                ratios.append(float(error @ error) / 2 / track.position_sigma_m**2)
    assert 0.3 < np.mean(ratios) < 2.0


def test_one_lie_of_the_own_motion_changes_no_track() -> None:
    """In one of twenty steps the own motion is a metre off; both neighbours keep their tracks and places."""
    random = np.random.default_rng(0)
    places = np.array([[4.0, 0.0, 0.0], [3.0, 2.0, 0.3]])
    tracker = Tracker(TrackingParameters())
    numbers = []
    for step in range(20):
        if step:
            tracker.predict(STEP_S, np.array([0.5, 1.0 if step == 12 else 0.0, 0.0]), 0.02)
        seen = [log_polar(place + random.normal(0.0, 0.05, 3)) for place in places]
        numbers.append(
            tracker.update(
                step * STEP_S,
                [Measurement(at, log_m, (0.05 / math.exp(log_m)) ** 2 * np.eye(3), 0.6) for at, log_m in seen],
                np.array([1.0, 0.0, 0.0]),
            )
        )
    assert set(numbers) == {(1, 2)}
    np.testing.assert_allclose([one.position for one in tracker.neighbours()], places, atol=0.2)
