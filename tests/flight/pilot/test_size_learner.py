"""A pilot that learns how large the others are: when it weaves, and what it makes of it."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from flockd.core.config import DroneConfig
from flockd.core.config.safety import GateParameters
from flockd.core.messages import (
    Detection,
    FloatArray,
    FrameSet,
    LearnedSize,
    Neighbour,
    PilotOutput,
    ReasonKind,
    SizeStatus,
    VehicleState,
)
from flockd.flight.geometry import log_polar_covariance
from flockd.flight.perception import Observation
from flockd.flight.perception.maps import KnownSize
from flockd.flight.pilot import FlockPilot
from flockd.flight.pilot.size_learner import SizeLearner
from flockd.flight.pilot.weave import Weave
from flockd.flight.tracking.flock_size import FlockSize, SizeEstimate
from flockd.flight.tracking.measurement import Measurement
from flockd.flight.tracking.weave_path import DURATION_S, PERIOD_S
from tests.make import changed, frames, neighbour, scenario, vehicle

STEP_S = 0.5
SIZE_M, JUDGED_M = 0.4, 0.56
PLACES = np.array([[3.0, 1.0, 0.4], [-1.0, 3.5, -0.6], [-3.0, -2.0, 0.1], [2.0, -3.0, 0.8]])
"""Metres NED from where the drone begins, of others that hover."""
HEIGHT_M = 4.0


class Flight:
    """A drone that holds its place among others, and goes to the heights that its pilot asks for."""

    def __init__(
        self,
        config: DroneConfig,
        *,
        judged_m: float = JUDGED_M,
        scatter: float = 0.0,
        doubt: float = 0.0,
        sizes_m: Sequence[float] = (SIZE_M,) * len(PLACES),
        learned: LearnedSize | None = None,
        flies: bool = True,
    ) -> None:
        """`scatter`: standard deviation of the logarithm of the judged size; `doubt`: what the network says of it."""
        self._sizes_m, self._doubt = sizes_m, doubt
        self._judged_m, self._random, self._scatter = judged_m, np.random.default_rng(3), scatter
        networks: Any = object()  # never asked for anything
        self._pilot = FlockPilot(config, networks, observer=self, learned=learned, flies=flies)
        self.below_m = self.time_s = 0.0
        self._last: Observation | None = None
        self.told: list[KnownSize | None] = []

    def observe(
        self, frames: FrameSet, vehicle: VehicleState, ground: Any, predictions: Any, trace: Any, lap: Any,
        learned_size: KnownSize | None,
    ) -> Observation:  # fmt: skip
        """Four drones, at the range at which one of the size that it goes by has their apparent size."""
        self.told.append(learned_size)
        found = tuple(self._detection(place, learned_size, k + 1) for k, place in enumerate(PLACES))
        self._last = Observation(frames.time_s, vehicle, {}, found, self._last)
        return self._last

    def _detection(self, place: FloatArray, known: KnownSize | None, label: int) -> Detection:
        offset = place - [0.0, 0.0, self.below_m]
        bearing = offset / np.linalg.norm(offset) + self._random.normal(0.0, 0.003, 3)
        bearing /= np.linalg.norm(bearing)
        looks_m = self._judged_m * math.exp(self._random.normal(0.0, self._scatter))
        size_m = looks_m if known is None or not known.is_of(looks_m) else known.size_m
        true_m = self._sizes_m[label - 1]
        log_range = math.log(float(np.linalg.norm(offset)) * size_m / true_m) + self._random.normal(0.0, 0.02)
        covariance = log_polar_covariance(bearing, 0.03, 0.004)
        return Detection(bearing, log_range, covariance, 0.95, size_m, ("front",), label, self._doubt)

    @property
    def learned(self) -> LearnedSize | None:
        return self._pilot.learned

    def fly(self, duration_s: float, climb_m_s: float = 0.0) -> list[PilotOutput]:
        """All outputs; somebody else makes the drone climb."""
        outputs = []
        for _ in range(round(duration_s / STEP_S)):
            height_m = HEIGHT_M - self.below_m
            outputs.append(self._pilot.step(frames(self.time_s), vehicle(self.time_s, height_m)))
            asked_m = outputs[-1].command.height_m
            self.below_m -= climb_m_s * STEP_S
            if asked_m is not None:
                self.below_m -= (asked_m - height_m) * (1 - math.exp(-STEP_S))  # 1 m/s for each metre
            self.time_s += STEP_S
        return outputs


def _range_errors(output: PilotOutput, below_m: float) -> list[float]:
    """Relative, of the neighbour in the direction of each of the others."""
    errors = []
    for place in PLACES - [0.0, 0.0, below_m]:
        range_m = float(np.linalg.norm(place))
        found_m = {
            float(one.position @ place) / r: r for one in output.neighbours if (r := np.linalg.norm(one.position))
        }
        errors.append(float(found_m[max(found_m)]) / range_m - 1)
    return errors


def drone(size: str = "weave", **perception: float) -> DroneConfig:
    said = {f"perception__{key}": value for key, value in perception.items()}
    hovers = {"mission__kind": "hover", "mission__waypoints": (), "own_velocity": "autopilot"}
    return changed(scenario(name="square").drone, flocking__size=size, **hovers, **said)


def weaves(outputs: Sequence[PilotOutput]) -> list[bool]:
    return [one.size is not None and one.size.weaves for one in outputs]


def size_of(output: PilotOutput) -> SizeStatus:
    assert output.size is not None
    return output.size


def flight_shows(monkeypatch: pytest.MonkeyPatch, of_looks: SizeEstimate | None, of_track: Any = None) -> None:
    """The flight shows these sizes; `of_track` is called with a track's number."""
    monkeypatch.setattr(FlockSize, "of_looks", lambda self, size_m: of_looks)
    if of_track is not None:
        monkeypatch.setattr(FlockSize, "of_track", lambda self, number: of_track(number))


