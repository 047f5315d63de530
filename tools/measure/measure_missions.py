"""Prints how flocks kept to their missions: scenarios, flown on exact states over many seeds, and flights flown before.

    python -m tools.measure.measure_missions config/square.yaml --seeds 10
    python -m tools.measure.measure_missions config/one_knows.yaml --seeds 10 --gust 0.3
    flockd sim config/square.yaml --out out/square; python -m tools.measure.measure_missions out/square

Each seed moves every start by up to half a metre and draws other gusts; seed 0 of --jitter 0 is the scenario as it is.
A waypoint's distance is the nearest that the true middle of the flock came to it, in order of the waypoints. Order is
of the flock under way: until its middle has come to the last waypoint. There it slows down and holds, and
directions are those of the gusts.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flockd.core.config import ScenarioConfig, load_scenario
from flockd.core.messages import FloatArray
from flockd.flight.flocking.metrics import min_distance, order, union
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.flight_folder import LOG_NAME
from flockd.review.report.summary import summarise
from flockd.sim.exact_states import fly_exact_states

TAIL_S = 10.0
FLYING_M_S = 0.2
"""Order is of steps in which the middle flies faster than this: at a standstill directions are noise."""
PASSED_M = 2.0
"""A waypoint counts as passed when the middle is as near."""
TURN_S = 8.0
"""A turn is so long, from when the middle is `PASSED_M` from a waypoint that others follow."""


def main() -> None:
    """Prints a JSON object a flight, and one of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flown", type=Path, nargs="+", metavar="SCENARIO|FLIGHT")
    parser.add_argument("--seeds", type=int, default=10, help="of each scenario")
    parser.add_argument("--gust", type=float, default=0.0, metavar="M_S", help="deviation of the gusts' velocity")
    parser.add_argument("--jitter", type=float, default=0.5, metavar="M", help="of each start, north and east")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for path in args.flown:
        if path.is_dir():
            try:
                rows.append(of_flight(path))
            except (OSError, ValueError) as error:
                parser.error(f"{path} is not the folder of a flight that `flockd sim` wrote: {error}")
        else:
            scenario = load_scenario(path)
            rows += [on_exact_states(varied(scenario, seed, args.jitter, args.gust)) for seed in range(args.seeds)]
    for row in rows:
        print(json.dumps(row))
    print(json.dumps(_of_all(rows)))


