"""The tracker on synthetic neighbours: recall, false tracks, position error and identity switches.

Five neighbours on crossing paths around a drone that flies the paper's circle; detections with noise of heavier tails
than they say, misses, occlusion, clutter, and one tree that the network takes for a drone with a probability of 0.7.

    python -m tools.measure.benchmark_tracking --flights 20
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from flockd.core.messages import Neighbour
from flockd.flight.geometry import log_polar, log_polar_covariance
from flockd.flight.tracking import Measurement, Tracker, TrackingParameters

Array = NDArray[np.float64]

NEIGHBOURS = 5
DURATION_S = 60.0
BEARING_SIGMA_RAD = 0.005
LOG_RANGE_SIGMA = 0.025
"""As the detections say it; in truth one in ten errs by 0.08, the others by 0.02."""
CLUTTER_PER_FRAME_SET = 0.3
RANGES_M = (0.5, 20.0)
"""Ranges of clutter."""
OWN_DISPLACEMENT_SIGMA_M = 0.02
MATCH_M = 1.0
"""A confirmed track farther from every neighbour is false."""


@dataclass(frozen=True)
class Scenario:
    """What is varied."""

    name: str
    step_s: float = 0.5
    misses: float = 0.05
    occluded_rad: float = 0.0
    """A neighbour is not detected behind a nearer one within this angle."""


SCENARIOS = (
    Scenario("0.5 s"),
    Scenario("0.5 s, occlusion", occluded_rad=0.06),
    Scenario("0.5 s, 20 % missed", misses=0.2),
    Scenario("0.1 s", step_s=0.1),
)


@dataclass(frozen=True, eq=False)
class FrameSet:
    """What one step of a flight gives to the tracker, and the truth."""

    time_s: float
    displacement: Array
    own_velocity: Array
    detections: list[tuple[Array, float]]
    """Position (3,) and drone probability."""
    truth: Array
    """(N, 3) relative positions."""


@dataclass
class Score:
    """Sums over flights."""

    minutes: float = 0.0
    seen: int = 0
    of: int = 0
    false_tracks: int = 0
    false_steps: int = 0
    steps: int = 0
    switches: int = 0
    squared_errors: list[float] = field(default_factory=list)

    def row(self) -> str:
        """Recall, false tracks a minute, share of steps with one, RMS in metres, switches a minute."""
        rms = float(np.sqrt(np.mean(self.squared_errors)))
        return (
            f"{self.seen / self.of:.4f} | {self.false_tracks / self.minutes:.2f} | "
            f"{self.false_steps / self.steps:.4f} | {rms:.4f} | {self.switches / self.minutes:.2f}"
        )


def flight(scenario: Scenario, seed: int) -> Iterator[FrameSet]:
    """The frame sets of one flight."""
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0, 2 * np.pi, NEIGHBOURS)
    rates = rng.uniform(0.05, 0.15, NEIGHBOURS) * rng.choice([-1.0, 1.0], NEIGHBOURS)
    ranges = 2.5 + 0.8 * np.arange(NEIGHBOURS)
    heights = rng.uniform(-0.5, 0.5, NEIGHBOURS)
    tree = np.array([rng.uniform(-8, 8), rng.uniform(2, 18), 2.0])
    before: Array | None = None
    for time_s in np.arange(0.0, DURATION_S, scenario.step_s):
        course = 0.1 * time_s
        own = np.array([10 * np.sin(course), 10 - 10 * np.cos(course), 0.0])
        velocity = np.array([np.cos(course), np.sin(course), 0.0])
        angles = phases + rates * time_s
        radii = ranges + 0.6 * np.sin(0.2 * time_s + 2 * phases)
        truth = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), heights])
        detections = _detections(rng, scenario, truth, tree - own)
        moved = np.zeros(3) if before is None else own - before + rng.normal(0, OWN_DISPLACEMENT_SIGMA_M, 3)
        before = own
        yield FrameSet(float(time_s), moved, velocity, detections, truth)


def _detections(rng: np.random.Generator, scenario: Scenario, truth: Array, tree: Array) -> list[tuple[Array, float]]:
    ranges = np.linalg.norm(truth, axis=1)
    bearings = truth / ranges[:, None]
    found = []
    for index, position in enumerate(truth):
        near = (ranges < ranges[index]) & (
            np.arccos(np.clip(bearings @ bearings[index], -1, 1)) < scenario.occluded_rad
        )
        if near.any() or rng.random() < scenario.misses:
            continue
        sigma = 0.08 if rng.random() < 0.1 else 0.02
        noisy = position * np.exp(rng.normal(0, sigma)) + ranges[index] * rng.normal(0, BEARING_SIGMA_RAD, 3)
        found.append((noisy, float(rng.beta(60, 1))))
    for _ in range(rng.poisson(CLUTTER_PER_FRAME_SET)):
        azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(-0.5, 0.5)
        bearing = np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), -np.sin(elevation)]
        )
        found.append((np.exp(rng.uniform(*np.log(RANGES_M))) * bearing, float(rng.uniform(0.5, 1.0))))
    if rng.random() < 0.7:
        found.append((tree * np.exp(rng.normal(0, LOG_RANGE_SIGMA)), float(rng.uniform(0.5, 0.9))))
    return [found[index] for index in rng.permutation(len(found))]


def measurement(position: Array, drone_probability: float) -> Measurement:
    """As a detector would give it."""
    bearing, log_range = log_polar(position)
    covariance = log_polar_covariance(bearing, LOG_RANGE_SIGMA, BEARING_SIGMA_RAD)
    return Measurement(bearing, log_range, covariance, 0.6, drone_probability)


def score(
    scenario: Scenario, flights: int, track: Callable[[], Tracker], measure: Callable[[Array, float], Measurement]
) -> Score:
    """Flies `flights` of a scenario with trackers that `track` makes."""
    total = Score(minutes=flights * DURATION_S / 60)
    for seed in range(flights):
        tracker, false_tracks = track(), set()
        known: dict[int, int] = {}
        for frames in flight(scenario, seed):
            if frames.time_s > 0:
                tracker.predict(scenario.step_s, frames.displacement, OWN_DISPLACEMENT_SIGMA_M)
            tracker.update(frames.time_s, [measure(*one) for one in frames.detections], frames.own_velocity)
            matched, false = _matches(frames.truth, [n for n in tracker.neighbours() if n.confirmed])
            for index, (number, squared) in matched.items():
                total.switches += known.get(index, number) != number
                known[index] = number
                total.squared_errors.append(squared)
            total.seen += len(matched)
            total.of += len(frames.truth)
            total.steps += 1
            total.false_steps += len(false)
            false_tracks |= false
        total.false_tracks += len(false_tracks)
    return total


def _matches(truth: Array, tracks: list[Neighbour]) -> tuple[dict[int, tuple[int, float]], set[int]]:
    """Neighbour -> (track number, squared error), and the numbers of the false tracks."""
    if not tracks:
        return {}, set()
    distances = np.linalg.norm(truth[:, None] - np.array([one.position for one in tracks])[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(distances, MATCH_M))
    near = {
        int(row): (tracks[column].track, float(distances[row, column] ** 2))
        for row, column in zip(rows, columns, strict=True)
        if distances[row, column] < MATCH_M
    }
    return near, {one.track for one in tracks} - {number for number, _ in near.values()}


def main() -> None:
    """Prints one row a scenario."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=20, help="of one minute, a scenario")
    flights = parser.parse_args().flights
    print("| scenario | recall | false tracks a minute | false a step | position RMS m | switches a minute |")
    print("|---|---|---|---|---|---|")
    for scenario in SCENARIOS:
        found = score(scenario, flights, lambda: Tracker(TrackingParameters()), measurement)
        print(f"| {scenario.name} | {found.row()} |", flush=True)


if __name__ == "__main__":
    main()