def test_a_size_that_the_networks_judge_wrong_is_learned_and_used() -> None:
    """0.56 m instead of 0.4: ranges were 40 % too long. The gate reckons with what the learned size may be off."""
    flight = Flight(drone())
    outputs = flight.fly(25.0)
    assert outputs[5].size is None or not outputs[5].size.used
    assert np.linalg.norm(outputs[5].neighbours[0].position) == pytest.approx(1.4 * 3.19, rel=0.1)
    assert size_of(outputs[-1]).used
    assert size_of(outputs[-1]).size_m == pytest.approx(SIZE_M, rel=0.1)
    assert flight.told[-1] is not None
    begins = weaves(outputs).index(True)
    ends = next(k for k, one in enumerate(outputs) if one.size and one.size.used)
    assert ends - begins <= DURATION_S / STEP_S
    before, after = outputs[ends - 1].neighbours, outputs[ends].neighbours
    for one, other in zip(before, after, strict=True):
        assert one.track == other.track
        assert np.linalg.norm(other.position) < 0.85 * np.linalg.norm(one.position)
        assert other.possible is not None
        assert other.possible[0].range_sigma_m > 0.05 * np.linalg.norm(other.position)
    assert "weaves" in outputs[begins].mission.sentence
    assert re.search(r"0\.(39|4[0-2]) m large", outputs[-1].mission.sentence)


def test_a_climb_that_somebody_else_flies_teaches_the_size_for_the_flight() -> None:
    """Four seconds of it, among others that stand; the flight's pilot has the ranges right from the first on."""
    before = Flight(drone("auto"), doubt=0.3, flies=False)
    before.below_m = 4.0
    before.fly(3.0)
    assert before.learned is None
    before.fly(4.0, climb_m_s=1.0)
    before.fly(20.0)
    learned = before.learned
    assert learned is not None
    assert learned.size_m == pytest.approx(SIZE_M, rel=0.1)
    assert learned.looks_m == pytest.approx(JUDGED_M, rel=0.02)
    flight = Flight(drone("auto"), doubt=0.3, learned=learned)
    outputs = flight.fly(4.0)
    assert flight.told[0] == KnownSize(learned.size_m, learned.sigma * learned.size_m, learned.looks_m)
    assert max(map(abs, _range_errors(outputs[2], 0.0))) < 0.15
    assert any(weaves(outputs + flight.fly(20.0))), "others learn from it"


