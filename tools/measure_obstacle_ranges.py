"""What the depth network says of obstacles: ranges by sight against the true ones, in a rendered world.

    python -m tools.measure_obstacle_ranges config/forest.yaml --seed 100 --places 12
    python -m tools.measure_obstacle_ranges config/village.yaml --seed 100 --places 12 --true-depth

One image set of the first drone at each of a row of places along the way. A sector whose true range is R counts as
missed where neither it nor the sectors beside it show anything nearer than 1.5 R, and as false where it shows something
nearer than 0.67 R with nothing true as near beside it. The error is of sectors that are neither.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path

import numpy as np

from flockd.config import ScenarioConfig, load_scenario
from flockd.messages import FloatArray
from flockd.perception import Perception, load_networks
from flockd.perception.obstacles import ObstacleRanging
from flockd.sim.camera_simulator import CameraSimulator
from flockd.sim.obstacle_worlds import obstacles_of
from flockd.sim.obstacles import true_ranges
from flockd.sim.truth_perception import TruthPerception
from flockd.sim.vehicles import SimulatedAutopilot, Vehicles

BINS_M = (0.0, 3.0, 6.0, 10.0)
LEAST_CLEARANCE_M = 1.0
"""Places nearer to an obstacle are left out: no drone flies there."""
EXTENT_M = 45.0
"""The places lie no farther from the origin, north and east: beyond 60 m nothing stands."""
ALL = frozenset({"depth", "segmentation", "distance"})
STEP_M = 5.0
"""Between two places."""


def main() -> None:
    """Prints a JSON object for each span of true ranges."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", type=Path)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--places", type=int, default=12)
    parser.add_argument(
        "--true-depth", action="store_true", help="of the renderer: what is left is geometry's own error"
    )
    args = parser.parse_args()
    pairs = measured(load_scenario(args.scenario, {"seed": args.seed}), args.places, true_depth=args.true_depth)
    for low, high in itertools.pairwise(BINS_M):
        print(json.dumps({"from_m": low, "to_m": high, **figures(pairs, low, high)}))
    free = np.isinf(pairs[..., 0])
    print(json.dumps({"free_sectors": int(free.sum()), "with_something_within_6_m": _share(pairs[..., 1][free] < 6.0)}))


def measured(scenario: ScenarioConfig, places: int, *, true_depth: bool) -> FloatArray:
    """(places, n, 2): of each place and sector the true range and the one by sight."""
    cameras, obstacles = CameraSimulator(scenario), obstacles_of(scenario)
    drone = scenario.drone
    learned = load_networks(drone.perception)
    ranging, pairs = ObstacleRanging(cameras.rig, drone.obstacles), []
    for number in range(10 * places):
        moved = tuple(
            start.model_copy(update={"position_m": (start.position_m[0] + STEP_M * number, *start.position_m[1:])})
            for start in scenario.vehicles
        )
        vehicles = Vehicles(moved, scenario.vehicle, seed=number)
        if len(pairs) == places or np.abs(vehicles.position[0, :2]).max() > EXTENT_M:
            break
        if obstacles.clearance(vehicles.position).min() < LEAST_CLEARANCE_M:
            continue
        frames, truth = cameras.capture(0, number, float(number), vehicles)
        seen = TruthPerception(
            learned, frozenset({"depth", "segmentation", "distance"} if true_depth else ()), cameras.rig
        )
        seen.show(truth)
        autopilot = SimulatedAutopilot(scenario.sensors, seed=scenario.seed, drone=0)
        state = autopilot.read(float(number), vehicles.position[0], vehicles.velocity[0], vehicles.R_ned_body[0])
        found = ranging.ranges(Perception(cameras.rig, seen, drone.perception).observe(frames, state))
        true = true_ranges(obstacles, 0.0, vehicles.position[0], limit_m=drone.obstacles.range_m)
        pairs.append(np.stack([true.range_m, found.range_m], axis=1))
    return np.array(pairs)


def figures(pairs: FloatArray, low_m: float, high_m: float) -> dict[str, float | int]:
    """Of the sectors whose true range lies between two."""
    true, found = pairs[..., 0], pairs[..., 1]
    chosen = (true >= low_m) & (true < high_m)
    missed = chosen & (_beside(found) > 1.5 * true)
    false = chosen & (found < 0.67 * _beside(true))
    good = chosen & ~missed & ~false & np.isfinite(found)
    error = np.log(found[good] / true[good]) if good.any() else np.zeros(1)
    return {
        "sectors": int(chosen.sum()),
        "missed": _share(missed[chosen]),
        "false": _share(false[chosen]),
        "log_error_median": round(float(np.median(error)), 3),
        "log_error_deviation": round(float(1.4826 * np.median(np.abs(error - np.median(error)))), 3),
    }


def _beside(ranges: FloatArray) -> FloatArray:
    """The nearest of each sector and of those beside it."""
    nearest: FloatArray = np.min([np.roll(ranges, shift, axis=1) for shift in (-1, 0, 1)], axis=0)
    return nearest


def _share(chosen: FloatArray) -> float:
    return round(float(np.mean(chosen)), 3) if len(chosen) else 0.0


if __name__ == "__main__":
    main()
