"""How fast real drones may fly: the envelope in which they were shown to keep apart, and their first flights."""

from __future__ import annotations

import math
from collections.abc import Mapping

from flockd.core.config.document import KeyPath, Place
from flockd.core.config.drone import DroneConfig
from flockd.core.config.mission import MissionParameters
from flockd.core.config.safety import layer_height_m
from flockd.core.errors import ConfigProblem

FIRST_SPEED_M_S = 1.0
_ROUNDING = 1e-12
"""Share by which a shortened velocity is too short, so that its length is never above the limit."""


def as_flown(config: DroneConfig) -> DroneConfig:
    """What a real drone flies with: the same, but with `safety.first_flight_layer` at that layer's height, and slowly.

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


PROVEN_M_S: Mapping[KeyPath, float] = {("flocking", "max_speed_m_s"): 2.0, ("safety", "gate", "max_speed_m_s"): 4.0}
"""The highest proven speed, by key: what a drone asks for, over ground, and what its gate lets through, corrections for
wind and for the autopilot's own error included. No mission or order is faster than the first.

Source: what the shipped networks see. They know 98 % and more of the neighbours up to 8 m away, four of ten at 11.5 m
(`config/perceived/shipped_networks.yaml`), and head-on by sight drones keep 1 m at up to 2 m/s each
(`config/campaigns/head_on_by_sight.yaml`, docs/results.md). Where detections begin at 10 m and more, tracker and gate
keep drones apart at up to 3 m/s each (`config/campaigns/encounters.yaml`): that is the law's default, not this.
"""


def beyond_envelope(config: DroneConfig) -> dict[KeyPath, str]:
    """What of a drone's speeds is outside the envelope, by key; nothing for one without an autopilot."""
    if config.autopilot is None:
        return {}
    flown: Mapping[KeyPath, float] = {
        ("flocking", "max_speed_m_s"): config.flocking.max_speed_m_s,
        ("safety", "gate", "max_speed_m_s"): config.safety.gate.max_speed_m_s,
    }
    return {
        key: f"{flown[key]:g} m/s is above the {most:g} m/s up to which drones were shown to keep apart; "
        f"write {most:g} or less, or go beyond it with --force"
        for key, most in PROVEN_M_S.items()
        if flown[key] > most
    }


def outside_envelope(config: DroneConfig, places: Mapping[KeyPath, Place]) -> list[ConfigProblem]:
    """The same of `config` as it is flown, as problems; `places` has every value that is no default."""
    file = next(iter(places.values())).file
    return [
        places[key].problem(text)
        if key in places
        else ConfigProblem(file, 0, ".".join(map(str, key)), f"is not given, and its default of {text}")
        for key, text in beyond_envelope(as_flown(config)).items()
    ]