def test_nobody_weaves_before_the_flight_and_in_it_only_the_weave_tells_of_the_size() -> None:
    """How else it rises the others may do too."""
    assert not any(weaves(Flight(drone("weave"), flies=False).fly(30.0)))
    assert Flight(drone("off")).learned is None
    flight = Flight(drone("auto"))
    flight.fly(3.0)
    flight.fly(4.0, climb_m_s=1.0)
    flight.fly(3.0)
    assert flight.learned is None


def test_each_of_two_types_that_look_alike_has_its_own_size() -> None:
    """All are judged to be 0.56 m large; two are 0.4 and two 0.76 m."""
    flight = Flight(drone(), sizes_m=(0.4, 0.76, 0.4, 0.76))
    before = flight.fly(5.0)[-1]
    last = flight.fly(25.0)[-1]
    first, final = (_range_errors(output, flight.below_m) for output in (before, last))
    assert min(map(abs, first)) > 0.09, "0.56 / 0.4 and 0.56 / 0.76"
    assert max(map(abs, final)) < 0.1
    sizes_m = [float(word) for word in re.findall(r"\d\.\d\d", last.mission.sentence)]
    assert (min(sizes_m), max(sizes_m)) == pytest.approx((0.4, 0.76), rel=0.1)


def test_a_drone_that_knows_the_size_weaves_once_for_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    flight_shows(monkeypatch, SizeEstimate(SIZE_M, 0.05))
    woven = weaves(Flight(drone()).fly(45.0))
    assert sum(now and not before for before, now in itertools.pairwise([False, *woven])) == 1


@pytest.mark.parametrize(("doubt", "least", "most"), [(0.3, 0.15, 0.2), (0.03, 0.0, 0.1)])
def test_the_gate_reckons_with_what_a_judged_size_may_be_off(doubt: float, least: float, most: float) -> None:
    """Of drones that the networks do not know, as long as nothing was learned. It lasts, and does not average out."""
    last = Flight(drone("auto"), doubt=doubt).fly(4.0)[-1]
    assert last.size is None or not last.size.used
    for one in last.neighbours:
        assert one.possible
        sigmas = [of.range_sigma_m / float(np.linalg.norm(of.position)) for of in one.possible]
        assert all(least <= sigma <= most for sigma in sigmas)