def _of_all(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The worst of all flights, and the means of their orders."""
    orders = [row["order_flying"] for row in rows if row["order_flying"] is not None]
    return {
        "flights": len(rows),
        "farthest_from_a_waypoint_m": max((max(row["waypoints_m"], default=0.0) for row in rows), default=0.0),
        "widest_at_the_end_m": max(row["widest_at_the_end_m"] for row in rows),
        "closest_m": min(row["closest_m"] for row in rows),
        "least_order_flying": min(
            (row["order_flying"] for row in rows if row["order_flying"] is not None), default=None
        ),
        "mean_order_flying": _mean(orders),
        "mean_order_turning": _mean([row["order_turning"] for row in rows]),
        "least_union": min(row["union_tail"] for row in rows),
    }


def varied(scenario: ScenarioConfig, seed: int, jitter_m: float, gust_m_s: float) -> ScenarioConfig:
    """The scenario with other starts and gusts."""
    rng = np.random.default_rng([seed, 7])
    vehicles = []
    for start in scenario.vehicles:
        north_m, east_m = rng.uniform(-jitter_m, jitter_m, 2)
        position_m = (start.position_m[0] + float(north_m), start.position_m[1] + float(east_m), start.position_m[2])
        vehicles.append(start.model_copy(update={"position_m": position_m}))
    vehicle = scenario.vehicle.model_copy(update={"gust_m_s": gust_m_s})
    return scenario.model_copy(update={"vehicles": tuple(vehicles), "vehicle": vehicle, "seed": seed})


def on_exact_states(scenario: ScenarioConfig) -> dict[str, Any]:
    """Flies a scenario on exact states, and measures that."""
    reach_m = scenario.drone.flocking.observation_distance_m
    return {
        "seed": scenario.seed,
        **measured(*fly_exact_states(scenario), _waypoints(scenario), reach_m),
    }


def of_flight(folder: Path) -> dict[str, Any]:
    """Measures a flight that `flockd sim` left in ``folder``, and adds what its summary says of its perception."""
    log = FlightLog.load(folder / LOG_NAME)
    goals = log.goal[np.isfinite(log.goal).all(axis=1)]
    waypoints = np.array(list(dict.fromkeys(map(tuple, goals.tolist())))).reshape(-1, 2)
    summary = summarise(log)
    return {
        "flight": folder.name,
        "seed": log.metadata.seed,
        **measured(log.time_s, log.position, log.velocity, waypoints, log.metadata.observation_distance_m),
        "mission": summary["mission"],
        "obstacles": summary["obstacles"],
        "neighbours": summary["neighbours"],
    }


def measured(
    times: FloatArray, position: FloatArray, velocity: FloatArray, waypoints: FloatArray, reach_m: float
) -> dict[str, Any]:
    """How a flight of true states (S, N, 3) at ``times`` (S,) went along waypoints (n, 2) metres.

    ``reach_m``: how far drones see each other, for the union.
    """
    middle = position[..., :2].mean(axis=1)
    tail = np.flatnonzero(times >= times[-1] - TAIL_S)
    nearest_m, passed = _passed(middle, waypoints)
    moving = np.linalg.norm(velocity[..., :2].mean(axis=1), axis=1) > FLYING_M_S
    under_way = moving & (np.arange(len(times)) < (passed[-1] if len(passed) else len(times)))
    turning = np.zeros(len(times), dtype=bool)
    for step in passed[:-1]:
        turning |= (times >= times[step]) & (times < times[step] + TURN_S)
    orders = np.array([order(velocities[:, :2]) for velocities in velocity])
    return {
        "waypoints_m": nearest_m,
        "widest_at_the_end_m": round(_widest(position[-1]), 3),
        "widest_m": round(max(_widest(places) for places in position), 3),
        "closest_m": round(min(min_distance(places) for places in position), 3),
        "order_flying": _mean(orders[under_way]),
        "order_turning": _mean(orders[under_way & turning]),
        "union_tail": round(float(np.mean([union(position[s, :, :2], reach_m) for s in tail])), 4),
    }


def _mean(values: Sequence[float | None] | FloatArray) -> float | None:
    known = [value for value in values if value is not None]
    return round(float(np.mean(known)), 4) if known else None


def _waypoints(scenario: ScenarioConfig) -> FloatArray:
    """(n, 2) metres, of the first drone that has any."""
    missions = [scenario.drone_of(i).mission for i in range(len(scenario.vehicles))]
    waypoints = next((mission.waypoints for mission in missions if mission.waypoints), ())
    return np.array([(waypoint.north_m, waypoint.east_m) for waypoint in waypoints], dtype=float).reshape(-1, 2)


def _passed(middle: FloatArray, waypoints: FloatArray) -> tuple[list[float], list[int]]:
    """The nearest that the middle (S, 2) came to each waypoint, and the steps in which it was there first.

    Each is looked for after the one before. A waypoint that was not passed counts from the step nearest to it.
    """
    nearest, steps, since = [], [], 0
    for waypoint in waypoints:
        away_m = np.linalg.norm(middle[since:] - waypoint, axis=1)
        within = np.flatnonzero(away_m <= PASSED_M)
        first = int(within[0]) if len(within) else int(np.argmin(away_m))
        since += first
        nearest.append(round(float(away_m[first : first + 10].min()), 3))
        steps.append(since)
    return nearest, steps


def _widest(places: FloatArray) -> float:
    """The largest level distance of two drones at (n, 3) m."""
    plan = places[:, :2]
    return float(np.linalg.norm(plan[:, None] - plan, axis=-1).max())


if __name__ == "__main__":
    main()
