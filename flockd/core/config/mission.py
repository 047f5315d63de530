"""The mission of a drone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from flockd.core.config.base import FARTHEST_M, Distance, FromHome, NonNegative, Section, Speed, refuse
from flockd.core.config.safety import GateParameters
from flockd.core.navigation import is_inside, metres_from

MissionKind = Literal["circle_then_tangent", "hover", "velocity", "waypoints", "follow", "operator"]
AtEnd = Literal["hold", "land", "return"]
Faults = dict[tuple[str | int, ...], str]
"""Messages by the keys that lead to the fault."""

_ONLY_FOR: Mapping[str, MissionKind] = {
    "radius_m": "circle_then_tangent",
    "circle_until_s": "circle_then_tangent",
    "velocity_m_s": "velocity",
    "waypoints": "waypoints",
    "at_end": "waypoints",
}
"""Keys that only one kind of mission has."""


class WaypointParameters(Section):
    """A place to fly to: north_m and east_m, or latitude_deg and longitude_deg."""

    north_m: FromHome | None = None
    """From the mission's origin; `east_m` likewise."""
    east_m: FromHome | None = None
    latitude_deg: Annotated[float, Field(ge=-85, le=85)] | None = None
    """On the WGS 84 ellipsoid, as on maps; `longitude_deg` likewise."""
    longitude_deg: Annotated[float, Field(ge=-180, le=180)] | None = None
    height_m: Annotated[float, Field(ge=-1000, le=10_000)] | None = None
    """Height above the ground at home, on the way to this waypoint. null: unchanged."""
    speed_m_s: Speed | None = None
    """Speed on the way to this waypoint. null: the mission's."""

    @model_validator(mode="after")
    def _is_one_place(self) -> Self:
        missing = [(self.north_m, self.east_m).count(None), (self.latitude_deg, self.longitude_deg).count(None)]
        if sorted(missing) != [0, 2]:
            raise ValueError(
                "a waypoint needs `north_m` and `east_m`, or `latitude_deg` and `longitude_deg`; write two"
            )
        return self


class MissionParameters(Section):
    """The mission of this drone. Positions count from its home, where it takes off."""

    kind: MissionKind = "circle_then_tangent"
    """`circle_then_tangent`: the paper's circle and its tangent (Eq. 43). `hover`: standstill. `velocity`: a constant
    velocity. `waypoints`: one after the other. `follow`: no goal of its own (W_i = 0 of Eq. 42). `operator`: orders
    over telemetry that `telemetry.commands` allows."""
    speed_m_s: Speed = 1.0
    """Desired speed: V of Eq. 43, and the speed on the way to goals."""
    radius_m: Distance = 10.0
    """For `circle_then_tangent`."""
    circle_until_s: NonNegative = 66.0
    """For `circle_then_tangent`: time after which the course is straight."""
    velocity_m_s: tuple[float, float] | None = None
    """For `velocity`: north and east."""
    waypoints: Annotated[tuple[WaypointParameters, ...], Field(max_length=1000)] = ()
    at_end: AtEnd = "hold"
    """After the last of the `waypoints`: keep the flock there, or ask the autopilot to land or to return home."""
    reached_m: Distance = 1.0
    """A goal is reached when the flock's middle (of this drone and the neighbours that it sees) is within this
    distance, or near it without coming nearer. For flocks of a hundred write about the flock's radius."""
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 2.0
    """Duration of an operator's velocity, and with kind `operator` of a goal; then the drone hovers."""
    pull: NonNegative = 1.0
    """Factor on `flocking.own_weight`, W_i of Eq. 42. If k of n drones have a goal, the flock flies there at about k/n
    of their speed; a larger factor compensates for that."""
    height_m: Annotated[float, Field(ge=-1000, le=10_000)] | None = None
    """Height above the ground at home, from the beginning on. null: the height at which the flight begins."""
    height_offset_m: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    """Added to all heights of the mission and of an operator's goals, so that drones fly in layers."""
    origin_m: tuple[FromHome, FromHome] = (0.0, 0.0)
    """Origin of the metres of waypoints and of operators' goals, north and east of home. Drones that take off from
    different places and share goals need different values."""

    @model_validator(mode="after")
    def _keys_fit_the_kind(self) -> Self:
        faults: Faults = {}
        for key, kind in _ONLY_FOR.items():
            if self.kind != kind and getattr(self, key) != type(self).model_fields[key].default:
                faults[key,] = f"has no meaning with kind `{self.kind}`, only with `{kind}`; delete it"
        if self.kind == "velocity" and self.velocity_m_s is None:
            faults["kind",] = "`velocity` needs `velocity_m_s`; add it with two numbers, north and east"
        if self.kind == "waypoints" and not self.waypoints:
            faults["kind",] = "`waypoints` needs `waypoints`; add a list with at least one"
        refuse(self, faults)
        return self


def describe(mission: MissionParameters) -> str:
    """The mission in a few words."""
    match mission.kind:
        case "circle_then_tangent":
            return f"{mission.speed_m_s:g} m/s on a circle of {mission.radius_m:g} m until {mission.circle_until_s:g} s"
        case "waypoints":
            count = len(mission.waypoints)
            return f"{mission.speed_m_s:g} m/s to {count} {'waypoint' if count == 1 else 'waypoints'}"
        case "velocity":
            north, east = mission.velocity_m_s or (0.0, 0.0)
            return f"{north:g} m/s north, {east:g} m/s east"
        case kind:
            return kind