@pytest.mark.parametrize("judged_m", [0.19, 0.95])
def test_a_size_that_is_not_plausible_is_not_used(judged_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """More than twice what the networks judge, or less than half."""
    flight_shows(monkeypatch, SizeEstimate(SIZE_M, 0.05))
    size = size_of(Flight(drone(), judged_m=judged_m).fly(10.0)[-1])
    assert (size.size_m, size.used) == (SIZE_M, False)


def test_an_own_size_that_is_not_plausible_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor one that becomes so: the track of a drone that begins to rise with the own one."""
    said = iter([SizeEstimate(SIZE_M, 0.05)] * 40)
    flight_shows(monkeypatch, None, lambda number: next(said, SizeEstimate(3.0, 0.05)))
    outputs = Flight(drone()).fly(25.0)
    assert any("0.40 m large" in one.mission.sentence for one in outputs)
    assert not any("3.00" in one.mission.sentence for one in outputs)
    assert max(float(np.linalg.norm(one.position)) for one in outputs[-1].neighbours) < 6.0


@pytest.mark.parametrize(("size_m", "judged_m", "range_m"), [(0.4, 0.56, 4.2), (0.7, 0.7, 3.0)])
def test_a_size_that_is_in_use_is_undone_before_it_is_judged_again(
    size_m: float, judged_m: float, range_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else what was learned from ranges would confirm itself; a neighbour's own size is as the networks judge it."""
    judged: list[Measurement] = []
    monkeypatch.setattr(FlockSize, "step", lambda _, interval_s, way, measured: judged.extend(measured.values()))
    learner = SizeLearner(drone(), LearnedSize(0.4, 0.05, 0.56, doubted=False))
    one = Measurement(np.array([1.0, 0.0, 0.0]), math.log(3.0), 1e-4 * np.eye(3), size_m)
    learner.see(STEP_S, np.zeros(3), {1: one}, [at(3.0)])
    assert (judged[0].size_m, judged[0].range_m) == pytest.approx((judged_m, range_m))


@pytest.mark.parametrize("step_s", [0.5, 0.1])
def test_ten_steps_a_second_judge_no_more_views_than_two(step_s: float) -> None:
    """Else a few seconds of one view stand for a minute of many."""
    learner = SizeLearner(drone())
    one = Measurement(np.array([1.0, 0.0, 0.0]), math.log(3.0), 1e-4 * np.eye(3), JUDGED_M)
    for _ in range(round(6.0 / step_s)):
        learner.see(step_s, np.zeros(3), {1: one}, [at(3.0)])
    assert len(learner._judged) == 12


@pytest.mark.parametrize(
    ("judged_m", "doubt", "used"),
    [
        pytest.param(SIZE_M, 0.0, False, id="judged well"),
        # 8 % wrong, which is less than what the learned size may be off
        pytest.param(0.432, 0.02, False, id="judged nearly well"),
        pytest.param(0.432, 0.3, True, id="the networks say that they do not know it"),
    ],
)
def test_a_size_that_the_networks_judge_well_stays_theirs(judged_m: float, doubt: float, used: bool) -> None:
    outputs = Flight(drone("weave"), judged_m=judged_m, doubt=doubt).fly(25.0)
    assert size_of(outputs[-1]).size_m == pytest.approx(SIZE_M, rel=0.1)
    assert size_of(outputs[-1]).used is used
    assert used or not any(one.size.used for one in outputs if one.size)


def test_a_size_that_was_said_and_is_wrong_is_a_warning_with_both() -> None:
    outputs = Flight(drone(drone_size_m=JUDGED_M, drone_size_sigma_m=0.01)).fly(25.0)
    first, last = (
        [reason.text for reason in one.reasons if reason.kind is ReasonKind.SIZE] for one in (outputs[5], outputs[-1])
    )
    assert first == []
    (text,) = last
    assert re.search(r"perception.drone_size_m .*0.56 m.* 0.(3[7-9]|4[0-3]) \+-0.0[2-4] m; ", text)


def test_it_is_off_where_it_is_not_asked_for() -> None:
    outputs = Flight(drone("off"), scatter=0.1).fly(25.0)
    assert all(one.size is None and one.command.height_m is None for one in outputs)


@pytest.mark.parametrize(
    ("scatter", "doubt", "said", "needed"),
    [
        pytest.param(0.1, 0.02, {}, True, id="the networks do not know them"),
        pytest.param(0.01, 0.3, {}, True, id="the networks judge them alike, and say that they do not know them"),
        pytest.param(0.01, 0.06, {}, False, id="they know them"),
        pytest.param(0.1, 0.3, {"drone_size_m": SIZE_M}, False, id="their size is said"),
    ],
)
def test_by_itself_it_weaves_where_the_judged_sizes_are_uncertain(
    scatter: float, doubt: float, said: dict[str, float], *, needed: bool
) -> None:
    """As of drones that the networks do not know, and whose size nobody said."""
    outputs = Flight(drone("auto", **said), scatter=scatter, doubt=doubt).fly(25.0)
    assert any(weaves(outputs)) is needed
    assert not needed or size_of(outputs[-1]).size_m == pytest.approx(SIZE_M, rel=0.1)


def test_two_drones_draw_other_times() -> None:
    begins = [weaves(Flight(changed(drone(), name=name)).fly(25.0)).index(True) for name in ("alder", "birch")]
    assert begins[0] != begins[1]


@dataclass
class Weaving:
    """One drone's weave, stepped without a pilot."""

    height_m: float = HEIGHT_M
    wanted_m: float | None = HEIGHT_M
    neighbours: Sequence[Neighbour] = ()
    hill_m: float = 0.0
    gain_per_s: float = 1.0
    """How fast the drone goes to the height that is asked for, m/s for each metre; 0: it stays."""

    def __post_init__(self) -> None:
        self.weave, self._random = Weave(GateParameters()), np.random.default_rng(0)
        self._time_s = 0.0

    def asked(self, duration_s: float, *, needed: bool = True) -> FloatArray:
        """What is asked for, less what the mission wants."""
        lifts = []
        for _ in range(round(duration_s / STEP_S)):
            over_ground_m = self.height_m - self.hill_m
            height_m = self.weave.height(
                self._time_s, self.height_m, over_ground_m, self.wanted_m, self.neighbours, self._random, needed=needed
            )
            lifts.append(math.nan if height_m is None else height_m - HEIGHT_M)
            if height_m is not None and abs(height_m - HEIGHT_M) < 0.5:
                self.height_m += (height_m - self.height_m) * (1 - math.exp(-self.gain_per_s * STEP_S))
            self._time_s += STEP_S
        return np.array(lifts)


def at(north_m: float, climb_m_s: float = 0.0) -> Neighbour:
    return neighbour([north_m, 0.0, 0.0], [0.0, 0.0, -climb_m_s], position_sigma_m=0.1)


def test_it_goes_up_and_down_twice_and_ends_where_it_began() -> None:
    lifts = Weaving().asked(60.0)
    first = np.flatnonzero(lifts)[0]
    lifts = lifts[: first + round(DURATION_S / STEP_S) + 4]
    moved = np.flatnonzero(lifts)
    assert STEP_S * (moved[-1] - moved[0]) == pytest.approx(DURATION_S - 2 * STEP_S, abs=STEP_S)
    assert 0.3 <= lifts.max() <= 0.5
    assert lifts.min() == pytest.approx(-lifts.max())
    half = round(PERIOD_S / STEP_S)
    assert lifts[moved[0] : moved[0] + half] == pytest.approx(lifts[moved[0] + half : moved[0] + 2 * half], abs=1e-9)
    assert lifts[-1] == 0.0


@pytest.mark.parametrize(
    ("height_m", "neighbours", "hill_m"),
    [
        pytest.param(1.5, (), 0.0, id="near the lowest height"),
        pytest.param(29.5, (), 0.0, id="near the highest height"),
        pytest.param(5.0, (), 0.0, id="not yet at its height"),
        pytest.param(HEIGHT_M, (at(2.0),), 0.0, id="another is near"),
        pytest.param(HEIGHT_M, (at(4.0, climb_m_s=0.3),), 0.0, id="another weaves"),
        pytest.param(HEIGHT_M, (), 2.5, id="over a hill"),
    ],
)
def test_it_does_not_begin(height_m: float, neighbours: Sequence[Neighbour], hill_m: float) -> None:
    wanted_m = HEIGHT_M if height_m == 5.0 else height_m
    weaving = Weaving(height_m, wanted_m, neighbours, hill_m, gain_per_s=0.0)
    assert (np.diff(weaving.asked(60.0)) == 0.0).all()
    assert (Weaving().asked(60.0, needed=False) == 0.0).all(), "nothing is to be learned"


def test_a_weave_that_the_drone_does_not_follow_ends() -> None:
    """A gate holds it between two others: who sees the little that it moves would take it for large."""
    lifts = Weaving(gain_per_s=0.0).asked(30.0)
    begins = np.flatnonzero(lifts)[0]
    assert (lifts[begins + 7 : begins + 12] == 0.0).all(), "from 3.5 s on, when it should go down"


@pytest.mark.parametrize(("gain_per_s", "weaves"), [(0.6, 2), (1.0, 5), (4.0, 2)])
def test_an_autopilot_that_follows_heights_otherwise_weaves_twice_in_vain(gain_per_s: float, weaves: int) -> None:
    """It moves by 63 and 118 % of what the others reckon with; each weave is ended after its first 6 s."""
    weaving = Weaving(gain_per_s=gain_per_s)
    lifts = weaving.asked(90.0)
    began = np.flatnonzero((lifts != 0.0) & (np.roll(lifts, 1) == 0.0) & (np.roll(lifts, 2) == 0.0))
    if weaves == 2:
        assert len(began) == 2
        assert np.count_nonzero(lifts) <= 2 * PERIOD_S / STEP_S
        assert "weaves no more" in (weaving.weave.given_up or "")
    else:
        assert len(began) >= 4
        assert weaving.weave.given_up is None
