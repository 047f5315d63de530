"""Flies missions with PX4 SITL, with a `flockd run` for each drone, and prints how they went.

    FLOCKD_PX4=~/PX4-Autopilot/build/px4_sitl_default python -m tools.checks.px4_missions
    python -m tools.checks.px4_missions --only led_by_hand --speed-factor 0.1 --out out/px4_missions
    python -m tools.checks.px4_missions --autopilot standin --json

Flights: `waypoints`, after which `flockd fleet goto` sends all drones somewhere else. `led_by_hand`: a person flies one
drone in Position mode with MAVLink's MANUAL_CONTROL, and no flockd runs for it. `one_knows`: one drone has a waypoint,
the others follow what they see. Exit code 1: a drone left the mode that it was to fly in, the middle of the flock was
not at a goal, or two drones came too close.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from flockd.cli.sim_fleet import DEFAULT_SPEED_FACTOR, SITL
from flockd.core.choices import AutopilotKind
from flockd.core.config import ScenarioConfig, load_drone, load_scenario
from flockd.core.data import data_path
from flockd.core.messages import FloatArray
from flockd.flight.flocking.metrics import closest_distances
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.flight_folder import save_flight, write_report_files
from flockd.sim.fleet import fly_fleet
from flockd.sim.free_ports import free_endpoint
from flockd.sim.start import with_drones
from tools.checks.px4_sitl import run_trials

NEAR_M = 2.0
"""The middle of the flock has to come as near to a goal."""
FOLLOWS_M = 10.0
"""At the end, those who follow a drone that is flown by hand have to be as near to it."""
CLOSEST_M = 1.0
ORDER_ANSWER_S = 60.0
_RUN = "from flockd.cli import program; program()"


@dataclass(frozen=True)
class Mission:
    """One flight."""

    name: str
    scenario: str
    duration_s: float
    drones: int
    order_at_s: float | None = None
    """When an operator sends all drones to `order`."""
    order: tuple[float, float] = (0.0, 0.0)
    """Metres north and east of the world's origin."""


MISSIONS = (
    Mission("waypoints", "px4_waypoints.yaml", 60.0, 3, order_at_s=38.0, order=(2.0, 10.0)),
    Mission("led_by_hand", "led_by_hand.yaml", 64.0, 3),
    Mission("one_knows", "one_knows.yaml", 60.0, 5),
)


@dataclass(frozen=True)
class Row:
    """How one goal of a flight was flown to."""

    flight: str
    goal: str
    arrived: bool
    time_s: float | None
    """From the beginning of the flight to when it was there first."""
    error_m: float
    """How near the flock's middle, or the drone flown by hand, came: to the last goal, at the end."""
    farthest_m: float
    """From there to the farthest drone, at the end of the way there."""
    closest_m: float
    """The closest two drones of the whole flight."""
    modes: str
    """Modes of each autopilot, in order."""

    @property
    def kept(self) -> bool:
        """The flight went as it should, as far as this goal."""
        steady = all(len(modes.split(" > ")) == 1 for modes in self.modes.split(", "))
        return self.arrived and steady and self.closest_m > CLOSEST_M and self.farthest_m < FOLLOWS_M


