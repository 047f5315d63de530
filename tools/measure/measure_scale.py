"""How well the own motion's scale is known by range finder and by barometer, in worlds and on paths of a scenario.

python -m tools.measure.measure_scale config/hills.yaml --seeds 0 1 2 --duration 20

Each chosen drone flies the path of the scenario with exact states. It gets the same images and the same autopilot once
for each source of the height, so that nothing but that source differs.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import numpy as np

from flockd.core.choices import HeightSource
from flockd.core.config import DroneConfig, load_scenario
from flockd.core.config.scenario import ScenarioConfig
from flockd.core.messages import FloatArray, PilotOutput
from flockd.flight.perception import load_networks
from flockd.flight.pilot import FlockPilot
from flockd.sim.camera_simulator import CameraSimulator
from flockd.sim.exact_states import ExactFlock, start_yaw, step_times
from flockd.sim.vehicles import SimulatedAutopilot, Vehicles

SETTLED_S = 6.0
"""Before, the range finder has not measured yet what the cameras see behind the drone."""
LEAST_STEP_M = 0.1
"""A shorter step says nothing of the scale."""


@dataclass
class Errors:
    """Of one drone's steps with one source of the height."""

    along_m: list[float] = field(default_factory=list)
    """Of the ego-translation of a step, along the course; with its sign."""
    scale: list[float] = field(default_factory=list)
    """The own speed over the true one, less 1."""
    height: list[float] = field(default_factory=list)
    """The height above ground that was used over the true one, less 1."""
    settled: list[bool] = field(default_factory=list)
    """Of each entry of `along_m`: after `SETTLED_S`."""
    missing: int = 0

    def figures(self) -> dict[str, float]:
        """Largest and median, of sizes."""
        along, scale, height = (np.abs(values) for values in (self.along_m, self.scale, self.height))
        later = along[np.array(self.settled)] if any(self.settled) else np.array([np.nan])
        return {
            "steps": len(along), "missing": self.missing,
            "along_largest_m": float(along.max()), "along_median_m": float(np.median(along)),
            "settled_largest_m": float(later.max()), "settled_median_m": float(np.median(later)),
            "scale_largest": float(scale.max()), "scale_median": float(np.median(scale)),
            "scale_bias": float(np.median(self.scale)), "height_median": float(np.median(height)),
        }  # fmt: skip


def measure(scenario: ScenarioConfig, drone: int, sources: tuple[HeightSource, ...]) -> dict[str, Errors]:
    """One drone's flight by each source."""
    cameras, networks = CameraSimulator(scenario), load_networks(scenario.drone.perception)
    flock = ExactFlock(scenario)
    vehicles = Vehicles(scenario.vehicles, scenario.vehicle, yaw_rad=start_yaw(scenario), seed=scenario.seed)
    autopilot = SimulatedAutopilot(scenario.sensors, seed=scenario.seed, drone=drone, ground=cameras.ground_height)
    pilots = {source: FlockPilot(_with_height(scenario, drone, source), networks) for source in sources}
    found: dict[str, Errors] = {source: Errors() for source in sources}
    before = None
    for step, time_s in enumerate(step_times(scenario)):
        position, R_ned_body = vehicles.position[drone], vehicles.R_ned_body[drone]
        frames, _ = cameras.capture(drone, step, float(time_s), vehicles)
        state = autopilot.read(float(time_s), position, vehicles.velocity[drone], R_ned_body)
        ground_m = float(cameras.ground_height(position[:1], position[1:2])[0])
        for source, pilot in pilots.items():
            output = pilot.step(frames, state)
            used_m = state.height_m if output.ground is None else output.ground.height_m
            found[source].height.append(used_m / (-float(position[2]) - ground_m) - 1.0)
            if before is not None:
                _judge(output, before[1].T @ (position - before[0]), found[source], settled=time_s > SETTLED_S)
        before = position, R_ned_body
        commands = flock.step(float(time_s), vehicles.position, vehicles.velocity)
        vehicles.step(commands.velocity, commands.yaw_rad, scenario.drone.step_s, commands.height_m)
    return found


def _with_height(scenario: ScenarioConfig, drone: int, source: HeightSource) -> DroneConfig:
    config = scenario.drone_of(drone)
    return config.model_copy(update={"perception": config.perception.model_copy(update={"height": source})})


def _judge(output: PilotOutput, moved: FloatArray, errors: Errors, *, settled: bool) -> None:
    """``moved`` (3,) m in the body frame at the step's start."""
    if output.ego_motion is None:
        errors.missing += 1
        return
    length_m = float(np.linalg.norm(moved))
    along_m = float(output.ego_motion.translation @ moved) / max(length_m, 1e-9)
    errors.along_m.append(along_m - length_m)
    errors.settled.append(bool(settled))
    if length_m > LEAST_STEP_M:
        errors.scale.append(float(np.linalg.norm(output.ego_motion.translation)) / length_m - 1.0)


def main() -> int:
    """Reads the command line and prints one line of JSON for each seed, drone and source, and then for all."""
    parser = argparse.ArgumentParser(description="Measures the scale of the own motion by each source of the height.")
    parser.add_argument("scenario", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--drones", type=int, nargs="+", default=[1], help="which drones fly, from 1 (1)")
    parser.add_argument("--duration", type=float, default=20.0, help="seconds (20)")
    parser.add_argument("--heights", nargs="+", choices=get_args(HeightSource), default=["range_finder", "barometer"])
    args = parser.parse_args()
    pooled: dict[str, Errors] = {source: Errors() for source in args.heights}
    for seed in args.seeds:
        scenario = load_scenario(args.scenario, {"seed": seed, "duration_s": args.duration})
        for drone in args.drones:
            for source, errors in measure(scenario, drone - 1, tuple(args.heights)).items():
                print(json.dumps({"seed": seed, "drone": drone, "height": source, **errors.figures()}), flush=True)
                for name in ("along_m", "scale", "height", "settled"):
                    getattr(pooled[source], name).extend(getattr(errors, name))
                pooled[source].missing += errors.missing
    for source, errors in pooled.items():
        print(json.dumps({"seeds": args.seeds, "drones": args.drones, "height": source, **errors.figures()}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
