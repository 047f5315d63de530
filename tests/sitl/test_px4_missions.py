"""Missions with PX4 SITL and a `flockd run` for each drone, as `tools.checks.px4_rows` flies and measures them.

A flock that is sent elsewhere; one that a person leads, who flies one drone in Position mode; five of which one knows.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flockd.cli.sim import DEFAULT_SPEED_FACTOR
from flockd.core.data import data_path
from flockd.sim.scenario import load_scenario
from tests.sitl.sitl_run import PX4
from tools.checks.px4_rows import MISSIONS, Flight, Row, fly, goals_reached


@PX4
@pytest.mark.slow
@pytest.mark.parametrize("flight", MISSIONS, ids=lambda flight: flight.name)
def test_px4_flies_missions(flight: Flight, tmp_path: Path) -> None:
    """Full pictures and the shipped networks, in the time that two free cores keep up with."""
    row = fly(flight, "px4", DEFAULT_SPEED_FACTOR, tmp_path)
    print(row)  # noqa: T201
    assert row.kept, row
    assert row.goals.count(":") == {"sent_elsewhere": 3, "led_by_hand": 2, "one_knows": 1}[flight.name]


def _reached(scenario: str, plan: np.ndarray, goal: np.ndarray) -> str:
    position = np.concatenate([plan, np.full((*plan.shape[:2], 1), -4.0)], axis=-1)
    log = cast("Any", SimpleNamespace(position=position, goal=goal, time_s=0.5 * np.arange(len(plan))))
    return goals_reached(load_scenario(data_path("config") / scenario), log)


def test_the_middle_of_a_flock_reaches_its_goals_in_turn() -> None:
    """Two drones 4 m apart fly 10 m north and are sent 6 m back: a metre a step, and stop a metre short, or three."""
    north = np.array([*range(11), *range(9, 4, -1)], dtype=float)
    goal = np.repeat([[10.0, 0.0], [4.0, 0.0]], [11, 5], axis=0)
    plan = np.stack([np.column_stack([north, np.full(16, east)]) for east in (-2.0, 2.0)], axis=1)
    assert _reached("px4_waypoints.yaml", plan, goal) == "10, 0: 4.0 s; 4, 0: 7.0 s"
    assert _reached("px4_waypoints.yaml", plan[:14], goal[:14]) == "10, 0: 4.0 s; 4, 0: never"


def test_a_leader_by_hand_is_at_its_goals_and_not_left_alone_there() -> None:
    """The first drone is flown to (20, 0) and (20, 10); the other stays 3 m behind it, or where it began."""
    led = np.array([*[(north, 0.0) for north in range(21)], *[(20.0, east) for east in range(1, 11)]], dtype=float)
    for behind, last in ((led - (3.0, 0.0), "14.0 s"), (np.zeros_like(led), "never")):
        plan = np.stack([led, behind], axis=1)
        found = _reached("led_by_hand.yaml", plan, np.full((31, 2), np.nan))
        assert found == f"20, 0: 9.0 s; 20, 10: {last}"


@pytest.mark.parametrize(
    ("changes", "kept"),
    [
        ({}, True),
        ({"modes": "drone1 OFFBOARD > LOITER"}, False),
        ({"ended": "drone1 left"}, False),
        ({"closest_m": 0.9}, False),
        ({"off_m_s": 0.2}, False),
        ({"goals": "20, 0: never"}, False),
    ],
)
def test_what_a_flight_has_to_keep(changes: dict[str, Any], kept: bool) -> None:
    row: dict[str, Any] = {
        "flight": "hover", "speed_factor": 1.0, "off_m_s": 0.1, "truly_off_m_s": 0.1, "order": 1.0, "closest_m": 2.0,
        "longest_step_s": 0.5, "modes": "drone1 OFFBOARD", "ended": "", "most_off_m_s": 0.15, "goals": "20, 0: 9.0 s",
    }  # fmt: skip
    assert Row(**{**row, **changes}).kept is kept
