"""Speed limits of real drones: the speed from which they stop in time, and first flights."""

from __future__ import annotations

import math
from collections.abc import Mapping

from flockd.core.config.document import KeyPath, Place, key_text
from flockd.core.config.drone import DroneConfig
from flockd.core.config.mission import MissionParameters
from flockd.core.config.safety import GateParameters, layer_height_m
from flockd.core.errors import ConfigProblem

FIRST_SPEED_M_S = 1.0
_ROUNDING = 1e-12
"""Share by which a shortened velocity is too short, so that its length is never above the limit."""


def as_flown(config: DroneConfig) -> DroneConfig:
    """The configuration that a real drone flies with: with `safety.first_flight_layer`, at that layer's height and
    slowly.

    No speed is above `FIRST_SPEED_M_S`, and no waypoint has a height. The gate's limit stays: what corrects wind needs
    it.
    """
    layer = config.safety.first_flight_layer
    if layer is None:
        return config
    slow = {"max_speed_m_s": min(config.flocking.max_speed_m_s, FIRST_SPEED_M_S)}
    flown = {"flocking": config.flocking.model_copy(update=slow), "mission": _in_layer(config.mission, layer)}
    return config.model_copy(update=flown)


def _in_layer(mission: MissionParameters, layer: int) -> MissionParameters:
    waypoints = tuple(
        waypoint.model_copy(update={"height_m": None, "speed_m_s": _slow(waypoint.speed_m_s)})
        for waypoint in mission.waypoints
    )
    level = {"height_m": layer_height_m(layer), "height_offset_m": 0.0, "waypoints": waypoints}
    if mission.velocity_m_s is not None:
        north, east = mission.velocity_m_s
        over = math.hypot(north, east) / FIRST_SPEED_M_S
        share = (1 - _ROUNDING) / over if over > 1 else 1.0
        level["velocity_m_s"] = share * north, share * east
    return mission.model_copy(update={"speed_m_s": _slow(mission.speed_m_s), **level})


def _slow(speed_m_s: float | None) -> float | None:
    return None if speed_m_s is None else min(speed_m_s, FIRST_SPEED_M_S)


_KNOWN_M = 7.0
"""Range at which drones that meet are first detected. By sight, drones that met head-on at 2 m/s each confirmed each
other at 4.6 m (median of 12 tracks of the flights in config/perceived/shipped_networks.yaml), which follows from a
first detection at this range."""
_RANGE_ERROR = 0.09
"""Share of its range by which a neighbour may be nearer than estimated for seconds: two standard deviations of the
persistent errors of the shipped networks (`range_error` of trained airframes in that file, times the root of
`tracking.range_error_lasts`)."""


def safe_speeds(config: DroneConfig) -> tuple[float, float]:
    """The speeds v, m/s, up to which a drone keeps `min_separation_m` s: behind a mate that stops, and from a drone
    that it meets.

    A drone reacts to a neighbour's manoeuvre after t = step_s (1 + degraded_load) + reaction_s: the rest of the current
    step, the computation of the next one, and the drone's response. Then the drone brakes by b = `braking_m_s2`. Ranges
    err by the share e.

    A mate ahead, at d = `desired_distance_m`, brakes by a = `max_acceleration_m_s2`, as the gate assumes, but at least
    as hard as the drone: v t + v^2 / 2b - v^2 / 2a = d (1 - e) - s. An oncoming drone of the same speed, detected from
    R on, brakes like the drone: 2 (v t + v^2 / 2b) = R (1 - e) - s.

    Source: Shalev-Shwartz et al. 2017, "On a formal model of safe and scalable self-driving cars", definitions 1 and 2,
    with nobody speeding up.
    """
    gate, load = config.safety.gate, config.safety.degraded_load
    late_s = config.step_s * (1.0 + load) + gate.reaction_s
    per_square = 1.0 / (2.0 * gate.braking_m_s2)

    def solved(left_m: float, per_square: float) -> float:
        """v late_s + v^2 per_square = left_m; 0 where none is left."""
        return 2.0 * max(left_m, 0.0) / (late_s + math.sqrt(late_s**2 + 4.0 * per_square * max(left_m, 0.0)))

    left_m = config.flocking.desired_distance_m * (1.0 - _RANGE_ERROR) - gate.min_separation_m
    behind_m_s = solved(left_m, max(per_square - 1.0 / (2.0 * gate.max_acceleration_m_s2), 0.0))
    return behind_m_s, solved((_KNOWN_M * (1.0 - _RANGE_ERROR) - gate.min_separation_m) / 2.0, per_square)


def beyond_envelope(config: DroneConfig) -> dict[KeyPath, str]:
    """Messages about speeds that are too high, with the remedy, by key; empty for a drone without an autopilot."""
    if config.autopilot is None:
        return {}
    law_m_s, gate_m_s, usual_m_s = (of.max_speed_m_s for of in (config.flocking, config.safety.gate, GateParameters()))
    behind_m_s, meeting_m_s = safe_speeds(config)
    safe_m_s = math.floor(100 * min(behind_m_s, meeting_m_s)) / 100
    whom, more = "one that comes as fast", ["a smaller step_s"]
    if behind_m_s < meeting_m_s:
        whom, more = "a mate that stops", ["a larger flocking.desired_distance_m or a smaller step_s"]
    speeds: dict[KeyPath, tuple[float, float, str, list[str]]] = {
        ("flocking", "max_speed_m_s"): (law_m_s, safe_m_s, f"from which the drone stops in time before {whom}", more),
        ("safety", "gate", "max_speed_m_s"): (gate_m_s, usual_m_s, "that real drones' gates let through", []),
    }
    return {
        key: f"{flown:g} m/s is above the {most:g} m/s {why}; {_remedy(most, more)}, or take it with --force"
        for key, (flown, most, why, more) in speeds.items()
        if flown > most
    }


def _remedy(most_m_s: float, more: list[str]) -> str:
    """The remedy; it names a lower speed only if one is low enough."""
    slower = [f"{most_m_s:g} or less"] if most_m_s > 0.0 else []
    return "write " + ", or ".join(slower + more)


def outside_envelope(config: DroneConfig, places: Mapping[KeyPath, Place]) -> list[ConfigProblem]:
    """The same as problems, for `config` as it is flown; `places` has every value that is not a default."""
    file = next(iter(places.values())).file
    return [
        places[key].problem(text)
        if key in places
        else ConfigProblem(file, 0, key_text(key), f"is not given, and its default of {text}")
        for key, text in beyond_envelope(as_flown(config)).items()
    ]
