"""A mission along waypoints."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.mission import MissionParameters, WaypointParameters, fault_of_place
from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray
from flockd.core.navigation import metres_from
from flockd.flight.mission.guidance import Guidance, Moment, course_of, towards

PATIENCE_S = 5.0
"""A waypoint within this flight time counts as reached if the flock has come no nearer for the same time."""
PROGRESS = 0.05
"""Least share of its speed at which a flock comes nearer to a waypoint."""


class Waypoints:
    """Leads the centroid of the flock to one waypoint after the other, and stays at the last one.

    It is the centroid of the drone and its visible neighbours. Drones with the same waypoints see nearly the same
    centroid and so desire the same velocity, as on the paper's circle, instead of crowding at one point. Drones that
    see different neighbours have different centroids: one may turn to the next waypoint while another still flies to
    this one, and the flock stands still. So a waypoint also counts as reached when the flock is near and comes no
    nearer.
    """

    def __init__(self, parameters: MissionParameters, gate: GateParameters) -> None:
        self._parameters, self._gate = parameters, gate
        self._origin = np.array(parameters.origin_m)
        self._next = 0
        self._approach: _Approach | None = None
        self._height_m: float | None = None
        self._arrived = False

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        here = moment.flock
        if here is None:
            return self._stands("waits for the autopilot's position")
        goal = self._goal(moment)
        while goal is not None and not self._arrived and self._is_reached(moment.time_s, math.dist(here, goal)):
            self._height_m, self._approach = self._height, None
            if self._next + 1 < len(self._parameters.waypoints):
                self._next += 1
                goal = self._goal(moment)
            else:
                self._arrived = True
        if goal is None:
            return self._stands("waits for home in degrees, which the autopilot has not sent")
        if (fault := fault_of_place(self._gate, *goal.tolist())) is not None:
            return self._stands(f"{self._name} {fault}")
        self._height_m = self._height
        return self._towards(goal, here)

    def _is_reached(self, time_s: float, away_m: float) -> bool:
        """Whether the current waypoint counts as reached, with the flock's centroid `away_m` from it."""
        reached_m = self._parameters.reached_m
        if self._approach is None:
            self._approach = _Approach(time_s, away_m)
        return away_m <= reached_m or self._approach.ended(time_s, away_m, self._speed_m_s, reached_m)

    def _towards(self, goal: FloatArray, here: FloatArray) -> Guidance:
        p = self._parameters
        last = self._next + 1 == len(p.waypoints)
        velocity = towards(goal, here, self._speed_m_s, stops=last)
        left_m = math.dist(here, goal)
        takeover = p.at_end if self._arrived and p.at_end != "hold" else None
        sentence = f"at {self._name}" if self._arrived else f"{left_m:.0f} m to {self._name}"
        return Guidance(
            velocity=np.zeros(2) if takeover else velocity,
            sentence=sentence,
            course_rad=None if last and left_m < 2 * p.reached_m else course_of(velocity),
            height_m=self._height_m,
            goal=goal,
            arrived=self._arrived,
            takeover=takeover,
        )

    @property
    def _speed_m_s(self) -> float:
        speed_m_s = self._parameters.waypoints[self._next].speed_m_s
        return self._parameters.speed_m_s if speed_m_s is None else speed_m_s

    @property
    def _name(self) -> str:
        count = len(self._parameters.waypoints)
        return "the goal" if count == 1 else f"waypoint {self._next + 1} of {count}"

    def _goal(self, moment: Moment) -> FloatArray | None:
        return place_of_waypoint(self._parameters.waypoints[self._next], self._origin, moment.home_deg)

    @property
    def _height(self) -> float | None:
        """Height of the current waypoint, or of the one before it."""
        height_m = self._parameters.waypoints[self._next].height_m
        return self._height_m if height_m is None else height_m

    def _stands(self, why: str) -> Guidance:
        return Guidance(np.zeros(2), why, height_m=self._height_m)


class _Approach:
    """The shortest distance of the flock's centroid to a waypoint, and since when it has not decreased."""

    def __init__(self, time_s: float, away_m: float) -> None:
        self._first_m = self._nearest_m = away_m
        self._since_s = time_s

    def ended(self, time_s: float, away_m: float, speed_m_s: float, reached_m: float) -> bool:
        """Whether the flock came near and comes no nearer; never before it has moved."""
        reach_m = PATIENCE_S * speed_m_s
        far = away_m > reached_m + 2 * reach_m  # no longer near: patience begins anew
        if far or away_m <= self._nearest_m - PROGRESS * reach_m:
            self._nearest_m, self._since_s = away_m, time_s
        moved, near = self._nearest_m < self._first_m, self._nearest_m <= reached_m + reach_m
        return moved and near and time_s - self._since_s >= PATIENCE_S


def place_of_waypoint(
    waypoint: WaypointParameters, origin: FloatArray, home_deg: FloatArray | None
) -> FloatArray | None:
    """(2,) metres north and east of home; None: the waypoint is in degrees and home is not known."""
    if waypoint.north_m is not None and waypoint.east_m is not None:
        place: FloatArray = origin + np.array([waypoint.north_m, waypoint.east_m])
        return place
    assert waypoint.latitude_deg is not None and waypoint.longitude_deg is not None  # checked by WaypointParameters
    place_deg = waypoint.latitude_deg, waypoint.longitude_deg
    return None if home_deg is None else np.array(metres_from(home_deg.tolist(), place_deg))
