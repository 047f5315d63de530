"""Flies a flock through random forests with exact perception, without rendering, and counts collisions.

    python -m tools.measure.measure_obstacles --trees-per-hectare 100 --seeds 50 --duration 60 --speed 1.5
    python -m tools.measure.measure_obstacles --wall --seeds 10

Everything behind perception is the real thing: each drone has its own pilot, with tracker, local map, flocking law and
avoidance at the pilot's steps, and its own safety gate at 10 Hz. Perception is exact: the true bearings and ranges of
neighbours, and the true ranges of obstacles. Each seed draws another forest, north of the start; the wall stands across
the way, and has one gap to one side.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flockd.core.config import ScenarioConfig, load_scenario
from flockd.core.config.obstacle_field import ObstaclesConfig
from flockd.core.messages import Detection, EgoMotion, FloatArray, FrameSet, PilotOutput, VehicleState
from flockd.flight.flocking.metrics import min_distance, order, union
from flockd.flight.obstacles import nearest_points
from flockd.flight.perception import Observation
from flockd.flight.perception.detection.detector import DetectionTrace
from flockd.flight.pilot import FlockPilot
from flockd.flight.safety import Action, Gate, Permission, Surroundings, Wanted
from flockd.flight.tracking import Prediction
from flockd.sim.vehicles import Vehicles
from flockd.sim.worlds.obstacle_worlds import generate_obstacles
from flockd.sim.worlds.obstacles import Box, Obstacles, true_ranges

SCENARIO = Path(__file__).resolve().parents[2] / "config" / "square.yaml"
TICK_S = 0.1
"""Of the gate, which flies at half of that: the rarer it looks, the later it brakes."""
SOUTH_M, EXTENT_M = -40.0, 60.0
"""Where the flock begins, and how far the forest reaches from the origin: 90 m of flight end within it."""
BEARING_SIGMA, LOG_RANGE_SIGMA = 0.005, 0.01
"""Of exact detections: what the tracker is told, though they have no error."""


def main() -> None:
    """Prints a JSON object a seed, and one of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trees-per-hectare", type=float, default=100.0)
    parser.add_argument("--wall", action="store_true", help="a wall with a gap instead of a forest")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--duration", type=float, default=60.0, metavar="S")
    parser.add_argument("--speed", type=float, default=1.5, metavar="M_S")
    parser.add_argument("--gust", type=float, default=0.0, metavar="M_S", help="deviation of the gusts' velocity")
    parser.add_argument("--dark", action="store_true", help="nobody sees obstacles: for comparison")
    args = parser.parse_args()
    rows = []
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        scenario = scenario_of(seed, args.duration, args.speed, args.gust, enabled=not args.dark)
        obstacles = wall(seed) if args.wall else forest(scenario, args.trees_per_hectare)
        rows.append({"seed": seed, **Flight(scenario, obstacles).fly()})
        print(json.dumps(rows[-1]), flush=True)
    print(json.dumps(summary(rows)))


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Of all seeds."""
    return {
        "seeds": len(rows),
        "with_collision": [row["seed"] for row in rows if row["hits"] or row["touches"]],
        "min_clearance_m": min(row["min_clearance_m"] for row in rows),
        "min_distance_m": min(row["min_distance_m"] for row in rows),
        "share_with_union_1": float(np.mean([row["union"] == 1.0 for row in rows])),
        "median_way_m": float(np.median([row["way_m"] for row in rows])),
        "least_way_m": min(row["way_m"] for row in rows),
        "widest_m": max(row["widest_m"] for row in rows),
        "mean_order": round(float(np.mean([row["order"] for row in rows])), 3),
        "step_ms": round(float(np.median([row["step_ms"] for row in rows])), 2),
    }


def scenario_of(seed: int, duration_s: float, speed_m_s: float, gust_m_s: float, *, enabled: bool) -> ScenarioConfig:
    """Five drones that want to fly north, each from up to half a metre beside its place."""
    scenario = load_scenario(SCENARIO, {"duration_s": duration_s, "seed": seed})
    rng = np.random.default_rng([seed, 7])
    vehicles = []
    for start in scenario.vehicles:
        north_m, east_m = rng.uniform(-0.5, 0.5, 2)
        position_m = (
            start.position_m[0] + SOUTH_M + float(north_m),
            start.position_m[1] + float(east_m),
            start.position_m[2],
        )
        vehicles.append(start.model_copy(update={"position_m": position_m}))
    drone = scenario.drone
    mission = type(drone.mission)(kind="velocity", velocity_m_s=(speed_m_s, 0.0))
    gate = drone.safety.gate.model_copy(update={"fence_radius_m": None})
    drone = drone.model_copy(
        update={
            "mission": mission,
            "own_velocity": "autopilot",
            "obstacles": drone.obstacles.model_copy(update={"enabled": enabled}),
            "safety": drone.safety.model_copy(update={"gate": gate}),
        }
    )
    vehicle = scenario.vehicle.model_copy(update={"gust_m_s": gust_m_s})
    return scenario.model_copy(update={"vehicles": tuple(vehicles), "drone": drone, "vehicle": vehicle})


def forest(scenario: ScenarioConfig, trees_per_hectare: float) -> Obstacles:
    """As `config/forest.yaml` has it, drawn from the scenario's seed."""
    config = ObstaclesConfig(kind="forest", trees_per_hectare=trees_per_hectare, extent_m=EXTENT_M)
    return generate_obstacles(config, scenario.seed, np.array([start.position_m[:2] for start in scenario.vehicles]))


