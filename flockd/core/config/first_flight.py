"""First flights: slow, and each drone of the flock in a layer of its own."""

from __future__ import annotations

import math

from flockd.core.config.drone import DroneConfig
from flockd.core.config.mission import MissionParameters
from flockd.core.config.safety import layer_height_m

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
