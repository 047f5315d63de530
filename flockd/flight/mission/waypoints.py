"""A mission from place to place."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.mission import MissionParameters
from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray
from flockd.flight.mission.guidance import Guidance, Moment, course_of, towards
from flockd.flight.mission.places import place_of_waypoint
from flockd.flight.safety.fence import outside_fence

PATIENCE_S = 5.0
"""A flock that comes no nearer for so long has been at its waypoint, if that is no farther than it flies in as long."""
PROGRESS = 0.05
"""Share of its speed; a flock that is slower on the way to a waypoint comes no nearer."""


class Waypoints:
    """Leads the middle of the flock to one waypoint after the other, and stays at the last one.

    The middle is of the drone and of the neighbours that it sees. Drones that fly the same waypoints see nearly the
    same middle and so want the same velocity, as on the paper's circle, instead of all wanting to be at one spot.

    Drones that see different neighbours see different middles: one may see its own at a waypoint and turn to the next
    while another still flies to this one, and both hold the flock where it is. So a waypoint counts as reached, too,
    where the flock has come near to it and comes no nearer.
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
        if outside_fence(self._gate, goal):
            return self._stands(f"{self._name} is outside the fence")
        self._height_m = self._height
        return self._towards(goal, here)

    def _is_reached(self, time_s: float, away_m: float) -> bool:
        """Whether the waypoint that is flown to counts as reached, with the flock's middle so far from it."""
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
        """That of the waypoint that is flown to, or of the one before it."""
        height_m = self._parameters.waypoints[self._next].height_m
        return self._height_m if height_m is None else height_m

    def _stands(self, why: str) -> Guidance:
        return Guidance(np.zeros(2), why, height_m=self._height_m)


class _Approach:
    """How near the middle of the flock has come to a waypoint, and since when it has not come nearer."""

    def __init__(self, time_s: float, away_m: float) -> None:
        self._first_m = self._nearest_m = away_m
        self._since_s = time_s

    def ended(self, time_s: float, away_m: float, speed_m_s: float, reached_m: float) -> bool:
        """Whether it came near, and comes no nearer; of one that has not moved yet, it is not known."""
        reach_m = PATIENCE_S * speed_m_s
        far = away_m > reached_m + 2 * reach_m  # than it can have flown from near within its patience
        if far or away_m <= self._nearest_m - PROGRESS * reach_m:
            self._nearest_m, self._since_s = away_m, time_s
        moved, near = self._nearest_m < self._first_m, self._nearest_m <= reached_m + reach_m
        return moved and near and time_s - self._since_s >= PATIENCE_S