def wall(seed: int) -> Obstacles:
    """60 m wide and 20 m north of the start, with one gap of 5 m."""
    rng = np.random.default_rng([seed, 13])
    gap = float(rng.uniform(8.0, 20.0) * rng.choice([-1.0, 1.0]))
    ends = (-30.0, gap - 2.5), (gap + 2.5, 30.0)
    return Obstacles([Box(SOUTH_M + 20.0, (a + b) / 2, 0.2, (b - a) / 2, 0.0, -0.5, 8.0) for a, b in ends])


class ExactObserver:
    """The truth in perception's place, for one drone."""

    def __init__(self) -> None:
        self.now: Observation | None = None

    def observe(
        self,
        frames: FrameSet,
        vehicle: VehicleState,
        predictions: Sequence[Prediction],
        trace: DetectionTrace | None,
        lap: Callable[[str], None],
    ) -> Observation:
        """What was put there."""
        assert self.now is not None
        return self.now

    def see_slope(self, slope: FloatArray) -> None:
        """The truth has its own."""


class ExactPilot(FlockPilot):
    """A pilot whose ego-motion is what its autopilot says."""

    def _ego_motion(self, observation: Observation) -> tuple[EgoMotion | None, Sequence[str]]:
        before, vehicle = observation.previous, observation.vehicle
        if before is None or vehicle.position is None or before.vehicle.position is None:
            return None, ()
        way = np.array([*(vehicle.position - before.vehicle.position), before.vehicle.height_m - vehicle.height_m])
        R_C_ned = before.vehicle.R_ned_body.T
        return EgoMotion(R_C_ned @ vehicle.R_ned_body, R_C_ned @ way, observation.interval_s, 100, 100, 0.0), ()


