"""A mission steered by an operator over telemetry."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.mission import MissionParameters
from flockd.core.messages import MissionOrder
from flockd.flight.mission.guidance import Guidance, Moment, course_of, towards
from flockd.flight.mission.places import place_of_order


class Operator:
    """Flies the newest order; hovers if there is no new one for `timeout_s`."""

    def __init__(self, parameters: MissionParameters) -> None:
        self._parameters = parameters
        self._origin = np.array(parameters.origin_m)
        self._order: MissionOrder | None = None
        self._since_s = -math.inf

    def step(self, moment: Moment) -> Guidance:
        """See `Mission`."""
        if moment.order is not None:
            self._order, self._since_s = moment.order, moment.time_s
        if self._order is None or moment.time_s - self._since_s >= self._parameters.timeout_s:
            return Guidance(np.zeros(2), "hovers until an operator's next order")
        if self._order.velocity is not None:
            velocity = self._order.velocity
            return Guidance(velocity, "flies an operator's velocity", course_of(velocity), self._order.height_m)
        return self._to_goal(self._order, moment)

    def _to_goal(self, order: MissionOrder, moment: Moment) -> Guidance:
        goal, here = place_of_order(order, self._origin, moment.home_deg), moment.flock
        if goal is None or here is None:
            return Guidance(np.zeros(2), "waits for the autopilot's position", height_m=order.height_m)
        speed_m_s = self._parameters.speed_m_s if order.speed_m_s is None else order.speed_m_s
        velocity, left_m = towards(goal, here, speed_m_s, stops=True), math.dist(here, goal)
        arrived = left_m <= self._parameters.reached_m
        return Guidance(
            velocity=velocity,
            sentence="at an operator's goal" if arrived else f"{left_m:.0f} m to an operator's goal",
            course_rad=None if left_m < 2 * self._parameters.reached_m else course_of(velocity),
            height_m=order.height_m,
            goal=goal,
            arrived=arrived,
        )
