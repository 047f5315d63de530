"""What the depth network says of obstacles: ranges by sight against the true ones, in a rendered world.

    python -m tools.measure.measure_obstacle_ranges config/forest.yaml --seed 100 --places 12
    python -m tools.measure.measure_obstacle_ranges config/village.yaml --seed 100 --places 12 --true

Two image sets of the first drone at each of a row of places along the way, and the ranges of the second. A sector
whose true range is R counts as missed where neither it nor the sectors beside it show anything nearer than 1.5 R, and
as false where it shows something nearer than 0.67 R with nothing true as near beside it. The error is of sectors that
are neither.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path

import numpy as np

from flockd.core.config import ScenarioConfig, load_scenario
from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.obstacles import ObstacleRanging
from flockd.flight.perception import Perception, load_networks
from flockd.flight.pilot.motions import ego_motion
from flockd.sim.camera_simulator import CameraSimulator
from flockd.sim.truth_perception import TruthPerception
from flockd.sim.vehicles import SimulatedAutopilot, Vehicles
from flockd.sim.worlds.obstacle_worlds import obstacles_of
from flockd.sim.worlds.obstacles import true_ranges

BINS_M = (0.0, 3.0, 6.0, 10.0)
LEAST_CLEARANCE_M = 1.0
"""Places nearer to an obstacle are left out: no drone flies there."""
EXTENT_M = 45.0
"""The places lie no farther from the origin, north and east: beyond 60 m nothing stands."""
ALL = frozenset({"depth", "segmentation", "distance", "flow"})
STEP_M = 5.0
"""Between two places."""
WAY_M = 0.75
"""Between the two images of a place: half a second at 1.5 m/s."""
NEAR_M = 6.0


def main() -> None:
    """Prints a JSON object for each span of true ranges."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", type=Path)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--places", type=int, default=12)
    parser.add_argument("--true", action="store_true", help="of the renderer: what is left is geometry's own error")
    args = parser.parse_args()
    by_depth, by_both = measured(load_scenario(args.scenario, {"seed": args.seed}), args.places, true=args.true)
    for name, pairs in (("depth", by_depth), ("depth and flow", by_both)):
        for low, high in itertools.pairwise(BINS_M):
            print(json.dumps({"by": name, "from_m": low, "to_m": high, **figures(pairs, low, high)}))
        free = np.isinf(pairs[..., 0])
        near = _share(pairs[..., 1][free] < NEAR_M)
        print(json.dumps({"by": name, "free_sectors": int(free.sum()), "with_something_within_6_m": near}))


def measured(scenario: ScenarioConfig, places: int, *, true: bool) -> tuple[FloatArray, FloatArray]:
    """(places, n, 2): of each place and sector the true range and the one by sight; by depth, and by flow as well."""
    cameras, obstacles = CameraSimulator(scenario), obstacles_of(scenario)
    drone, learned = scenario.drone, load_networks(scenario.drone.perception)
    ranging = ObstacleRanging(cameras.rig, drone.obstacles)
    pairs: tuple[list[FloatArray], list[FloatArray]] = [], []
    for number in range(10 * places):
        vehicles = [_flock_at(scenario, STEP_M * number + way_m) for way_m in (0.0, WAY_M)]
        here = vehicles[1].position[0]
        if len(pairs[0]) == places or np.abs(here[:2]).max() > EXTENT_M:
            break
        if min(float(obstacles.clearance(flock.position).min()) for flock in vehicles) < LEAST_CLEARANCE_M:
            continue
        networks = TruthPerception(learned, ALL if true else frozenset(), cameras.rig)
        perception = Perception(cameras.rig, networks, drone.perception)
        autopilot = SimulatedAutopilot(scenario.sensors, seed=scenario.seed, drone=0)
        for step, flock in enumerate(vehicles):
            frames, truth = cameras.capture(0, step, drone.step_s * step, flock)
            networks.show(truth)
            state = autopilot.read(drone.step_s * step, flock.position[0], flock.velocity[0], flock.R_ned_body[0])
            observation = perception.observe(frames, state)
        exact_m = true_ranges(obstacles, 0.0, here, limit_m=drone.obstacles.range_m).range_m
        ego = ego_motion(cameras.rig, observation, drone.geometry)
        for found, motion in zip(pairs, (None, ego), strict=True):
            found.append(np.stack([exact_m, ranging.ranges(observation, motion).range_m], axis=1))
    return np.array(pairs[0]), np.array(pairs[1])


def _flock_at(scenario: ScenarioConfig, way_m: float) -> Vehicles:
    """All drones, so far north of their starts."""
    moved = tuple(
        start.model_copy(update={"position_m": (start.position_m[0] + way_m, *start.position_m[1:])})
        for start in scenario.vehicles
    )
    return Vehicles(moved, scenario.vehicle, seed=0)


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


def _share(chosen: BoolArray) -> float:
    return round(float(np.mean(chosen)), 3) if len(chosen) else 0.0


if __name__ == "__main__":
    main()
