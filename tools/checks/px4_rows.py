"""Flies PX4 SITL by real daemons and prints a line of JSON for each flight: how closely it flew what was ordered.

    FLOCKD_PX4=~/PX4-Autopilot/build/px4_sitl_default python -m tools.checks.px4_rows
    python -m tools.checks.px4_rows --only hover north --out out/px4_rows
    python -m tools.checks.px4_rows --autopilot fake

The first flights run at real time. Their drones have two cameras of 128 x 96 pixels and the autopilot's own velocity,
so that two cores carry them; they see nobody, and keep apart by what each is ordered. `by_sight` and `by_sight_busy`
fly on whole pictures, at the factor that two cores carry; beside the latter another program keeps a core busy. Exit
code 1: a drone left offboard, a goal was not reached, or a velocity was off by more than the row's limit.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from flockd.cli.sim import DEFAULT_SPEED_FACTOR, SITL
from flockd.core.choices import AutopilotKind
from flockd.core.config import load_drone
from flockd.core.data import data_path
from flockd.core.errors import FlockdError
from flockd.core.messages import FloatArray
from flockd.review.flight_log.log import FlightLog
from flockd.review.metrics import closest_distances
from flockd.sim.flock.start import with_drones
from flockd.sim.scenario import ScenarioConfig, load_scenario
from flockd.sim.sitl.autopilots import px4_folder
from flockd.sim.sitl.fleet import fly_fleet
from flockd.sim.sitl.processes import free_endpoint
from flockd.sim.vehicles.vehicles import REFERENCE_DEG

_RUN = "from flockd.cli import program; program()"
SET_ORIGIN_S = 10
SETTLED_S = 5.0
"""The velocity counts from then on: the drones begin at a standstill."""
MOST_OFF_M_S = 0.15
CLOSEST_M, HEIGHT_M = 1.0, 0.7
NEAR_M, FOLLOWS_M = 2.0, 10.0
"""How near to a goal the flock's middle has to come, or the drone flown by hand; and all drones, to the last one."""
APART_M = 40.0
"""Distance between drones with small pictures: at it another drone is a pixel wide and is not detected."""
_LENS = {"fx": 64.0, "fy": 64.0, "cx": 64.0, "cy": 48.0}
_RIG = {
    "cameras": [
        {"name": name, "size_px": [128, 96], "intrinsics": _LENS, "extrinsics": {"yaw_deg": yaw}}
        for name, yaw in (("front", 0.0), ("back", 180.0))
    ]
}
_JUMPED = "has jumped"
_CIRCLE = {"kind": "circle_then_tangent", "speed_m_s": 1.0, "radius_m": 10.0, "circle_until_s": 600.0}
_CORNERS = [{"north_m": 10.0, "east_m": 0.0}, {"north_m": 10.0, "east_m": 10.0}, {"north_m": 0.0, "east_m": 10.0}]


@dataclass(frozen=True)
class Flight:
    """One flight, at real time with small pictures, or by sight."""

    name: str
    mission: Mapping[str, Any] = field(default_factory=dict)
    drones: int = 1
    duration_s: float = 60.0
    order: tuple[str, ...] = ()
    """What an operator types after `flockd fleet`, and when, s."""
    order_at_s: float = 5.0
    by_sight: str = ""
    """The scenario that is flown by sight; empty: small pictures, and the own velocity from the autopilot."""
    busy: bool = False
    most_off_m_s: float | None = MOST_OFF_M_S
    """Limit of the root mean square; None where the velocity that is wanted changes all the time."""
    origin_up_m: float = 0.0
    """After ten seconds PX4's origin is set this much higher, as a ground station may."""
    ends_with: str = ""
    """Part of the reason with which the drone has to leave offboard; empty: it has to stay."""


