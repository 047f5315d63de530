"""Five drones fly north, 2 m apart, and one of them gets into trouble."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from flockd.core.config.loader import Overrides
from flockd.sim.scenario import MAX_DURATION_S

_DRONES = 5
_SIDE_M = 2.0
_SPEEDS_M_S = 0.5, 1.0, 1.5, 2.0


def _taken_over(to: str) -> Callable[[int, float], Overrides]:
    return lambda one, time_s: {"takeovers": ({"drone": one, "time_s": time_s, "to": to},)}


def _blind(*cameras: str, lasts_s: float = MAX_DURATION_S) -> Callable[[int, float], Overrides]:
    def faults(one: int, time_s: float) -> Overrides:
        end_s = time_s + lasts_s
        return {"faults": tuple({"drone": one, "camera": c, "begin_s": time_s, "end_s": end_s} for c in cameras)}

    return faults


TROUBLES: dict[str, Callable[[int, float], Overrides]] = {
    "holds": _taken_over("hold"),
    "front camera lost": _blind("front"),
    "lands": _taken_over("land"),
    "sees nothing for 3 s": _blind("front", "right", "back", "left", lasts_s=3.0),
    "flown by a person": lambda one, time_s: {},
    "right camera lost": _blind("right"),
    "short steps": lambda one, time_s: {"drone.step_s": 0.2},
}
"""By trouble: overrides of the scenario, given the drone's number (from 1) and the time, s."""


def trouble(seed: int, turn: int) -> Overrides:
    """Of the flight with this seed, which is one of a list: troubles take turns, the seed says at which speed, which
    drone and when."""
    name = list(TROUBLES)[turn % len(TROUBLES)]
    speed_m_s, one, time_s = _SPEEDS_M_S[seed % len(_SPEEDS_M_S)], 1 + seed // 4 % _DRONES, 7.0 + seed // 20 % 4
    vehicles = [_vehicle(k, speed_m_s) for k in range(_DRONES)]
    if name == "flown by a person":
        vehicles[one - 1] |= {"by_hand": True, "mission": _turns(vehicles[one - 1]["position_m"], speed_m_s, time_s)}
    return {"vehicles": tuple(vehicles), **TROUBLES[name](one, time_s)}


def _vehicle(k: int, speed_m_s: float) -> dict[str, Any]:
    """Vehicle k of a pentagon."""
    radius_m, angle = _SIDE_M / (2 * math.sin(math.pi / _DRONES)), k * math.tau / _DRONES
    return {
        "position_m": (radius_m * math.cos(angle), radius_m * math.sin(angle), -4.5),
        "mission": {"kind": "velocity", "velocity_m_s": (speed_m_s, 0.0)},
    }


def _turns(position_m: tuple[float, float, float], speed_m_s: float, time_s: float) -> dict[str, Any]:
    """A mission along with the others, and then away to its own side."""
    north_m = position_m[0] + speed_m_s * time_s
    ways = [(north_m, position_m[1]), (north_m, position_m[1] + math.copysign(20.0, position_m[1]))]
    return {
        "kind": "waypoints", "speed_m_s": speed_m_s,
        "waypoints": tuple({"north_m": north, "east_m": east} for north, east in ways),
    }  # fmt: skip
