"""Checks an operator's order."""

from __future__ import annotations

import math

import numpy as np
from pydantic import ValidationError

from flockd.core.config.drone import DroneConfig
from flockd.core.config.mission import fault_of_height, fault_of_place, fault_of_speed
from flockd.core.messages import FloatArray, MissionOrder, VehicleState
from flockd.flight.mission.navigator import ordered_mission
from flockd.flight.mission.waypoints import place_of_waypoint


def order_fault(config: DroneConfig, order: MissionOrder, vehicle: VehicleState | None) -> str | None:
    """Why an order is refused, one sentence for its sender; None: it may be flown.

    `vehicle` is the drone's newest state. A velocity is refused if the drone would be outside the fence at the end of
    the order, or is outside already and would not come nearer to home.
    """
    gate, mission = config.safety.gate, config.mission
    if not _finite(order):
        return "an order's numbers have to be finite"
    if (order.velocity is None) == (order.place is None and order.place_deg is None):
        return "an order needs a goal or a velocity, and not both"
    if order.height_m is not None and config.safety.first_flight_layer is not None:
        return "in first flights each drone keeps to its layer; leave the height out"
    if order.height_m is not None and (fault := fault_of_height(gate, order.height_m + mission.height_offset_m)):
        return f"the order {fault}"
    speed_m_s = math.hypot(*order.velocity) if order.velocity is not None else order.speed_m_s
    if speed_m_s is not None and speed_m_s < 0:
        return "the speed is negative; write 0 or more"
    limit_m_s = min(config.flocking.max_speed_m_s, gate.max_speed_m_s)
    if speed_m_s is not None and (fault := fault_of_speed(limit_m_s, speed_m_s)):
        return f"the speed of {fault}"
    if vehicle is None or vehicle.position is None:
        return "the drone does not know where it is: the autopilot has not sent its position"
    if order.velocity is not None:
        return _fault_of_velocity(config, vehicle.position, order.velocity)
    try:
        (waypoint,) = ordered_mission(mission, order).waypoints
    except ValidationError:  # only the goal is not checked above
        return "the goal is farther than any mission leads; name one nearer to home"
    goal = place_of_waypoint(waypoint, np.array(mission.origin_m), vehicle.home_deg)
    if goal is None:
        return "the drone does not know its home in degrees; name the goal in metres from there"
    if (fault := fault_of_place(gate, float(goal[0]), float(goal[1]))) is not None:
        return f"the goal {fault}"
    return None


def _fault_of_velocity(config: DroneConfig, position: FloatArray, velocity: FloatArray) -> str | None:
    gate = config.safety.gate
    then = position + config.mission.timeout_s * velocity
    fault = fault_of_place(gate, float(then[0]), float(then[1]))
    if fault is None or (fault_of_place(gate, *position.tolist()) and math.hypot(*then) < math.hypot(*position)):
        return None
    return f"in {config.mission.timeout_s:g} s the drone {fault}"


def _finite(order: MissionOrder) -> bool:
    parts = (order.place, order.place_deg, order.velocity, order.height_m, order.speed_m_s)
    return all(bool(np.isfinite(part).all()) for part in parts if part is not None)
