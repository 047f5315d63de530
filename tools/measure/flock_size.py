"""How well a drone learns the others' size from its weave, over many control-level flights with measured errors.

Five drones at drawn places fly the paper's circle on exact states, each with its own weave, at times that none tells
the others, in gusts of up to 0.3 m/s. What the first sees of the others errs as measured from flights by sight
(`config/perceived`), and by the side that it sees; sizes are assumed wrong by a drawn factor; there are false
detections, and its own motion errs. Printed are, by the time since its weave began: flights with a published size, its
error (median, 90 %, largest), and the mean normalised error squared, which is 1 where the standard deviation is right.
With `--take-off` it learns from its own climb, among others that stand on the ground and take off one after the other.

    python -m tools.measure.flock_size --flights 200
    python -m tools.measure.flock_size --flights 200 --take-off
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field

import numpy as np

from flockd.core.config import load_scenario
from flockd.core.config.loader import load_perceived_errors
from flockd.core.config.scenario import ScenarioConfig, StartConfig
from flockd.core.data import data_path
from flockd.core.messages import FloatArray
from flockd.flight.geometry import log_polar_covariance
from flockd.flight.pilot.weave import Weave
from flockd.flight.tracking import Measurement
from flockd.flight.tracking.flock_size import FlockSize, SizeEstimate
from flockd.sim.control_level import perceived_flock
from flockd.sim.exact_states import ExactFlock, start_yaw
from flockd.sim.vehicles import Vehicles

DRONES = 5
DURATION_S = 75.0
SIZE_M = 0.6
GUSTS_M_S = 0.3
ASSUMED_SIGMA = 0.3
"""Spread of the logarithm of the assumed over the true size: unlike drones are judged 25 to 55 % wrong."""
ASPECT_SIGMA, ASPECT_TIME_S = 0.1, 4.0
"""Spread of the logarithm of the apparent size by the side that is seen, as of drones that the networks do not know."""
WAY_SIGMA_M = 0.004
"""Error of the own motion in a step, each axis."""
FALSE_SHARE = 0.25
"""Of the time in which the first sees something fixed that is no drone, a few seconds at a time."""
_MIXED_EVERY = 4
"""In one of so many flights, flown once more, two of the four others are larger."""
AFTER_S = (6.0, 12.0, 15.0, 30.0)
CLIMB_M, CLIMB_M_S = 4.0, 1.0
STAGGERS_S = (0.0, 2.0, 5.0, 10.0)
"""Between one drone's take-off and the next one's."""


@dataclass
class Errors:
    """Errors of the logarithm of the published sizes, and their standard deviations, over flights."""

    of: int = 0
    errors: list[float] = field(default_factory=list)
    sigmas: list[float] = field(default_factory=list)

    def add(self, estimate: SizeEstimate | None, size_m: float) -> None:
        """Of one flight; None: it published none."""
        self.of += 1
        if estimate is not None:
            self.errors.append(math.log(estimate.size_m / size_m))
            self.sigmas.append(estimate.sigma)

    @property
    def row(self) -> str:
        """As a row of the table."""
        if not self.errors:
            return f"0 of {self.of}"
        off, sigma = np.array(self.errors), np.array(self.sigmas)
        median, p90, most = (100 * float(np.quantile(np.abs(off), share)) for share in (0.5, 0.9, 1.0))
        nees = float(np.mean((off / sigma) ** 2))
        return (
            f"{len(off)} of {self.of} | {median:.1f} / {p90:.1f} / {most:.1f} % | "
            f"{100 * float(np.median(off)):+.1f} % | {100 * float(np.median(sigma)):.1f} % | {nees:.2f}"
        )


class Sight:
    """What the first drone measures of the others."""

    def __init__(self, sizes_m: FloatArray, random: np.random.Generator, step_s: float) -> None:
        errors = load_perceived_errors(data_path("config") / "perceived" / "shipped_networks.yaml")
        self._table, self._sizes_m, self._random = perceived_flock.by_distance(errors), sizes_m, random
        self._keep = np.array([math.exp(-step_s / time_s) for time_s in (errors.error_time_s,) * 3 + (ASPECT_TIME_S,)])
        self._normal = random.normal(size=(DRONES, 4))
        self._factor = math.exp(random.normal(0.0, ASSUMED_SIGMA))
        self.judged_m = self._factor * float(sizes_m[1])
        self._false_at: FloatArray | None = None
        self._false = DRONES

    def step(self, positions: FloatArray) -> dict[int, Measurement]:
        """By the other's number, with all at (n, 3) m NED."""
        shock = self._random.normal(size=self._normal.shape)
        self._normal = self._keep * self._normal + np.sqrt(1 - self._keep**2) * shock
        seen = {}
        for j in range(1, DRONES):
            offset = positions[j] - positions[0]
            row = [np.interp(np.linalg.norm(offset), self._table[:, 0], column) for column in self._table.T]
            if self._random.normal() < row[perceived_flock.MISSED]:
                continue
            z = self._normal[j]
            of_range, *turns = (
                row[column] * number + row[column + 1] * number**3
                for column, number in zip((perceived_flock.RANGE, *[perceived_flock.BEARING] * 2), z[:3], strict=True)
            )
            seen[j] = self._measured(offset, of_range + ASPECT_SIGMA * z[3], turns, self._sizes_m[j])
        if self._random.random() < 0.1:
            self._false_at, self._false = None, self._false + 1
            if self._random.random() < FALSE_SHARE:
                self._false_at = positions[0] + self._random.normal(size=3) * [5.0, 5.0, 1.0]
        if self._false_at is not None:
            seen[self._false] = self._measured(
                self._false_at - positions[0], self._random.normal(0.0, 0.05), [0.0, 0.0], 0.9
            )
        return seen

    def _measured(self, offset: FloatArray, longer: float, turns: list[float], size_m: float) -> Measurement:
        range_m = float(np.linalg.norm(offset))
        ray = offset / range_m
        right = np.array([-ray[1], ray[0], 0.0]) / max(float(np.hypot(*ray[:2])), 1e-6)
        ray = ray + turns[0] * right + turns[1] * np.cross(ray, right)
        ray /= np.linalg.norm(ray)
        log_range = math.log(range_m * self._factor) + longer
        return Measurement(ray, log_range, log_polar_covariance(ray, 0.015, 0.004), size_m * self._factor)