class Flight:
    """Pilots and gates of all drones of a scenario, among obstacles."""

    def __init__(self, scenario: ScenarioConfig, obstacles: Obstacles) -> None:
        self._scenario, self._obstacles = scenario, obstacles
        self._count = len(scenario.vehicles)
        self._vehicles = Vehicles(scenario.vehicles, scenario.vehicle, seed=scenario.seed)
        self._observers = [ExactObserver() for _ in range(self._count)]
        networks: Any = object()  # never asked for anything
        self._pilots = [ExactPilot(scenario.drone, networks, observer=seen) for seen in self._observers]
        self._gates = [Gate(scenario.drone.safety.gate) for _ in range(self._count)]
        self._heights = np.array([-vehicle.position_m[2] for vehicle in scenario.vehicles])
        self._clearances: list[FloatArray] = []
        self._distances: list[float] = []
        self.positions: list[FloatArray] = []

    def fly(self) -> dict[str, Any]:
        """The whole flight, and how it went."""
        step_s = self._scenario.drone.step_s
        took_s, objections = [], 0
        velocities = []
        for step in range(round(self._scenario.duration_s / step_s)):
            time_s = step * step_s
            begin = time.process_time()
            outputs = [self._step(i, time_s) for i in range(self._count)]
            took_s.append((time.process_time() - begin) / self._count)
            self.positions.append(self._vehicles.position)
            velocities.append(self._vehicles.velocity)
            for tick in range(round(step_s / TICK_S)):
                objections += self._tick(time_s, tick * TICK_S, outputs)
        clearances, ends = np.array(self._clearances), self._vehicles.position
        reach_m = self._scenario.drone.flocking.observation_distance_m
        radius_m = self._scenario.vehicle.radius_m
        middle = np.mean(self.positions, axis=1)
        return {
            "hits": int((clearances < radius_m).any(axis=0).sum()),
            "touches": int(min(self._distances) < 2 * radius_m),
            "min_clearance_m": round(float(clearances.min()), 3),
            "min_distance_m": round(min(self._distances), 3),
            "union": union(ends[:, :2], reach_m),
            "order": round(float(np.mean([order(v[:, :2]) for v in velocities])), 3),
            "way_m": round(float(middle[-1, 0] - middle[0, 0]), 1),
            "widest_m": round(max(float(np.ptp(places[:, :2], axis=0).max()) for places in self.positions), 1),
            "gate_objections": objections,
            "step_ms": round(1e3 * float(np.mean(took_s)), 2),
        }

    def _step(self, i: int, time_s: float) -> PilotOutput:
        v = self._vehicles
        state = VehicleState(time_s, v.R_ned_body[i], -float(v.position[i, 2]), v.velocity[i], v.position[i, :2])
        ranges = true_ranges(self._obstacles, time_s, v.position[i])
        detections = tuple(
            _detection(v.R_ned_body[i].T @ (v.position[j] - v.position[i]), j + 1) for j in range(self._count) if j != i
        )
        observer = self._observers[i]
        before = None if observer.now is None else replace(observer.now, previous=None)
        observer.now = Observation(time_s, state, {}, detections, before, obstacles=ranges)
        return self._pilots[i].step(FrameSet(time_s, {}), state)

    def _tick(self, step_s: float, age_s: float, outputs: Sequence[PilotOutput]) -> int:
        """One tick of all gates, and the flight until the next; how many objections there were."""
        now_s, v = step_s + age_s, self._vehicles
        setpoints, count = np.zeros((self._count, 2)), 0
        for i, output in enumerate(outputs):
            own = v.velocity[i]
            confirmed = [n for n in output.neighbours if n.confirmed]
            points = np.empty((0, 2))
            if output.obstacles is not None:
                points = nearest_points(output.obstacles, self._scenario.drone.obstacles.sigmas) - age_s * own[:2]
            around = Surroundings(
                position=v.position[i, :2],
                velocity=own[:2],
                yaw_rad=0.0,
                neighbours=np.reshape([n.position + age_s * (n.velocity - own) for n in confirmed], (-1, 3)),
                neighbour_velocities=np.reshape([n.velocity[:2] for n in confirmed], (-1, 2)),
                height_m=-float(v.position[i, 2]),
                obstacles=points,
            )
            wanted = Wanted(output.command, step_s, float(self._heights[i]))
            verdict = self._gates[i].step(now_s, Permission(Action.FLY, now_s), wanted, around)
            count += bool(verdict.objections)
            if verdict.setpoint is not None:
                setpoints[i] = verdict.setpoint.velocity
        v.step(setpoints, np.zeros(self._count), TICK_S)
        self._clearances.append(self._obstacles.clearance(v.position))
        self._distances.append(min_distance(v.position))
        return count


def _detection(offset: FloatArray, label: int) -> Detection:
    """Of a drone at `offset` (3,) m from this one, body axes."""
    range_m = float(np.linalg.norm(offset))
    along = np.outer(offset, offset) / range_m**2
    covariance = LOG_RANGE_SIGMA**2 * along + BEARING_SIGMA**2 * (np.eye(3) - along)
    return Detection(offset / range_m, math.log(range_m), covariance, 1.0, 0.6, (), label)


if __name__ == "__main__":
    main()
