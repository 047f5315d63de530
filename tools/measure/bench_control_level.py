"""How many drone-steps a second flights at control level take, beside a loop over single pilots.

    OMP_NUM_THREADS=1 python -m tools.measure.bench_control_level [--processes 2] [--forest]

A drone-step is all of one drone's step of 0.5 s: neighbours, law, mission, 25 steps of the vehicle's motion, and the
flock's figures. `a core` is drone-steps over a process's own processor time, which other work on the machine changes
little; `together` is over the wall time of all processes at once. The anchor is `fly_exact_states`, which steps one
drone's law after the other and takes no figures. With `--forest` only flights among 100 trees a
hectare are timed; drawing a flight's forest counts too.
"""

from __future__ import annotations

import argparse
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

from flockd.core.config import ScenarioConfig, load_scenario
from flockd.core.config.loader import load_perceived_errors
from flockd.core.data import data_path
from flockd.sim.control_level import fly_flocks
from flockd.sim.exact_states import fly_exact_states
from flockd.sim.start import scattered, with_drones

UNIFORM: dict[str, Any] = {"kind": "uniform"}
NEAREST: dict[str, Any] = {"kind": "nearest", "nearest": 6}
HEIGHT_M, SCATTER_M = 4.5, 0.5
ERRORS = data_path("config") / "perceived" / "shipped_networks.yaml"


class Case(NamedTuple):
    """What is timed."""

    drones: int
    flights: int
    weight: dict[str, Any]
    duration_s: float
    measured: bool = False
    forest: bool = False
    gated: bool = False


CASES = (
    Case(5, 200, UNIFORM, 60.0),
    Case(5, 200, NEAREST, 60.0),
    Case(100, 10, NEAREST, 60.0),
    Case(1000, 1, NEAREST, 110.0),
    Case(1000, 1, UNIFORM, 30.0),
    Case(5, 200, UNIFORM, 10.0, measured=True),
    Case(1000, 1, NEAREST, 20.0, measured=True),
    Case(5, 20, NEAREST, 60.0, forest=True),
    Case(100, 1, NEAREST, 60.0, forest=True),
    Case(5, 20, NEAREST, 60.0, gated=True),
    Case(100, 1, NEAREST, 30.0, gated=True),
)
ANCHORS = (
    Case(5, 1, UNIFORM, 30.0),
    Case(100, 1, NEAREST, 5.0),
    Case(1000, 1, NEAREST, 1.0),
    Case(5, 1, UNIFORM, 30.0, forest=True),
    Case(100, 1, NEAREST, 5.0, forest=True),
)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--forest", action="store_true", help="only those in a forest")
    args = parser.parse_args()
    cases = [case for case in CASES if not args.forest or case.forest]
    alone = [case for case in ANCHORS if not args.forest or case.forest]
    print("| | drones | flights | weight | perception | drone-steps a second, a core | together |")
    print("|---" * 7 + "|")
    anchors = {}
    fly_exact_states(_scenarios(alone[0])[0])
    for case in alone:
        begin, begin_cpu = time.perf_counter(), time.process_time()
        fly_exact_states(_scenarios(case)[0])
        taken_s = time.process_time() - begin_cpu, time.perf_counter() - begin
        anchors[case.drones, case.forest] = _print("one pilot after the other", case, *taken_s, 1)
    with ProcessPoolExecutor(args.processes, mp_context=get_context("spawn")) as pool:
        for case in cases:
            list(pool.map(fly, [case._replace(duration_s=2.0)] * args.processes))  # compiles, or loads what is
            begin = time.perf_counter()
            cpu_s = list(pool.map(fly, [case] * args.processes))
            wall_s = time.perf_counter() - begin
            rate = _print("all at once", case, max(cpu_s), wall_s, args.processes)
            print(f"<!-- {rate / anchors[case.drones, case.forest]:.0f} times one pilot after the other -->")
        memory = max(pool.map(peak_mb, range(args.processes)))
    print(f"memory of a process, at most: {memory:.0f} MB; {args.processes} processes")


def fly(case: Case) -> float:
    """Processor time, s."""
    scenarios = _scenarios(case)
    errors = load_perceived_errors(ERRORS) if case.measured else None
    begin = time.process_time()
    fly_flocks(scenarios, errors=errors, gated=case.gated)
    return time.process_time() - begin


def peak_mb(_: int) -> float:
    """Peak memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def _scenarios(case: Case) -> list[ScenarioConfig]:
    keys = {f"drone.flocking.weight.{key}": value for key, value in case.weight.items()}
    name = "forest" if case.forest else "paper_flight"
    scenario = load_scenario(data_path("config") / f"{name}.yaml", {"duration_s": case.duration_s, **keys})
    flock = with_drones(scenario, case.drones)
    starts = [v.model_copy(update={"position_m": (*v.position_m[:2], -HEIGHT_M)}) for v in flock.vehicles]
    flock = flock.model_copy(update={"vehicles": tuple(starts)})
    return [scattered(flock.model_copy(update={"seed": seed}), SCATTER_M) for seed in range(case.flights)]


def _print(how: str, case: Case, cpu_s: float, wall_s: float, processes: int) -> float:
    """One row; drone-steps a second of processor time."""
    steps = case.drones * case.flights * case.duration_s / 0.5
    weight = case.weight["kind"] if case.weight["kind"] == "uniform" else f"{case.weight['nearest']} nearest"
    perception = ("measured" if case.measured else "exact") + (", in a forest" if case.forest else "")
    perception += ", gated" if case.gated else ""
    together = processes * steps / wall_s
    what = f"{how} | {case.drones} | {case.flights} | {weight} | {perception}"
    print(f"| {what} | {steps / cpu_s:,.0f} | {together:,.0f} |", flush=True)
    return steps / cpu_s


if __name__ == "__main__":
    main()
