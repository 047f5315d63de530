"""Missions with PX4 SITL and a `flockd run` for each drone; `pytest -rP` prints how they went.

`waypoints`, after which `flockd fleet goto` sends all drones somewhere else. `led_by_hand`: a person flies one drone in
Position mode with MAVLink's MANUAL_CONTROL, and no flockd runs for it. `one_knows`: one drone has a waypoint, the
others follow what they see.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flockd.cli.sim import DEFAULT_SPEED_FACTOR, SITL
from flockd.core.config import load_drone
from flockd.core.data import data_path
from flockd.core.messages import FloatArray
from flockd.flight.flocking.metrics import closest_distances
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.flight_folder import save_flight, write_report_files
from flockd.sim.flock.start import with_drones
from flockd.sim.scenario import ScenarioConfig, load_scenario
from flockd.sim.sitl.fleet import fly_fleet
from flockd.sim.sitl.ports import free_endpoint
from tools.checks.px4_rows import Order
from tools.checks.px4_rows import main as px4_rows

NEAR_M = 2.0
"""The middle of the flock has to come as near to a goal."""
FOLLOWS_M = 10.0
"""At the end, those who follow a drone that is flown by hand have to be as near to it."""
CLOSEST_M = 1.0


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


def fly(mission: Mission, out: Path) -> list[Row]:
    """One flight, with its report in the new folder ``out``; its goals, in order. Raises FlockdError."""
    scenario = load_scenario(data_path("config") / mission.scenario, {"duration_s": mission.duration_s})
    scenario = with_drones(scenario, mission.drones)
    endpoint = free_endpoint()
    sitl = load_drone(data_path("config") / SITL)
    sitl = sitl.model_copy(update={"telemetry": sitl.telemetry.model_copy(update={"connect": (endpoint,)})})
    north_m, east_m = mission.order
    order = Order(("goto", "all", f"{north_m:g}", f"{east_m:g}"), mission.order_at_s, endpoint)
    flight = fly_fleet(
        scenario, sitl, kind="px4", speed_factor=DEFAULT_SPEED_FACTOR, logs=out / "logs", recordings=None,
        environment=os.environ, progress=order.progress,
    )  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    save_flight(out, flight.log, flight.key_frames)
    write_report_files(out, flight.log)
    for line in (order.answers(), *_faults(flight.log)):
        if line:
            print(line)  # noqa: T201
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


PX4 = pytest.mark.skipif("FLOCKD_PX4" not in os.environ, reason="FLOCKD_PX4 names no SITL build folder of PX4")


@PX4
@pytest.mark.slow
@pytest.mark.parametrize("mission", MISSIONS, ids=lambda mission: mission.name)
def test_px4_flies_missions(mission: Mission, tmp_path: Path) -> None:
    """Full pictures and the shipped networks, in the time that two free cores keep up with."""
    flown = fly(mission, tmp_path)
    print(*flown, sep="\n")  # noqa: T201
    assert len(flown) == {"waypoints": 3, "led_by_hand": 2, "one_knows": 1}[mission.name]
    assert all(row.kept and row.error_m < 2.0 for row in flown), flown


def _log(plan: np.ndarray, goal: np.ndarray, modes: dict[str, list[str]]) -> Any:
    fleet = SimpleNamespace(modes=modes)
    position = np.concatenate([plan, np.full((*plan.shape[:2], 1), -4.0)], axis=-1)
    times = 0.5 * np.arange(len(plan))
    return cast(
        "Any", SimpleNamespace(position=position, goal=goal, time_s=times, metadata=SimpleNamespace(fleet=fleet))
    )


def test_each_goal_of_a_flight_has_a_row() -> None:
    """Two drones 4 m apart fly 10 m north and are sent 6 m back: a metre a step, and stop a metre short."""
    north = np.array([*range(11), *range(9, 4, -1)], dtype=float)
    plan = np.stack([np.column_stack([north, np.full(16, east)]) for east in (-2.0, 2.0)], axis=1)
    goal = np.repeat([[10.0, 0.0], [4.0, 0.0]], [11, 5], axis=0)
    log = _log(plan, goal, {"drone1": ["OFFBOARD"], "drone2": ["OFFBOARD"]})
    scenario = load_scenario(data_path("config") / "px4_waypoints.yaml")
    there, back = rows(MISSIONS[0], scenario, log)
    assert (there.goal, there.arrived, there.time_s, there.error_m) == ("10, 0", True, 4.0, 0.0)
    assert (back.goal, back.arrived, back.time_s, back.error_m) == ("4, 0", True, 7.0, 1.0)
    assert back.farthest_m == pytest.approx(5**0.5, abs=0.01)
    assert back.closest_m == 4.0
    assert there.kept
    assert back.kept


def test_a_flight_that_left_its_mode_or_its_leader_is_not_kept() -> None:
    """The first drone is flown by hand to (20, 0) and (20, 10), the others stay 3 m behind it, or where they began."""
    led = np.array([*[(north, 0.0) for north in range(21)], *[(20.0, east) for east in range(1, 11)]], dtype=float)
    scenario = load_scenario(data_path("config") / "led_by_hand.yaml")
    modes = {"drone1": ["POSCTL"], "drone2": ["OFFBOARD"]}
    for behind, with_modes, good in (
        (led - (3.0, 0.0), modes, True),
        (led - (3.0, 0.0), {**modes, "drone2": ["OFFBOARD", "LOITER"]}, False),
        (np.zeros_like(led) - (3.0, 0.0), modes, False),
        (led - (0.9, 0.0), modes, False),
    ):
        log = _log(np.stack([led, behind], axis=1), np.full((31, 2), np.nan), with_modes)
        first, last = rows(MISSIONS[1], scenario, log)
        assert (first.time_s, last.time_s, last.error_m) == (9.0, 14.0, 0.0)
        assert last.kept is good


def test_without_px4_the_program_of_rows_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FLOCKD_PX4", str(tmp_path))
    assert px4_rows([]) == 69
    assert f"there is no PX4 in {tmp_path}, which FLOCKD_PX4 names; set it to" in capsys.readouterr().err