def mission_faults(mission: MissionParameters, gate: GateParameters, law_speed_m_s: float) -> Faults:
    """Faults of a mission by key: values that the gate, or the law up to `law_speed_m_s`, would not permit."""
    limit_m_s = min(law_speed_m_s, gate.max_speed_m_s)
    faults = _faults_of_speeds(mission, limit_m_s)
    if mission.kind == "circle_then_tangent":
        turned_rad = min(mission.speed_m_s * mission.circle_until_s / mission.radius_m, math.pi)
        away_m, across_m = 2 * mission.radius_m * math.sin(turned_rad / 2), _fence_across_m(gate)
        if away_m > across_m:
            told = f"leads {away_m:.0f} m away on the circle, and the fence is {across_m:g} m across"
            faults["radius_m",] = f"{told}; write a smaller one"
    heights: dict[tuple[str | int, ...], float | None] = {("height_m",): mission.height_m}
    heights |= {("waypoints", i, "height_m"): waypoint.height_m for i, waypoint in enumerate(mission.waypoints)}
    for key, height_m in heights.items():
        if height_m is not None and (fault := fault_of_height(gate, height_m + mission.height_offset_m)):
            faults[key] = fault
    if mission.kind == "waypoints" and mission.reached_m >= (across_m := _fence_across_m(gate)) / 2:
        told = f"{mission.reached_m:g} m is not below half of the {across_m:g} m across the fence"
        faults["reached_m",] = f"{told}: waypoints count as reached from home; write a smaller one"
    first_deg: tuple[float, float] | None = None
    for i, waypoint in enumerate(mission.waypoints):
        if waypoint.north_m is None or waypoint.east_m is None:  # in degrees: where it is shows before home is known
            assert waypoint.latitude_deg is not None and waypoint.longitude_deg is not None
            first_deg = first_deg or (waypoint.latitude_deg, waypoint.longitude_deg)
            away_m = math.hypot(*metres_from(first_deg, (waypoint.latitude_deg, waypoint.longitude_deg)))
            if away_m > (across_m := _fence_across_m(gate)):
                told = f"is {_far(away_m)} from the first of those in degrees"
                faults["waypoints", i] = f"{told}, and the fence is {across_m:g} m across; correct one"
            continue
        place = waypoint.north_m + mission.origin_m[0], waypoint.east_m + mission.origin_m[1]
        if outside := fault_of_place(gate, *place):
            faults["waypoints", i] = outside
    return faults


def _faults_of_speeds(mission: MissionParameters, limit_m_s: float) -> Faults:
    speeds: dict[tuple[str | int, ...], float | None] = {("speed_m_s",): mission.speed_m_s}
    speeds |= {("waypoints", i, "speed_m_s"): waypoint.speed_m_s for i, waypoint in enumerate(mission.waypoints)}
    if mission.velocity_m_s is not None:
        speeds["velocity_m_s",] = math.hypot(*mission.velocity_m_s)
    faults = {
        key: fault for key, speed in speeds.items() if speed is not None and (fault := fault_of_speed(limit_m_s, speed))
    }
    if mission.kind in {"circle_then_tangent", "waypoints", "operator"}:
        still = (key for key, speed in speeds.items() if speed == 0.0)
        faults |= dict.fromkeys(still, f"0 m/s leads nowhere with kind `{mission.kind}`; write more, or kind `hover`")
    return faults


def fault_of_speed(limit_m_s: float, speed_m_s: float) -> str | None:
    """The fault of a mission's speed; None: it has none."""
    if speed_m_s <= limit_m_s:
        return None
    return (
        f"{speed_m_s:g} m/s is above what flocking.max_speed_m_s and safety.gate.max_speed_m_s let through; "
        f"write {limit_m_s:g} or less"
    )


def fault_of_height(gate: GateParameters, height_m: float) -> str | None:
    """The fault of a height to fly at; None: it has none."""
    if gate.min_height_m <= height_m <= gate.max_height_m:
        return None
    return (
        f"leads to a height of {height_m:g} m, and safety.gate allows {gate.min_height_m:g} to "
        f"{gate.max_height_m:g} m; write another"
    )


def fault_of_place(gate: GateParameters, north_m: float, east_m: float) -> str | None:
    """The fault of a position, metres from home; None: it is within the fence."""
    away_m = math.hypot(north_m, east_m)
    if gate.fence_radius_m is not None and away_m > gate.fence_radius_m:
        return f"is {_far(away_m)} from home, outside the fence of {gate.fence_radius_m:g} m; write a nearer place"
    if gate.fence_corners_m and not is_inside(gate.fence_corners_m, north_m, east_m):
        return f"is {_far(away_m)} from home, outside safety.gate.fence_corners_m; write a place within"
    return None


def _fence_across_m(gate: GateParameters) -> float:
    """Largest distance of two positions within the fence."""
    corners = gate.fence_corners_m
    sides_m = max((math.dist(a, b) for a, b in combinations(corners, 2)), default=math.inf)
    return min(sides_m, 2 * (FARTHEST_M if gate.fence_radius_m is None else gate.fence_radius_m))


def _far(away_m: float) -> str:
    """A distance in words; if it is very large, with the likely mistake in degrees."""
    if away_m > 2 * FARTHEST_M:
        return f"{away_m / 1000:.0f} km (are latitude and longitude swapped, or a sign?)"
    return f"{away_m:.1f} m"