def scenario(seed: int, random: np.random.Generator) -> ScenarioConfig:
    """The paper's circle from drawn places, in drawn gusts."""
    paper = load_scenario(data_path("config") / "paper_flight.yaml")
    while True:
        places = np.column_stack([random.uniform(-4, 4, (DRONES, 2)), random.uniform(-5, -3, DRONES)])
        apart = np.hypot(*(places[:, None, :2] - places[None, :, :2]).T) + 9 * np.eye(DRONES)
        if apart.min() > 1.5:
            break
    starts = [StartConfig(position_m=(n, e, d), velocity_m_s=(1.0, 0.0)) for n, e, d in places.tolist()]
    vehicle = paper.vehicle.model_copy(update={"gust_m_s": random.uniform(0.0, GUSTS_M_S)})
    return paper.model_copy(update={"vehicles": tuple(starts), "seed": seed, "vehicle": vehicle})


def fly(seed: int, by_time: dict[float, Errors], of_types: Errors, *, types: bool, watches: bool = False) -> None:
    """One flight; `types`: half of the others are 1.6 times as large. The first weaves, or only `watches` the others
    do so; `by_time` since the first weave began."""
    random = np.random.default_rng(seed)
    flown = scenario(seed, random)
    step_s = flown.drone.step_s
    sizes_m = SIZE_M * np.where(types & (np.arange(DRONES) > 2), 1.6, 1.0)
    flock, vehicles = ExactFlock(flown), Vehicles(flown.vehicles, flown.vehicle, yaw_rad=start_yaw(flown), seed=seed)
    sight, learned, weaves = Sight(sizes_m, random, step_s), FlockSize(), [
        Weave(flown.drone.safety.gate) for _ in range(DRONES)
    ]  # fmt: skip
    heights = np.array([-start.position_m[2] for start in flown.vehicles])
    began_s: float | None = None
    wove, before = [False] * DRONES, vehicles.position
    for step in range(round(DURATION_S / step_s)):
        time_s, here = step * step_s, vehicles.position
        way = here[0] - before[0] + random.normal(0.0, WAY_SIGMA_M, 3)
        measured = sight.step(here)
        learned.step(step_s, np.array([0.0, 0.0, way[2] if weaves[0].moves else 0.0]), measured)
        learned.keep({*range(1, DRONES), *measured})
        if began_s is not None and time_s - began_s in by_time:
            by_time[time_s - began_s].add(learned.of_looks(sight.judged_m), SIZE_M)
        commands = flock.step(time_s, here, vehicles.velocity)
        asked = heights.copy()
        for i, weave in enumerate(weaves):
            needed, others = (not wove[i] or weave.moves) and not (watches and i == 0), commands.neighbours[i]
            asked[i] = weave.height(time_s, -here[i, 2], -here[i, 2], heights[i], others, random, needed=needed)
            wove[i] |= weave.moves
        if began_s is None and any(weave.moves for weave in (weaves[1:] if watches else weaves[:1])):
            began_s = time_s
        vehicles.step(commands.velocity, commands.yaw_rad, step_s, asked)
        before = here
    for j in range(1, DRONES):
        of_types.add(learned.of_track(j), sizes_m[j])


