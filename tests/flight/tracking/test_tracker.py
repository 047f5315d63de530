"""The tracker in stories: noise, dropouts, crossings, outliers, false detections, and its own opinion of its errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from flockd.core.config.safety import GateParameters
from flockd.core.messages import Neighbour
from flockd.flight.geometry import log_polar, log_polar_covariance, rotation_from_euler
from flockd.flight.safety.approach import towards_flying_on
from flockd.flight.safety.surroundings import surroundings
from flockd.flight.tracking import Measurement, Shown, Tracker, TrackingParameters
from tests.make import detection

Array = NDArray[np.float64]
STEP_S = 0.5
AHEAD = np.array([4.0, 0.0, 0.0])
CRUISE = np.array([1.0, 0.0, 0.0])
EAST = np.array([0.0, 1.0, 0.0])


def _seen(position: Array, sigma_m: float = 0.05, size_m: float = 0.6) -> Measurement:
    """With the same standard deviation in metres along each axis."""
    bearing, log_range = log_polar(np.asarray(position, dtype=float))
    return Measurement(bearing, log_range, (sigma_m / math.exp(log_range)) ** 2 * np.eye(3), size_m)


def _lasting(rng: np.random.Generator, count: int, step_s: float) -> Array:
    """(count,) errors of ranges, in standard deviations, of which three quarters of the variance last for 1.5 s."""
    keep = math.exp(-step_s / 1.5)
    lasting = [rng.normal()]
    while len(lasting) < count:
        lasting.append(keep * lasting[-1] + math.sqrt(1.0 - keep**2) * rng.normal())
    errors: Array = math.sqrt(0.75) * np.array(lasting) + 0.5 * rng.normal(size=count)
    return errors


class Follower:
    """A tracker of an own drone that cruises north at 1 m/s by a true heading, and its clock."""

    def __init__(self, **parameters: Any) -> None:
        gate = GateParameters(max_acceleration_m_s2=parameters.pop("max_acceleration_m_s2", 5.0))
        tracking = TrackingParameters(**{"heading_sigma_rad": 0.0, **parameters})
        self.tracker, self.time_s = Tracker(tracking, gate), -math.inf

    def step(
        self,
        *seen: Array | Measurement,
        sigma_m: float = 0.05,
        after_s: float = STEP_S,
        own: Array | None = CRUISE,
        moved_sigma_m: float = 0.0,
        shown: Shown | None = None,
    ) -> tuple[int, ...]:
        """One frame set with what is seen there; the first one at time 0."""
        if self.time_s >= 0:
            self.tracker.predict(after_s, None if own is None else own * after_s, moved_sigma_m)
        self.time_s = max(self.time_s + after_s, 0.0)
        measured = [one if isinstance(one, Measurement) else _seen(one, sigma_m) for one in seen]
        return self.tracker.update(self.time_s, measured, own, shown)

    def steps(self, count: int, *seen: Array | Measurement, **how: Any) -> Follower:
        for _ in range(count):
            self.step(*seen, **how)
        return self

    @property
    def all(self) -> tuple[Neighbour, ...]:
        return self.tracker.neighbours()

    @property
    def one(self) -> Neighbour:
        (neighbour,) = self.all
        return neighbour

    @property
    def confirmed(self) -> list[Neighbour]:
        return [neighbour for neighbour in self.all if neighbour.confirmed]

    @property
    def off(self) -> float:
        """Metres, of the one from where it is ahead."""
        return float(np.linalg.norm(self.one.position - AHEAD))

    def fastest(self) -> float:
        """How fast, m/s, the gate lets the drone fly towards anybody as soon as the neighbours are known."""
        near = surroundings(
            self.all, 0.1, moved=0.1 * CRUISE, position=np.zeros(2), velocity=CRUISE, yaw_rad=0.0, height_m=5.0,
            obstacles=np.empty((0, 2)), seen_m=None,
        )  # fmt: skip
        flies_on = near.neighbours, near.neighbour_velocities, 1.0, near.neighbour_margins
        return float(towards_flying_on(GateParameters(), *flies_on)[1].min(initial=math.inf))


def _settled(position: Array = AHEAD, *, steps: int = 10, sigma_m: float = 0.05) -> Follower:
    """One flock mate at `position` has been followed for some time."""
    return Follower().steps(steps, position, sigma_m=sigma_m)


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
    flock = Follower(confirm_hits=3, vague_factor=4.0)
    known = [] if beside_sigma_m is None else [_seen(5.0 * EAST, beside_sigma_m)]
    flock.steps(10 * len(known), *known)
    taken = 0
    while len(flock.confirmed) < 1 + len(known) and taken < 30:
        flock.step(*known, _seen(AHEAD, sigma_m))
        taken += 1
    assert taken == steps


def test_what_the_network_doubts_is_not_confirmed_however_often_it_is_detected() -> None:
    """Log odds of 0.85 for 20 s, then 4.6 - 3.75 exp(-t / 5 s): above 2.2, which are 0.9, from t = 2.2 s on."""
    flock, confirmed = Follower(drone_probability_memory_s=5.0, confirm_probability=0.9), []
    for k in range(60):
        flock.step(replace(_seen(AHEAD), drone_probability=0.7 if k < 40 else 0.99))
        confirmed.append(flock.one.confirmed)
    first = confirmed.index(True)
    assert 44 <= first <= 46
    assert all(confirmed[first:])


@pytest.mark.parametrize(("probability", "existence"), [(1.0, 0.5), (0.95, 0.5), (0.8, 0.25), (0.75, 0.2)])
def test_a_doubtful_detection_begins_a_less_likely_track(probability: float, existence: float) -> None:
    """By hand: 12 to 1 confirms; 4 to 1 is a third of that, 3 to 1 a quarter, and so are the odds of existence."""
    flock = Follower(confirm_probability=12 / 13).steps(1, replace(_seen(AHEAD), drone_probability=probability))
    assert flock.one.existence_probability == pytest.approx(existence * probability)


@pytest.mark.fault("vague-detections")
def test_beside_well_known_drones_a_vague_detection_is_less_likely_a_drone_and_slows_less() -> None:
    """By hand: a range sigma of 20 % is 8 times twice the usual 1.25 %, so the odds of existence begin at an eighth. A
    shadow is detected again and again, as a drone is, and is not confirmed for it."""
    mate, vague = _seen(5.0 * EAST, 0.0625), _seen(AHEAD, 0.8)
    alone, beside = Follower().steps(1, vague), Follower().steps(10, mate).steps(1, mate, vague)
    assert [flock.all[-1].existence_probability for flock in (alone, beside)] == pytest.approx([1 / 2, 1 / 9], rel=1e-3)
    assert beside.fastest() > alone.fastest()
    alone.steps(20, vague)
    beside.steps(20, mate, vague)
    assert [len(flock.confirmed) for flock in (alone, beside)] == [1, 1]


def test_existence_after_a_miss_is_bayes_rule() -> None:
    """By hand: P_D = 0.75, survival 0.5 s of 10 s: p = e^-0.05; missed: p / 4 / (1 - p + p / 4)."""
    flock = Follower(detection_probability=0.75, survival_time_s=10.0).steps(20, AHEAD).steps(1)
    p = math.exp(-0.05)
    assert flock.one.existence_probability == pytest.approx(p / 4 / (1 - p + p / 4), abs=1e-3)


def _where(is_shown: Callable[[Array], NDArray[np.bool_]]) -> Shown:
    """What cameras show, by metres to the north."""
    return lambda places, radius_m: is_shown(places[:, 0])


def _missed(flock: Follower, count: int, shown: Shown) -> list[float]:
    """The existence probability of the one neighbour after each step without a detection, while it is known."""
    return [one.existence_probability for _ in range(count) for one in flock.steps(1, shown=shown).all]


@pytest.mark.parametrize("seen_ahead", [True, False])
def test_a_neighbour_out_of_view_is_as_probable_as_before_and_is_remembered(seen_ahead: bool) -> None:
    flock = Follower(max_unseen_s=1.5, survival_time_s=3600.0).steps(4, AHEAD)
    before = flock.one
    found = _missed(flock, 4, _where(lambda north: (north > 0.0) == seen_ahead))
    if seen_ahead:
        assert len(found) == 3, "after 1.5 s it is gone"
        assert found[2] < found[1] < found[0] < before.existence_probability
    else:
        assert found == pytest.approx([before.existence_probability] * 4, abs=1e-3)
        flock.step(AHEAD)
        assert flock.one.track == before.track and flock.one.confirmed


def test_a_prediction_is_where_the_flock_mate_flies_to() -> None:
    """It gains 0.2 m/s on the own drone."""
    flock = Follower(confirm_hits=3)
    for k in range(20):
        flock.step(AHEAD + 0.1 * k * CRUISE, sigma_m=0.01)
        assert bool(flock.tracker.predictions(STEP_S, CRUISE)) == (k >= 2), "not confirmed yet"
    now = AHEAD + 1.9 * CRUISE
    (prediction,) = flock.tracker.predictions(1.0, CRUISE)
    np.testing.assert_allclose(prediction.position, now + 0.2 * CRUISE, atol=0.03)
    assert prediction.size_m == pytest.approx(0.6, rel=1e-5)
    (still,) = flock.tracker.predictions(1.0, None)
    np.testing.assert_allclose(still.position, now, atol=0.03)
    flock.tracker.predict(1.0, CRUISE)
    assert flock.tracker.neighbours()[0].existence_probability == pytest.approx(math.exp(-1.0 / 60.0), abs=1e-3)


def test_a_single_detection_is_dropped_after_two_misses_and_two_survive_one_miss() -> None:
    flock = Follower(birth_probability=0.5, detection_probability=0.7, drop_probability=0.1)
    (first,) = flock.step(AHEAD)
    # 0.5 exp(-0.5 / 5) = 0.45, and 0.45 * 0.3 / (0.55 + 0.45 * 0.3) = 0.20
    assert flock.steps(1).one.existence_probability == pytest.approx(0.20, abs=0.01)
    assert flock.steps(1).all == ()  # 0.06
    (second,) = flock.step(AHEAD)
    assert second != first  # a number is never given twice
    assert flock.steps(1, AHEAD).steps(1).step(AHEAD) == (second,)
    assert flock.confirmed


@pytest.mark.fault("false-neighbour")
def test_false_detections_of_one_frame_are_never_confirmed() -> None:
    flock = _settled()
    spots = [np.array([x, y, -1.0]) for x in (-9.0, 9.0) for y in (-6.0, 0.0, 6.0)]
    for k in range(60):
        flock.step(AHEAD, spots[k % len(spots)])
        assert len(flock.confirmed) == 1
    assert len(flock.all) <= 3, "of two frame sets at most"


def test_two_drones_that_cross_at_one_metre_keep_their_numbers() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        flock, given = Follower(), []
        for k in range(25):
            along = -6.0 + 0.5 * k  # each at 1 m/s relative to the own drone, opposite ways, 1 m apart when level
            truth = [np.array([along, 4.5, 0.0]), np.array([-along, 5.5, 0.0])]
            shuffled = rng.permutation(2)
            numbers = flock.step(*(truth[i] + rng.normal(0, 0.05, 3) for i in shuffled))
            given.append([numbers[int(np.flatnonzero(shuffled == i)[0])] for i in range(2)])
        assert np.all(np.array(given) == given[0])


@pytest.mark.fault("false-neighbour")
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sigma_m", [0.05, 0.3])
def test_one_frame_three_metres_off_moves_a_confirmed_track_little(axis: int, sigma_m: float) -> None:
    position = np.array([10.0, 0.0, 0.0])
    flock = _settled(position, sigma_m=sigma_m)
    for seen, count in ((position + 3.0 * np.eye(3)[axis], None), (position, 1)):
        flock.step(seen, sigma_m=sigma_m)
        assert np.linalg.norm(flock.confirmed[0].position - position) < 0.3
        assert len(flock.confirmed) == count or count is None


@pytest.mark.parametrize("share", [0.85, 0.6])
def test_one_wrong_range_of_a_known_neighbour_does_not_stop_the_drone(share: float) -> None:
    """3.4 or 2.4 m instead of 4.2 m, by its own account to 2 %. It begins no stranger: it is in the same bearing."""
    flock = _settled(1.05 * AHEAD, sigma_m=0.06)
    assert flock.step(share * AHEAD, sigma_m=0.06) == (1,)
    assert flock.fastest() > 1.0
    assert flock.steps(1, 1.05 * AHEAD, sigma_m=0.06).fastest() > 1.0


def test_one_false_detection_ahead_slows_for_a_step_and_does_not_stop() -> None:
    """As seen in flight: 5.4 m ahead, once. One that comes at 2 m/s is seen twice, and stops it."""
    beside, ahead = np.array([2.5, 4.0, 0.0]), 1.35 * AHEAD
    for second, least, most in (((), 1.0, math.inf), ((ahead - 1.5 * CRUISE,), 0.0, 0.3)):
        flock = _settled(beside)
        assert 0.3 < flock.steps(1, beside, ahead, sigma_m=0.15).fastest() < 1.0
        assert least <= flock.steps(1, beside, *second, sigma_m=0.15).fastest() <= most


@pytest.mark.parametrize(("stranger", "both_seen"), [([3.4, 0.0, 0.0], True), ([3.4, 0.6, 0.0], False)])
def test_a_stranger_beside_a_known_neighbour_still_slows_at_once(stranger: list[float], both_seen: bool) -> None:
    place = 1.05 * AHEAD
    flock = _settled(place, sigma_m=0.06).steps(1, np.array(stranger), *[place] * both_seen, sigma_m=0.06)
    assert flock.fastest() < 0.8


@pytest.mark.parametrize("comes_m_s", [2.0, 0.0])
def test_a_stranger_that_hides_a_known_neighbour_is_believed_in_time(comes_m_s: float) -> None:
    """It came out from behind something in front of the neighbour, hovers or comes: the gate brakes before 1 m."""
    flock, stranger_m = _settled(2.0 * AHEAD, sigma_m=0.06), 5.5
    while stranger_m > 0 and flock.steps(1, stranger_m * CRUISE, sigma_m=0.06).fastest() >= 0.5:
        stranger_m -= STEP_S * (1.0 + comes_m_s)
    assert stranger_m > 1.0 + 0.5 * (1.0 + comes_m_s)


def test_the_first_update_is_the_textbook_kalman_filter() -> None:
    """By hand: 0.1 m at first sight, velocity +-0.7 m/s, 1 s on: as 2 * 0.49 / (0.4^2 * 0.5) = 12.25 s is how long a
    mate keeps a velocity of its own, w = 12.25 (1 - e^(-1 / 12.25)) = 0.960 m of way for each m/s."""
    tracker = Follower(
        acceleration_sigma_m_s2=0.4, range_error_lasts=1e-9, stranger_probability=1e-9,
    ).tracker  # fmt: skip
    tracker.update(0.0, [_seen(AHEAD, 0.1)], CRUISE)
    tracker.predict(1.0, np.array([1.0, 0.0, 0.0]))
    (before,) = tracker.neighbours()
    np.testing.assert_allclose(before.position, AHEAD)
    keeps, way = 0.921610, 0.960272
    variance = 0.01 + way**2 * 0.49 + 0.08 / 3
    assert before.position_sigma_m == pytest.approx(math.sqrt(variance), rel=1e-5)
    tracker.update(1.0, [_seen(np.array([4.5, 0.0, 0.0]), 0.1)], CRUISE)
    (after,) = tracker.neighbours()
    gain = variance / (variance + 0.01)
    velocity_gain = (way * keeps * 0.49 + 0.08 / 2) / (variance + 0.01)
    np.testing.assert_allclose(after.position, [4.0 + 0.5 * gain, 0.0, 0.0], rtol=1e-5)
    np.testing.assert_allclose(after.velocity, [1.0 + 0.5 * velocity_gain, 0.0, 0.0], rtol=1e-4)
    assert after.position_sigma_m == pytest.approx(math.sqrt((1 - gain) * variance), rel=0.01)


def test_a_new_track_is_a_flock_mates_or_a_strangers() -> None:
    """A mate at 1 +- 0.7 m/s by 0.8, or one on a course to meet at 0 +- 2 m/s: north 0.8 m/s.

    One on a course to meet is as uncertain across it as a mate. Where the own velocity is not known, all are strangers.
    """
    neighbour = Follower().steps(1, AHEAD).one
    np.testing.assert_allclose(neighbour.velocity, [0.8, 0.0, 0.0], atol=1e-12)
    north = 0.8 * 0.49 + 0.2 * 4.0 + 0.8 * 0.2
    assert neighbour.velocity_sigma_m_s == pytest.approx(math.sqrt((north + 2 * 0.49) / 3))
    assert neighbour.possible is not None
    found = [(one.probability, one.closing_sigma_m_s, *one.velocity) for one in neighbour.possible]
    np.testing.assert_allclose(found, [(0.8, 0.7, *CRUISE), *2 * [(0.1, 2.0, 0.0, 0.0, 0.0)]], atol=1e-12)
    unknown = Follower().steps(1, AHEAD, own=None).one
    np.testing.assert_array_equal(unknown.velocity, np.zeros(3))
    assert unknown.velocity_sigma_m_s == pytest.approx(2.0)


def test_one_on_a_course_to_meet_is_taken_for_no_mate_by_its_constant_bearing() -> None:
    """Two at right angles, 3 m/s each, meet in 7 s: a bearing that does not change, and ranges 20 % uncertain.

    What ranges say of a mate, which would keep its bearing too, is no proof in the first three seconds.
    """
    faster, bearing = [], np.array([1.0, -1.0, 0.0]) / math.sqrt(2)
    covariance = log_polar_covariance(bearing, 0.2, 0.005)
    for seed in range(20):
        flock, errors = Follower(), _lasting(np.random.default_rng(seed), 7, STEP_S)
        for step in range(7):
            log_range = math.log(20.0 - 0.5 * step * 3.0 * math.sqrt(2)) + 0.2 * errors[step]
            flock.step(Measurement(bearing, log_range, covariance, 0.6), own=3.0 * CRUISE, moved_sigma_m=0.02)
            assert flock.one.possible is not None
            comes_m_s = [-bearing @ one.velocity + 2 * one.closing_sigma_m_s for one in flock.one.possible]
            faster.append(max(comes_m_s) < 3.0 / math.sqrt(2))
    assert np.mean(faster) < 0.05


def test_no_motion_of_a_mate_is_ever_given_up() -> None:
    """After 100 s beside each other it flies as the drone does, and may still brake or turn away: so within seconds it
    is known to stand."""
    flock = _settled(steps=200)
    assert flock.one.possible is not None
    mate, *others = (one.probability for one in flock.one.possible)
    assert mate > 0.98 and len(others) == 2 and mate + sum(others) == pytest.approx(1.0)
    assert flock.one.possible[0].range_sigma_m < 3**0.5 * flock.one.position_sigma_m
    for step in range(4):
        flock.step(AHEAD - 0.5 * (step + 1) * CRUISE)
    assert flock.one.track == 1 and abs(flock.one.velocity[0]) < 0.25


@pytest.mark.parametrize("step_s", [0.1, 0.2, 0.5])
def test_a_second_of_prediction_is_the_same_in_steps_of_any_length(step_s: float) -> None:
    """At first sight of one that may be a mate or not: place, velocity, sigmas and probabilities, within some percent
    for the accelerations within a step."""
    flock = Follower().steps(1, AHEAD)
    for _ in range(round(1.0 / step_s)):
        flock.tracker.predict(step_s, step_s * CRUISE)
    whole = Follower().steps(1, AHEAD)
    whole.tracker.predict(1.0, CRUISE)
    assert flock.one.possible and whole.one.possible
    assert flock.one.position_sigma_m == pytest.approx(whole.one.position_sigma_m, rel=0.05)
    probabilities, at_once = ([one.probability for one in each.one.possible or ()] for each in (flock, whole))
    np.testing.assert_allclose(probabilities, at_once, atol=1e-12)
    np.testing.assert_allclose(flock.one.position, whole.one.position, atol=0.05)


def test_the_filter_knows_its_own_error() -> None:
    """Truth drawn from the filter's own model: the squared error over its variance averages to 1."""
    rng = np.random.default_rng(5)
    density = TrackingParameters().acceleration_sigma_m_s2 ** 2 * 0.5
    noise = np.linalg.cholesky(density * np.array([[STEP_S**3 / 3, STEP_S**2 / 2], [STEP_S**2 / 2, STEP_S]]))
    errors = []
    for _ in range(60):
        tracker = Follower().tracker
        position, velocity = 2.0 * AHEAD, CRUISE + rng.normal(0, 0.7, 3)
        for k in range(12):
            if k:
                kick = noise @ rng.normal(size=(2, 3))
                position = position + velocity * STEP_S + kick[0] - CRUISE * STEP_S
                velocity = velocity + kick[1]
                tracker.predict(STEP_S, CRUISE * STEP_S + rng.normal(0, 0.02, 3), 0.02)
            tracker.update(k * STEP_S, [_seen(position + rng.normal(0, 0.1, 3), 0.1)], CRUISE)
        one = next(neighbour for neighbour in tracker.neighbours() if neighbour.confirmed)
        off = (one.position - position) / one.position_sigma_m, (one.velocity - velocity) / one.velocity_sigma_m_s
        errors.append(off)
    # Mean of 180 squares of a standard normal: 1 +- 0.105; the robust update costs some per cent.
    assert np.square(errors).mean(axis=(0, 2)) == pytest.approx([1.0, 1.0], abs=0.3)