FLIGHTS = (
    Flight("hover", {"kind": "hover"}),
    Flight("north", {"kind": "velocity", "velocity_m_s": [1.0, 0.0]}, duration_s=30.0),
    Flight("circle", _CIRCLE),
    Flight("operator", {"kind": "operator"}, duration_s=40.0, order=("velocity", "all", "1", "0", "--seconds", "120")),
    Flight("waypoints", {"kind": "waypoints", "waypoints": _CORNERS}, most_off_m_s=None),
    Flight("three", _CIRCLE, drones=3),
    Flight("origin_higher", {"kind": "hover"}, duration_s=30.0, most_off_m_s=None, origin_up_m=4.0, ends_with=_JUMPED),
    Flight("origin_lower", {"kind": "hover"}, duration_s=30.0, most_off_m_s=None, origin_up_m=-30.0, ends_with=_JUMPED),
    Flight("by_sight", drones=3, by_sight="px4_flight.yaml", most_off_m_s=None),
    Flight("by_sight_busy", drones=3, by_sight="px4_flight.yaml", busy=True, most_off_m_s=None),
)  # fmt: skip
MISSIONS = (
    Flight(
        "sent_elsewhere", drones=3, by_sight="px4_waypoints.yaml", most_off_m_s=None,
        order=("goto", "all", "2", "10"), order_at_s=38.0,
    ),
    Flight("led_by_hand", drones=3, by_sight="led_by_hand.yaml", duration_s=64.0, most_off_m_s=None),
    Flight("one_knows", drones=5, by_sight="one_knows.yaml", most_off_m_s=None),
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """How a flight was flown."""

    flight: str
    speed_factor: float
    off_m_s: float
    """Root mean square of the level velocity, as the autopilot knows it, less what the pilot wanted a step before; of
    the worst drone."""
    truly_off_m_s: float
    """The same of the true velocity; PX4's simulated estimate wanders by 0.15 m/s."""
    order: float
    """Order of the last 20 s."""
    closest_m: float | None
    longest_step_s: float
    modes: str
    """Modes of each autopilot, in order."""
    ended: str
    """Why a drone did not fly to the end; empty: all did."""
    most_off_m_s: float | None
    ends_with: str = ""
    height_off_m: float = 0.0
    """Largest difference between a drone's height and its first one."""
    goals: str = ""
    """When each goal was reached; of a mission that has any."""

    @property
    def kept(self) -> bool:
        """All drones flew to the end in offboard, apart, and as closely as the flight asks; or ended as it asks."""
        if self.ends_with:
            return self.ends_with in self.ended and self.height_off_m < HEIGHT_M
        steady = all(len(modes.split(" > ")) == 1 for modes in self.modes.split(", "))
        close = self.most_off_m_s is None or self.off_m_s <= self.most_off_m_s
        close = close and "never" not in self.goals
        return steady and not self.ended and close and (self.closest_m is None or self.closest_m >= CLOSEST_M)


def fly(
    flight: Flight, kind: AutopilotKind, speed_factor: float, out: Path, watch: Callable[[int], None] = lambda _: None
) -> Row:
    """Flies it and measures the row; ``watch`` is called again and again with the seconds flown. Raises FlockdError."""
    endpoint = free_endpoint()
    sitl = load_drone(data_path("config") / SITL)
    sitl = sitl.model_copy(update={"telemetry": sitl.telemetry.model_copy(update={"connect": (endpoint,)})})
    scenario = _scenario(flight, out)
    if not flight.by_sight:
        sitl = sitl.model_copy(update={"safety": sitl.safety.model_copy(update={"alone_s": None})})
    once: list[tuple[float, list[str]]] = []
    if flight.order:
        once.append((flight.order_at_s, [sys.executable, "-c", _RUN, "fleet", *flight.order, "--listen", endpoint]))
    if flight.origin_up_m:  # of the first instance, which begins at sea level
        place = (*REFERENCE_DEG, flight.origin_up_m)
        program = str(px4_folder(os.environ) / "bin/px4-commander")
        once.append((SET_ORIGIN_S, [program, "--instance", "0", "set_ekf_origin", *(f"{one:g}" for one in place)]))

    def progress(flown_s: int, of_s: int) -> None:
        watch(flown_s)
        while once and flown_s >= once[0][0]:
            subprocess.Popen(once.pop(0)[1], stdout=subprocess.DEVNULL)

    with ExitStack() as stack:
        if flight.busy:
            loop = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(loop.kill)
        flown = fly_fleet(
            scenario, sitl, kind=kind, speed_factor=speed_factor, logs=out / "logs", recordings=None,
            environment=os.environ, progress=progress,
        )  # fmt: skip
    return replace(measured(flight, flown.log), goals=goals_reached(scenario, flown.log))


def measured(flight: Flight, log: FlightLog) -> Row:
    """The row of a flight."""
    fleet = log.metadata.fleet
    assert fleet is not None
    known, true = (
        np.linalg.norm(velocity[1:, :, :2] - log.command_velocity[:-1], axis=2)[log.time_s[1:] >= SETTLED_S]
        for velocity in (log.own_velocity_estimate, log.velocity)
    )
    gaps = closest_distances(log.position)[:, *np.triu_indices(log.position.shape[1], 1)]
    return Row(
        flight=flight.name,
        speed_factor=fleet.speed_factor,
        off_m_s=_worst(known),
        truly_off_m_s=_worst(true),
        order=round(fleet.order_last_20s, 4),
        closest_m=round(float(gaps.min()), 2) if gaps.size else None,
        longest_step_s=round(fleet.longest_step_s, 2),
        modes=", ".join(f"{drone} {' > '.join(modes)}" for drone, modes in fleet.modes.items()),
        ended="; ".join(f"{drone} {why}" for drone, why in {**fleet.handed_over, **fleet.mission_over}.items()),
        most_off_m_s=flight.most_off_m_s,
        ends_with=flight.ends_with,
        height_off_m=round(float(np.abs(log.position[..., 2] - log.position[0, :, 2]).max()), 2),
    )


def goals_reached(scenario: ScenarioConfig, log: FlightLog) -> str:
    """When the flock's middle, or a drone flown by hand, was at each of its goals in turn; `never` for the last one
    too where at the end it is not there, or a drone is far away."""
    plan = log.position[..., :2]
    hands = [i for i, vehicle in enumerate(scenario.vehicles) if vehicle.by_hand]
    goals = list(dict.fromkeys(goal for goal in map(tuple, log.goal.tolist()) if np.isfinite(goal).all()))
    if hands:
        waypoints = scenario.drone_of(hands[0]).mission.waypoints
        goals = [(waypoint.north_m or 0.0, waypoint.east_m or 0.0) for waypoint in waypoints]
    led, since, found = plan[:, hands[0]] if hands else plan.mean(axis=1), 0, []
    for goal in goals:
        there = since + np.flatnonzero(np.linalg.norm(led[since:] - goal, axis=1) <= NEAR_M)
        if goal == goals[-1] and (
            np.linalg.norm(led[-1] - goal) > NEAR_M or np.linalg.norm(plan[-1] - goal, axis=1).max() > FOLLOWS_M
        ):
            there = there[:0]
        found.append(f"{goal[0]:g}, {goal[1]:g}: " + (f"{log.time_s[there[0]]:.1f} s" if len(there) else "never"))
        since = int(there[0]) if len(there) else since
    return "; ".join(found)


def _worst(off_m_s: FloatArray) -> float:
    """Root mean square over the steps of each drone of (S, N) m/s, the largest; NaN where none flew."""
    flown = off_m_s[:, np.isfinite(off_m_s).any(axis=0)]
    return round(float(np.sqrt(np.nanmean(flown**2, axis=0)).max(initial=0.0)), 3) if flown.size else float("nan")


def _scenario(flight: Flight, folder: Path) -> ScenarioConfig:
    if flight.by_sight:
        scenario = load_scenario(data_path("config") / flight.by_sight, {"duration_s": flight.duration_s})
        return with_drones(scenario, flight.drones)
    drone = {"rig": _RIG, "own_velocity": "autopilot", "perception": {"flow": "dis"}}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "small.yaml").write_text(json.dumps(drone), encoding="utf-8")
    vehicles = [{"position_m": [0.0, APART_M * i, -4.0]} for i in range(flight.drones)]
    written = {
        "scenario": flight.name, "duration_s": flight.duration_s, "drone": "small.yaml", "vehicles": vehicles,
        "mission": dict(flight.mission),
    }  # fmt: skip
    path = folder / "flight.yaml"
    path.write_text(json.dumps(written), encoding="utf-8")
    return load_scenario(path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints a line of JSON a flight."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--autopilot", choices=get_args(AutopilotKind), default="px4")
    parser.add_argument(
        "--speed-factor", type=float, default=DEFAULT_SPEED_FACTOR,
        help="how fast time passes in the flights by sight (%(default)s)",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, help="keep logs in this folder")
    named = {flight.name: flight for flight in (*FLIGHTS, *MISSIONS)}
    parser.add_argument("--only", nargs="+", choices=named, help="these alone (default: all but the last three)")
    args = parser.parse_args(arguments)
    try:
        if args.autopilot == "px4":
            px4_folder(os.environ)
    except FlockdError as error:
        print(error, file=sys.stderr)
        return int(error.exit_code)
    kept = True
    with tempfile.TemporaryDirectory(prefix="flockd-") as folder:
        for flight in FLIGHTS if args.only is None else [named[name] for name in args.only]:
            speed_factor = args.speed_factor if flight.by_sight else 1.0
            try:
                row = fly(flight, args.autopilot, speed_factor, (args.out or Path(folder)) / flight.name)
            except FlockdError as error:
                row = Row(flight.name, 0.0, np.nan, np.nan, np.nan, None, np.nan, "never flew", str(error), None)
            kept = kept and row.kept
            print(json.dumps({**vars(row), "kept": row.kept}), flush=True)
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
