"""Missions with PX4, and the table of how they went, without PX4."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flockd.core.config import load_scenario
from flockd.core.data import data_path
from tools.checks.px4_missions import MISSIONS, Mission, main, rows

PX4 = pytest.mark.skipif("FLOCKD_PX4" not in os.environ, reason="FLOCKD_PX4 names no SITL build folder of PX4")


@PX4
@pytest.mark.slow
@pytest.mark.parametrize("mission", MISSIONS, ids=lambda mission: mission.name)
def test_px4_flies_missions(mission: Mission, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Full pictures and the shipped networks, in the time that two free cores keep up with."""
    code = main(["--only", mission.name, "--out", str(tmp_path), "--json"])
    told = capsys.readouterr()
    assert code == 0, told
    goals = json.loads(told.out)["goals"]
    assert len(goals) == {"waypoints": 3, "led_by_hand": 2, "one_knows": 1}[mission.name]
    assert all(goal["error_m"] < 2.0 for goal in goals)


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