@pytest.mark.parametrize("step_s", [0.5, 0.1])
def test_where_errors_of_ranges_last_the_tracker_knows_its_own_at_any_step(step_s: float) -> None:
    """Mates 6 m off with ranges of 3 %: of errors along the bearing 3 to 7 % are beyond two standard deviations."""
    beyond = []
    for seed in range(20):
        rng, flock, place = np.random.default_rng(seed), Follower(), 1.5 * AHEAD
        covariance = log_polar_covariance(CRUISE, 0.03, 0.002)
        errors = _lasting(rng, round(20.0 / step_s), step_s)
        for k, error in enumerate(errors):
            flock.step(Measurement(CRUISE, math.log(6.0) + 0.03 * error, covariance, 0.6), after_s=step_s)
            if k * step_s > 5.0:
                assert flock.one.possible is not None
                beyond.append(abs(flock.one.position[0] - place[0]) > 2.0 * flock.one.possible[0].range_sigma_m)
    assert 0.02 < np.mean(beyond) < 0.07


def test_a_heading_that_is_wrong_counts_in_places_and_not_in_ranges() -> None:
    """By 2 degrees, 10 m away: 0.35 m across, of three axes."""
    true, wrong = (Follower(heading_sigma_rad=sigma).steps(10, 2.5 * AHEAD).one for sigma in (0.0, 0.035))
    assert wrong.position_sigma_m**2 - true.position_sigma_m**2 == pytest.approx(0.35**2 / 3, rel=0.01)
    assert wrong.possible and true.possible
    assert wrong.possible[0].range_sigma_m == true.possible[0].range_sigma_m


