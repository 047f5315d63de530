"""Limits that contradict each other are refused with a mend."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from flockd.core.config import load_drone
from flockd.core.errors import ConfigError
from flockd.flight.safety import GateParameters, SafetyParameters

SIMULATOR = Path(__file__).parents[3] / "config" / "simulator.yaml"
PX4_SITL = SIMULATOR.with_name("px4_sitl.yaml")


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"min_height_m": 5.0, "max_height_m": 5.0}, "min_height_m 5 is not below max_height_m"),
        ({"degraded_speed_m_s": 4.5}, "degraded_speed_m_s is above max_speed_m_s"),
        ({"degraded_separation_m": 0.5}, "degraded_separation_m is below min_separation_m"),
        ({"fence_corners_m": ((0.0, 0.0), (1.0, 0.0))}, "fewer than 3 corners"),
        ({"fence_corners_m": ((0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (0.0, 0.0))}, "names a corner twice"),
        ({"neighbour_reaction_s": 0.2}, "neighbour_reaction_s is below reaction_s 0.5"),
        ({"permission_timeout_s": 0.5}, "less than or equal to 0.4"),
    ],
)
def test_limits_of_the_gate(limits: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        GateParameters(**limits)


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"degraded_ego_motion_s": 7.0}, "degraded_ego_motion_s is above max_ego_motion_s"),
        ({"degraded_load": 2.5}, "degraded_load is above max_load"),
        ({"degraded_temperature_c": 99.0}, "degraded_temperature_c is above max_temperature_c"),
        ({"hover_s": 10.0}, "less than or equal to 3"),
    ],
)
def test_limits_of_the_supervisor(limits: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        SafetyParameters(**limits)


@pytest.mark.fault("absurd-limits")
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("safety.gate.command_timeout_s", 1e9),
        ("safety.gate.max_speed_m_s", 1e6),
        ("safety.gate.max_acceleration_m_s2", 1e6),
        ("safety.gate.fence_radius_m", 1e300),
        ("safety.gate.max_height_m", 1e9),
        ("safety.gate.min_separation_m", 1e9),
        ("safety.estimate_timeout_s", 1e9),
        ("safety.heartbeat_timeout_s", 1e9),
        ("safety.outside_s", 1e9),
        ("flocking.max_speed_m_s", 1e6),
    ],
)
def test_limits_beyond_what_any_multirotor_does_are_refused(key: str, value: float) -> None:
    with pytest.raises(ConfigError, match=key.rpartition(".")[2]):
        load_drone(SIMULATOR, {key: value})


def test_a_law_faster_than_the_gate_is_reported_with_both_keys() -> None:
    with pytest.raises(
        ConfigError, match=r"flocking.max_speed_m_s: 6 is above safety.gate.max_speed_m_s.*write 4 or less"
    ):
        load_drone(SIMULATOR, {"flocking.max_speed_m_s": 6.0})
    with pytest.raises(ConfigError, match=r"above safety.gate.max_speed_m_s.*write 0.3 or less"):
        load_drone(PX4_SITL, {"flocking.max_speed_m_s": 3.7})
    both = load_drone(SIMULATOR, {"flocking.max_speed_m_s": 6.0, "safety.gate.max_speed_m_s": 6.0})
    assert both.safety.gate.max_speed_m_s == 6.0


def test_a_file_may_draw_a_fence(tmp_path: Path) -> None:
    fence = (
        "safety:\n  gate:\n    fence_radius_m: null\n    fence_corners_m: [[0, -20], [40, -20], [40, 20], [0, 20]]\n"
    )
    path = tmp_path / "drone.yaml"
    path.write_text(SIMULATOR.read_text(encoding="utf-8") + fence, encoding="utf-8")
    gate = load_drone(path).safety.gate
    assert gate.fence_radius_m is None
    assert gate.fence_corners_m == ((0.0, -20.0), (40.0, -20.0), (40.0, 20.0), (0.0, 20.0))