class Order:
    """An operator's order, sent once by `flockd fleet goto` while the flight goes on."""

    def __init__(self, mission: Mission, endpoint: str) -> None:
        self._mission, self._endpoint = mission, endpoint
        self._sent: subprocess.Popen[str] | None = None

    def progress(self, flown_s: int, of_s: int) -> None:
        """Called again and again while the fleet flies."""
        at_s = self._mission.order_at_s
        if at_s is None or flown_s < at_s or self._sent is not None:
            return
        self._sent = subprocess.Popen(
            [sys.executable, "-c", _RUN, *self.command(), "--listen", self._endpoint],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip

    def command(self) -> Sequence[str]:
        """What is typed."""
        return "fleet", "goto", "all", *(f"{metres:g}" for metres in self._mission.order)

    def answers(self) -> str:
        """What the drones answered, one line each; empty without an order."""
        return "" if self._sent is None else self._sent.communicate(timeout=ORDER_ANSWER_S)[0].strip()


def fly(
    mission: Mission, kind: AutopilotKind, speed_factor: float, out: Path, told: Callable[[str], None]
) -> list[Row]:
    """One flight, with its report in the new folder ``out``; its goals, in order. Raises FlockdError."""
    scenario = load_scenario(data_path("config") / mission.scenario, {"duration_s": mission.duration_s})
    scenario = with_drones(scenario, mission.drones)
    endpoint = free_endpoint()
    sitl = load_drone(data_path("config") / SITL)
    sitl = sitl.model_copy(update={"telemetry": sitl.telemetry.model_copy(update={"connect": (endpoint,)})})
    order = Order(mission, endpoint)
    flight = fly_fleet(
        scenario, sitl, kind=kind, speed_factor=speed_factor, logs=out / "logs", recordings=None,
        environment=os.environ, progress=order.progress,
    )  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    save_flight(out, flight.log, flight.key_frames)
    write_report_files(out, flight.log)
    for line in (order.answers(), *_faults(flight.log)):
        if line:
            told(line)
    return rows(mission, scenario, flight.log)


def rows(mission: Mission, scenario: ScenarioConfig, log: FlightLog) -> list[Row]:
    """A row for each goal."""
    fleet = log.metadata.fleet
    assert fleet is not None
    plan = log.position[..., :2]
    gaps = closest_distances(log.position)
    common = {
        "flight": mission.name,
        "closest_m": round(float(gaps[:, *np.triu_indices(plan.shape[1], 1)].min()), 2),
        "modes": ", ".join(f"{drone} {' > '.join(modes)}" for drone, modes in fleet.modes.items()),
    }
    hands = [i for i, vehicle in enumerate(scenario.vehicles) if vehicle.by_hand]
    if hands:
        waypoints = scenario.drone_of(hands[0]).mission.waypoints
        goals = [(waypoint.north_m or 0.0, waypoint.east_m or 0.0) for waypoint in waypoints]
        return _rows(plan[:, hands[0]], plan, np.array(goals), log.time_s, common)
    goals = [goal for goal in log.goal.tolist() if np.isfinite(goal).all()]
    return _rows(plan.mean(axis=1), plan, np.array(list(dict.fromkeys(map(tuple, goals)))), log.time_s, common)


def _rows(led: FloatArray, plan: FloatArray, goals: FloatArray, times: FloatArray, common: dict[str, Any]) -> list[Row]:
    """The rows for `led` (S, 2) m, which flies to the goals (n, 2) m in order, and all drones at `plan` (S, N, 2) m."""
    found, since = [], 0
    for number, goal in enumerate(goals):
        away_m = np.linalg.norm(led[since:] - goal, axis=1)
        there = np.flatnonzero(away_m <= NEAR_M)
        last = number + 1 == len(goals)
        nearest = len(away_m) - 1 if last else int(np.argmin(away_m))
        spread_m = np.linalg.norm(plan[since + nearest] - goal, axis=1)
        row = Row(
            goal=f"{goal[0]:g}, {goal[1]:g}",
            arrived=bool(away_m[nearest] <= NEAR_M),
            time_s=round(float(times[since + there[0]]), 1) if len(there) else None,
            error_m=round(float(away_m[nearest]), 2),
            farthest_m=round(float(spread_m.max()), 2),
            **common,
        )
        found.append(row)
        since += int(there[0]) if len(there) else 0
    return found


def _faults(log: FlightLog) -> list[str]:
    fleet = log.metadata.fleet
    assert fleet is not None
    return [f"{drone} did not fly to the end: {why}" for drone, why in fleet.handed_over.items()] + fleet.notes


def _line(row: Row) -> str:
    reached = "never" if row.time_s is None else f"{row.time_s:.1f} s"
    verdict = "arrived" if row.arrived else "NOT ARRIVED"
    return (
        f"{row.flight:14}{row.goal:12}{verdict:13}{reached:9}{row.error_m:>6.2f} m{row.farthest_m:>9.2f} m"
        f"{row.closest_m:>9.2f} m   {row.modes}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--autopilot", choices=get_args(AutopilotKind), default="px4")
    parser.add_argument(
        "--speed-factor", type=float, default=DEFAULT_SPEED_FACTOR, help="how fast simulated time passes (%(default)s)"
    )
    parser.add_argument("--out", type=Path, help="keep logs and reports in this folder")
    return run_trials(
        parser, MISSIONS, _fly_all, line=_line, rows="goals", arguments=arguments,
        header=f"{'flight':14}{'goal, m':12}{'':13}{'there':9}{'error':>8}{'farthest':>11}{'closest':>11}   modes",
    )  # fmt: skip


def _fly_all(missions: Sequence[Mission], args: argparse.Namespace, told: Callable[[Row], None]) -> list[Row]:
    found: list[Row] = []
    with ExitStack() as stack:
        out = args.out or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="flockd-")))
        for mission in missions:
            flown = fly(
                mission, args.autopilot, args.speed_factor, out / mission.name,
                lambda line: print(line, file=sys.stderr),
            )  # fmt: skip
            found += flown
            for row in flown:
                told(row)
    return found


if __name__ == "__main__":
    sys.exit(main())