def test_a_detection_of_another_size_is_of_another_drone() -> None:
    """The range of a drone that is taken for one of half its size is halved; a vague young track would follow it."""
    for size_m, number in ((0.3, 2), (0.6, 1)):
        flock = Follower().steps(1, AHEAD, sigma_m=0.4).steps(1, AHEAD, sigma_m=1.0)
        assert flock.step(_seen(0.5 * AHEAD, 0.1, size_m)) == (number,)


def test_a_detection_is_turned_into_level_axes() -> None:
    """Nose to the east: what is ahead of the body is east, and its covariance turns with it."""
    seen = detection(5.0 * CRUISE, covariance=np.diag([0.01, 0.0001, 0.0004]), size_m=0.6, log_size_sigma=0.08)
    assert seen.way_sigma_m == pytest.approx(5.0 * 0.1)
    assert seen.range_sigma_m == pytest.approx(5.0 * math.hypot(0.1, 0.08))
    measurement = Measurement.of(seen, rotation_from_euler(0.0, 0.0, math.pi / 2))
    np.testing.assert_allclose(measurement.position, 5.0 * EAST, atol=1e-12)
    np.testing.assert_allclose(measurement.covariance, np.diag([0.0001, 0.01, 0.0004]), atol=1e-12)
    assert (measurement.drone_probability, measurement.size_m, measurement.log_size_sigma) == (0.95, 0.6, 0.08)