def take_off(seed: int, stagger_s: float, seen_s: dict[float, Errors]) -> None:
    """The first climbs from the ground among four that stand there and follow, each so much later than the last."""
    random = np.random.default_rng(seed)
    flown = scenario(seed, random)
    step_s, sight, learned = flown.drone.step_s, Sight(np.full(DRONES, SIZE_M), random, flown.drone.step_s), FlockSize()
    turns = 2 * math.pi * (np.arange(DRONES) + random.uniform(0.0, 0.5, DRONES)) / (DRONES - 1)
    away_m = np.concatenate([[0.0], random.uniform(3.0, 8.0, DRONES - 1)])
    level = away_m[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
    before_m = 0.0
    for step in range(1, round(max(seen_s) / step_s) + 1):
        climbed_m = np.clip(CLIMB_M_S * (step * step_s - stagger_s * np.arange(DRONES)), 0.0, CLIMB_M)
        places = np.column_stack([level, -0.2 - climbed_m])
        wove = np.array([0.0, 0.0, before_m - climbed_m[0] + random.normal(0.0, WAY_SIGMA_M)])
        learned.step(step_s, wove, sight.step(places))
        before_m = float(climbed_m[0])
        if step * step_s in seen_s:
            seen_s[step * step_s].add(learned.of_looks(sight.judged_m), SIZE_M)


def print_take_off(flights: int) -> None:
    """A row for each time between take-offs, and each time since the first."""
    print("between take-offs, since the first | published | error: median / 90 % / largest | bias | sigma | NEES")
    for stagger_s in STAGGERS_S:
        seen_s = {after_s: Errors() for after_s in (3.0, 5.0, 10.0)}
        for seed in range(flights):
            take_off(seed, stagger_s, seen_s)
        for after_s, errors in seen_s.items():
            print(f"{stagger_s:.0f} s, {after_s:.0f} s | {errors.row}")


def main() -> None:
    """Flies and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=200, metavar="N")
    parser.add_argument("--take-off", action="store_true", help="learn from the own climb, not from a weave")
    arguments = parser.parse_args()
    flights = arguments.flights
    if arguments.take_off:
        print_take_off(flights)
        return
    for watches, who in ((False, "its own weave"), (True, "the first weave of another; it never does itself")):
        by_time, each, mixed = {after_s: Errors() for after_s in AFTER_S}, Errors(), Errors()
        for seed in range(flights):
            fly(seed, by_time, each, types=False, watches=watches)
            if seed % _MIXED_EVERY == 0:
                fly(seed, {}, mixed, types=True, watches=watches)
        print(f"since {who}, began | published | error: median / 90 % / largest | bias | sigma | NEES")
        for after_s, errors in by_time.items():
            print(f"{after_s:.0f} s | {errors.row}")
        print(f"each track's own, at {DURATION_S:.0f} s | {each.row}")
        print(f"the same, two of four 1.6 times as large | {mixed.row}")


if __name__ == "__main__":
    main()
