"""Limits that contradict each other, or that no multirotor has, are refused at the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from flockd.core.config import load_drone
from flockd.core.errors import ConfigError

SIMULATOR = Path(__file__).parents[3] / "config" / "simulator.yaml"
PX4_SITL = SIMULATOR.with_name("px4_sitl.yaml")


@pytest.mark.fault("absurd-limits")
@pytest.mark.parametrize(
    "limits",
    [
        {"safety.gate.min_height_m": 5.0, "safety.gate.max_height_m": 5.0},
        {"safety.gate.degraded_speed_m_s": 4.5},
        {"safety.gate.degraded_separation_m": 0.5},
        {"safety.gate.fence_corners_m": [[0.0, 0.0], [1.0, 0.0]]},
        {"safety.gate.fence_corners_m": [[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [0.0, 0.0]]},
        {"safety.gate.neighbour_reaction_s": 0.2},
        {"safety.gate.command_fresh_s": 1.5},
        {"safety.gate.permission_timeout_s": 0.5},
        {"safety.degraded_ego_motion_s": 7.0},
        {"safety.estimate_timeout_s": 1.6},  # the gate would send nothing, before the drone hovers
        {"safety.degraded_load": 2.5},
        {"safety.degraded_temperature_c": 99.0},
        {"safety.degraded_velocity_error_m_s": 9.0},
        {"safety.hover_s": 10.0},
        # beyond what any multirotor does
        {"safety.gate.command_timeout_s": 1e9},
        {"safety.gate.max_speed_m_s": 1e6},
        {"safety.gate.max_acceleration_m_s2": 1e6},
        {"safety.gate.fence_radius_m": 1e300},
        {"safety.gate.max_height_m": 1e9},
        {"safety.gate.min_separation_m": 1e9},
        {"safety.estimate_timeout_s": 1e9},
        {"safety.heartbeat_timeout_s": 1e9},
        {"safety.outside_s": 1e9},
        {"flocking.max_speed_m_s": 1e6},
    ],
    ids=lambda limits: next(iter(limits)).rpartition(".")[2],
)
def test_limits_that_cannot_be_are_refused(limits: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(limits)).rpartition(".")[2]):
        load_drone(SIMULATOR, limits)


def test_a_law_faster_than_the_gate_is_reported_with_both_keys() -> None:
    for path, speed_m_s, most in ((SIMULATOR, 6.0, "4"), (PX4_SITL, 3.7, "0.3")):
        with pytest.raises(ConfigError, match=rf"above safety.gate.max_speed_m_s.* {most} or less"):
            load_drone(path, {"flocking.max_speed_m_s": speed_m_s})
    both = load_drone(SIMULATOR, {"flocking.max_speed_m_s": 6.0, "safety.gate.max_speed_m_s": 6.0})
    assert both.safety.gate.max_speed_m_s == 6.0