def test_probabilities_that_do_not_increase_are_refused() -> None:
    with pytest.raises(ValueError, match="keep_probability"):
        TrackingParameters(keep_probability=0.9, confirm_probability=0.8)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ({"bearing": np.array([np.nan, 0, 0])}, "bearing"),
        ({"bearing": np.array([2.0, 0, 0])}, "bearing"),
        ({"log_range": math.inf}, "log range"),
        ({"covariance": np.full((3, 3), np.inf)}, "covariance"),
        ({"size_m": 0.0}, "size"),
        ({"drone_probability": 1.2}, "probability"),
        *(({"log_size_sigma": sigma}, "size's sigma") for sigma in (-0.1, math.nan, math.inf)),
    ],
)
def test_a_measurement_that_is_no_number_is_refused(bad: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        replace(_seen(AHEAD), **bad)


@pytest.mark.parametrize(("limit_m_s2", "slowest_m_s"), [(5.0, (0.0, 0.0)), (0.5, (0.3, 0.9))])
def test_one_that_brakes_does_so_as_hard_as_gates_let_it(limit_m_s2: float, slowest_m_s: tuple[float, float]) -> None:
    """A mate at 1 m/s may stand half a second after it was seen, where gates allow more than 2 m/s^2."""
    one = Follower(max_acceleration_m_s2=limit_m_s2).steps(8, AHEAD)
    one.tracker.predict(STEP_S, STEP_S * CRUISE)
    low, high = slowest_m_s
    assert low <= min(math.hypot(*motion.velocity) for motion in one.all[0].possible or ()) <= high


def test_one_lie_of_the_own_motion_changes_no_track() -> None:
    """In one of twenty steps the own motion is a metre off; both neighbours keep their tracks and places."""
    random = np.random.default_rng(0)
    places = np.array([[4.0, 0.0, 0.0], [3.0, 2.0, 0.3]])
    tracker = Tracker(TrackingParameters())
    numbers = set()
    for step in range(20):
        if step:
            tracker.predict(STEP_S, np.array([0.5, 1.0 if step == 12 else 0.0, 0.0]), 0.02)
        seen = [_seen(place + random.normal(0.0, 0.05, 3)) for place in places]
        numbers.add(tracker.update(step * STEP_S, seen, CRUISE))
    assert numbers == {(1, 2)}
    np.testing.assert_allclose([one.position for one in tracker.neighbours()], places, atol=0.2)


@pytest.mark.parametrize(("own", "east_m_s"), [(CRUISE, 1.0), (None, 0.5)])
def test_a_learned_size_scales_ranges_and_known_relative_velocities(own: Array | None, east_m_s: float) -> None:
    """A track of 0.6 m at 4 m that flies 0.5 m/s to the east of the own way, and is 1.2 m large."""
    follower = Follower()
    for tick in range(20):
        follower.step(AHEAD + 0.25 * tick * EAST, sigma_m=0.01)
    (before,) = follower.all
    follower.tracker.resize(1.2, own)
    (after,) = follower.all
    np.testing.assert_allclose(after.position, 2 * before.position, rtol=1e-2)
    assert before.velocity[1] == pytest.approx(0.5, abs=0.05)
    assert after.velocity[1] == pytest.approx(east_m_s, abs=0.1)
