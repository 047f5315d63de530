"""A pilot that learns how large the others are: when it weaves, and what it makes of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from flockd.core.config import DroneConfig
from flockd.core.config.safety import GateParameters
from flockd.core.messages import Detection, FloatArray, FrameSet, LearnedSize, Neighbour, PilotOutput, VehicleState
from flockd.flight.geometry import log_polar_covariance
from flockd.flight.perception import Observation
from flockd.flight.pilot import FlockPilot
from flockd.flight.pilot.size_learner import DURATION_S, PERIOD_S, Weave, scale_of
from tests.make import changed, frames, neighbour, scenario, vehicle

STEP_S = 0.5
SIZE_M, JUDGED_M = 0.4, 0.504
"""26 % off."""
PLACES = np.array([[3.0, 1.0, 0.4], [-1.0, 3.5, -0.6], [-3.0, -2.0, 0.1], [2.0, -3.0, 0.8]])
"""Metres NED from where the drone begins, about which the others wander."""
HEIGHT_M = 4.0


class Flight:
    """A drone that goes to the heights that its pilot asks for, among others that drift about their places."""

    def __init__(
        self, config: DroneConfig, *, doubt: float = 0.3, seed: int = 3, mates: str = "drift",
        learned: LearnedSize | None = None, flies: bool = True,
    ) -> None:  # fmt: skip
        """`doubt`: what the networks say of the judged size; `mates` drift, or rise as the drone does ("follow"), or
        are a tree of another size for one ("tree")."""
        self._doubt, self._random, self._mates = doubt, np.random.default_rng(seed), mates
        networks: Any = object()  # never asked for anything
        observer: Any = self
        self._pilot = FlockPilot(config, networks, observer=observer, learned=learned, flies=flies)
        self.below_m = self.time_s = 0.0
        self._drift: FloatArray = np.zeros_like(PLACES)
        self.last: Observation | None = None
        self.told: list[LearnedSize | None] = []

    def observe(
        self, frames: FrameSet, vehicle: VehicleState, ground: Any, predictions: Any, trace: Any, lap: Any,
        learned_size: LearnedSize | None, *_: object,
    ) -> Observation:  # fmt: skip
        """Four drones, at the range at which one of the size that it goes by has their apparent size."""
        self.told.append(learned_size)
        self._drift = 0.8 * self._drift + self._random.normal(0.0, 1.0, PLACES.shape) * [0.15, 0.15, 0.02]
        size_m = JUDGED_M if learned_size is None else learned_size.size_m
        found = tuple(self._detection(place, size_m, k + 1) for k, place in enumerate(self.places))
        self.last = Observation(frames.time_s, vehicle, {}, found, self.last)
        return self.last

    @property
    def places(self) -> FloatArray:
        shown_m = 0.0 if self._mates == "follow" else self.below_m
        return np.asarray(PLACES + self._drift - [0.0, 0.0, shown_m])

    def _detection(self, offset: FloatArray, size_m: float, label: int) -> Detection:
        """It errs by 0.004 rad and, in range, by 5 %."""
        bearing = offset / np.linalg.norm(offset) + self._random.normal(0.0, 0.004, 3)
        bearing /= np.linalg.norm(bearing)
        true_m = 0.6 if self._mates == "bush" and label == 1 else SIZE_M
        log_range = math.log(float(np.linalg.norm(offset)) * size_m / true_m) + self._random.normal(0.0, 0.05)
        covariance = log_polar_covariance(bearing, 0.05, 0.004)
        return Detection(bearing, log_range, covariance, 0.95, size_m, ("front",), label, self._doubt)

    @property
    def learned(self) -> LearnedSize | None:
        return self._pilot.learned

    def fly(self, duration_s: float) -> list[PilotOutput]:
        outputs = []
        for _ in range(round(duration_s / STEP_S)):
            height_m = HEIGHT_M - self.below_m
            outputs.append(self._pilot.step(frames(self.time_s), vehicle(self.time_s, height_m)))
            asked_m = outputs[-1].command.height_m
            if asked_m is not None:
                self.below_m -= (asked_m - height_m) * (1 - math.exp(-STEP_S))  # 1 m/s for each metre
            self.time_s += STEP_S
        return outputs


def drone(size: str = "learn", **perception: float | str) -> DroneConfig:
    said = {f"perception__{key}": value for key, value in perception.items()}
    hovers = {"mission__kind": "hover", "mission__waypoints": (), "own_velocity": "autopilot"}
    return changed(scenario(name="square").drone, flocking__size=size, **hovers, **said)


def weaves(outputs: Sequence[PilotOutput]) -> list[bool]:
    return [one.size is not None and one.size.weaves for one in outputs]


def ranges(output: PilotOutput) -> list[float]:
    return [float(np.linalg.norm(one.position)) for one in output.neighbours]


def range_sigmas(output: PilotOutput) -> list[float]:
    """Relative, as the gate reckons with them."""
    possible = [of for one in output.neighbours for of in one.possible or ()]
    assert possible
    return [of.range_sigma_m / float(np.linalg.norm(of.position)) for of in possible]


def test_a_size_that_is_a_quarter_off_is_found_within_a_weave_and_errs_as_it_says() -> None:
    """Over 20 flights of 21 s; the ranges of all follow at once, and the gate reckons with what it may be off."""
    off = []
    for seed in range(20):
        flight = Flight(drone(), seed=seed)
        outputs = flight.fly(21.0)
        assert flight.learned is not None
        off.append(math.log(flight.learned.size_m / SIZE_M) / flight.learned.sigma)
        found = next(k for k, one in enumerate(outputs) if one.size and one.size.size_m)
        shrunk = np.array(ranges(outputs[found])) / ranges(outputs[found - 1])
        assert np.median(shrunk) == pytest.approx(flight.learned.size_m / JUDGED_M, abs=0.08)
        assert flight.told[-1] == flight.learned
        assert min(range_sigmas(outputs[-1])) >= flight.learned.sigma
        assert f"{flight.learned.size_m:.2f} m large" in outputs[-1].mission.sentence
        assert sum(now and not before for before, now in itertools.pairwise([False, *weaves(outputs)])) == 1
        flight.fly(3.0)
        assert abs(flight.below_m) < 0.05, "it is back at its height"
    sizes_m = np.exp(np.array(off) * 0.05)
    assert np.median(np.abs(sizes_m - 1)) < 0.05
    assert 0.1 < np.mean(np.square(off)) < 0.3, (
        "it says 4 % at least, and errs by less; 0.43 if errors were independent"
    )


@pytest.mark.parametrize("seed", range(3))
def test_mates_that_move_as_the_drone_does_teach_nothing(seed: int) -> None:
    """No bearing shifts, as of drones that are infinitely large and far; nor does one without a weave."""
    flight = Flight(drone(), seed=seed, mates="follow")
    assert any(weaves(flight.fly(40.0)))
    assert flight.learned is None
    level = np.column_stack([np.arange(0, 12, 0.5), np.zeros(24), np.random.default_rng(seed).normal(0, 0.1, 24)])
    assert scale_of(level) is None


def test_what_a_flight_learned_the_next_one_begins_with() -> None:
    learned = LearnedSize(SIZE_M, 0.05)
    flight = Flight(drone(), learned=learned)
    outputs = flight.fly(25.0)
    assert flight.told[0] == LearnedSize(SIZE_M, 0.05)
    assert not any(weaves(outputs))
    assert flight.learned == learned
    assert Flight(drone("off"), learned=learned).learned is None


@pytest.mark.parametrize("flies", [True, False])
def test_it_weaves_only_where_it_is_asked_for_and_flown(flies: bool) -> None:
    outputs = Flight(drone("learn" if not flies else "off"), flies=flies).fly(25.0)
    assert all(one.size is None and one.command.height_m is None for one in outputs)
    assert not any(weaves(outputs))


@pytest.mark.parametrize("refused", [False, True])
@pytest.mark.parametrize(
    ("doubt", "said", "least", "most"), [(0.3, {}, 0.15, 0.2), (0.03, {}, 0, 0.1), (0.3, {"drone_size_m": 0.4}, 0, 0.1)]
)
def test_the_gate_reckons_with_what_a_judged_size_may_be_off(
    doubt: float, said: dict[str, float], least: float, most: float, refused: bool
) -> None:
    """Of drones that the networks do not know, and whose size nobody said. It lasts, and does not average out."""
    flight = Flight(drone("off", **said), doubt=doubt)
    flight.fly(4.0)
    flight.below_m = math.nan if refused else 0.0
    sigmas = range_sigmas(flight.fly(STEP_S)[-1])
    assert all(least <= sigma <= most for sigma in sigmas)


def at(north_m: float, climb_m_s: float = 0.0) -> Neighbour:
    return neighbour([north_m, 0.0, 0.0], [0.0, 0.0, -climb_m_s], position_sigma_m=0.1)


@dataclass
class Weaving:
    """One drone's weave, stepped without a pilot."""

    height_m: float = HEIGHT_M
    wanted_m: float | None = HEIGHT_M
    neighbours: Sequence[Neighbour] = (at(4.0),)
    hill_m: float = 0.0

    def __post_init__(self) -> None:
        self.weave, self._time_s = Weave(GateParameters(), b"alder"), 0.0

    def asked(self, duration_s: float, *, needed: bool = True) -> FloatArray:
        """What is asked for, less what the mission wants."""
        lifts = []
        for _ in range(round(duration_s / STEP_S)):
            over_ground_m = self.height_m - self.hill_m
            asked_m = self.weave.height(
                self._time_s, self.height_m, over_ground_m, self.wanted_m, self.neighbours, needed=needed
            )
            assert asked_m is not None
            assert self.wanted_m is not None
            lifts.append(asked_m - self.wanted_m)
            self._time_s += STEP_S
        return np.array(lifts)


def test_it_goes_up_and_down_twice_and_ends_where_it_began() -> None:
    lifts = Weaving().asked(22.0)
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
        pytest.param(1.5, (at(4.0),), 0.0, id="near the lowest height"),
        pytest.param(29.5, (at(4.0),), 0.0, id="near the highest height"),
        pytest.param(5.0, (at(4.0),), 0.0, id="not yet at its height"),
        pytest.param(HEIGHT_M, (), 0.0, id="nobody is seen"),
        pytest.param(HEIGHT_M, (at(2.0),), 0.0, id="another is near"),
        pytest.param(HEIGHT_M, (at(4.0, climb_m_s=0.3),), 0.0, id="another weaves"),
        pytest.param(HEIGHT_M, (at(4.0),), 2.5, id="over a hill"),
    ],
)
def test_it_does_not_begin(height_m: float, neighbours: Sequence[Neighbour], hill_m: float) -> None:
    wanted_m = HEIGHT_M if height_m == 5.0 else height_m
    assert (Weaving(height_m, wanted_m, neighbours, hill_m).asked(60.0) == 0.0).all()
    assert (Weaving().asked(60.0, needed=False) == 0.0).all(), "nothing is to be learned"
