"""Flies a drone's mission: the configured one, or the one of an operator's order."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from flockd.core.config.mission import MissionParameters, WaypointParameters
from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray, MissionOrder, MissionStatus
from flockd.core.navigation import wrapped
from flockd.flight.geometry import Rig
from flockd.flight.mission.circle_then_tangent import CircleThenTangent
from flockd.flight.mission.guidance import Guidance, Mission, Moment, course_of
from flockd.flight.mission.velocity import Velocity
from flockd.flight.mission.waypoints import Waypoints
from flockd.flight.obstacles import AZIMUTHS, in_view

MAX_TURN_RAD_S = 0.2
"""Largest turn rate of the heading, except on the paper's circle: fast turns blur the images."""
_BESIDE = 3
"""Sectors on both sides of the course that have to be in view too: a neighbour in them is wholly in the image."""


class Navigator:
    """The mission of one flight, with its progress."""

    def __init__(self, parameters: MissionParameters, gate: GateParameters) -> None:
        self._configured, self._gate = parameters, gate
        self._parameters = parameters
        self._mission = _mission(parameters, gate)
        self._began_s = 0.0
        self._lapses = False
        """Whether the mission ends `timeout_s` after it began."""
        self._height_m = parameters.height_m
        """The last height of the mission or an order, without offset; kept until there is another."""
        self._course_rad: float | None = None
        self._turned_s = 0.0

    def step(self, moment: Moment) -> Guidance:
        """The mission's guidance, `moment.time_s` after the flight began; an order replaces the mission.

        The configured offset is added to its height, and its course turns no faster than `MAX_TURN_RAD_S`.
        """
        if moment.order is not None:
            self._replace(moment.order, moment.time_s)
        if self._lapses and moment.time_s - self._began_s >= self._configured.timeout_s:
            self._mission = Velocity((0.0, 0.0), _SENTENCES["operator"])
        guidance = self._mission.step(replace(moment, time_s=moment.time_s - self._began_s))
        if guidance.height_m is not None:
            self._height_m = guidance.height_m
        height_m = None if self._height_m is None else self._height_m + self._configured.height_offset_m
        if self._course_rad is None:
            self._course_rad = moment.heading_rad
        is_paper = self._parameters.kind == "circle_then_tangent"
        course_rad = guidance.course_rad if is_paper else self._turned(guidance.course_rad, moment.time_s)
        guidance = replace(guidance, height_m=height_m, course_rad=course_rad)
        self._course_rad, self._turned_s = guidance.course_rad, moment.time_s
        return guidance

    def status(self, guidance: Guidance) -> MissionStatus:
        """For telemetry and recordings; see `PilotOutput.mission`."""
        return MissionStatus(
            kind=self._parameters.kind,
            desired=guidance.velocity * self._parameters.pull,
            sentence=guidance.sentence,
            goal=guidance.goal,
            goal_height_m=guidance.height_m,
            arrived=guidance.arrived,
            takeover=guidance.takeover,
        )

    def _replace(self, order: MissionOrder, time_s: float) -> None:
        """Begins an order's mission: a velocity lapses after some seconds; a goal does so in an operator's mission."""
        ordered, by_operator = ordered_mission(self._configured, order), self._configured.kind == "operator"
        if not by_operator:
            self._parameters = ordered
        if order.velocity is None:
            self._mission = Waypoints(ordered, self._gate)
        else:
            self._mission = Velocity(order.velocity.tolist(), "flies an operator's velocity")
            self._height_m = self._height_m if order.height_m is None else order.height_m
        self._began_s, self._lapses = time_s, by_operator or order.velocity is not None

    def _turned(self, wanted_rad: float | None, time_s: float) -> float | None:
        """The course after turning from the last one at the largest turn rate."""
        before_rad = self._course_rad
        if wanted_rad is None or before_rad is None:
            return before_rad if wanted_rad is None else wanted_rad
        most_rad = MAX_TURN_RAD_S * max(time_s - self._turned_s, 0.0)
        turn_rad = wrapped(wanted_rad - before_rad)
        return before_rad + min(max(turn_rad, -most_rad), most_rad)


class Lookout:
    """Turns the heading so that a camera looks in the direction of flight, if one is lost or the rig has a gap."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._time_s = math.inf
        self.turn_rad = 0.0
        """The current turn of the heading."""

    def heading(self, time_s: float, heading_rad: float, velocity: FloatArray, gone: frozenset[str]) -> float:
        """The heading to fly with instead of `heading_rad`, given the wanted `velocity` (2,) m/s.

        `gone`: cameras without image. It turns so slowly that a single missing frame hardly matters.
        """
        course_rad, wanted_rad = course_of(velocity), self.turn_rad
        if course_rad is not None:
            ahead_rad, wanted_rad = course_rad - heading_rad, 0.0
            view, beside = in_view(self._rig, gone), np.arange(-_BESIDE, _BESIDE + 1)
            if not view.take(round(ahead_rad / AZIMUTHS[1]) + beside, mode="wrap").all():
                clear = np.all([np.roll(view, k) for k in beside], axis=0)
                turns_rad = [wrapped(ahead_rad - at_rad) for at_rad in AZIMUTHS[clear]]
                wanted_rad = min(turns_rad, key=lambda turn_rad: abs(turn_rad - self.turn_rad), default=0.0)
        most_rad = MAX_TURN_RAD_S * max(time_s - self._time_s, 0.0)
        self.turn_rad += min(max(wanted_rad - self.turn_rad, -most_rad), most_rad)
        self._time_s = time_s
        return wrapped(heading_rad + self.turn_rad)


def ordered_mission(configured: MissionParameters, order: MissionOrder) -> MissionParameters:
    """The mission that replaces the configured one by an order; see `Navigator`."""
    kept = configured.model_dump(include={"speed_m_s", "reached_m", "timeout_s", "origin_m"})
    if order.velocity is not None:
        return MissionParameters(kind="operator", **kept)
    place = {}
    if order.place is not None:
        place = {"north_m": float(order.place[0]), "east_m": float(order.place[1])}
    elif order.place_deg is not None:
        place = {"latitude_deg": float(order.place_deg[0]), "longitude_deg": float(order.place_deg[1])}
    waypoint = WaypointParameters(height_m=order.height_m, speed_m_s=order.speed_m_s, **place)
    return MissionParameters(kind="waypoints", waypoints=(waypoint,), **kept)


def middle_of(neighbours: FloatArray) -> FloatArray:
    """(2,) metres: the centroid of the drone, at the origin, and its neighbours at (n, 2) metres."""
    middle: FloatArray = neighbours.sum(axis=0) / (len(neighbours) + 1)
    return middle if len(neighbours) else np.zeros(2)


def _mission(parameters: MissionParameters, gate: GateParameters) -> Mission:
    match parameters.kind:
        case "circle_then_tangent":
            return CircleThenTangent(parameters)
        case "waypoints":
            return Waypoints(parameters, gate)
        case kind:
            return Velocity(parameters.velocity_m_s or (0.0, 0.0), _SENTENCES[kind])


_SENTENCES = {
    "hover": "hovers",
    "velocity": "flies at its velocity",
    "follow": "follows the flock",
    "operator": "hovers until an operator's next order",
}
"""What a drone with a constant velocity does, by the kind of its mission."""
