"""Laps: mission, gate and vehicle in closed loop, turning to one side all the time."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from flockd.core.config.mission import MissionParameters
from flockd.core.config.safety import GateParameters
from flockd.core.messages import Setpoint, Wanted
from flockd.flight.mission import Moment, Navigator
from flockd.flight.safety import Action, Gate, Permission, Request
from flockd.flight.safety.surroundings import surroundings
from flockd.sim.autopilot.fake_vehicle import Demand, PointMass

PERIOD_S, PERIODS = 0.1, 5
"""Of the gate; and how many a step of the mission has."""
SIDE_M, SPEED_M_S, SQUARES, HEIGHT_M = 12.0, 1.5, 10, 5.0
TURN_RAD_S = 0.2
"""The heading turns no faster."""


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["to the right", "to the left"])
def test_ten_squares_are_flown_without_standing_and_with_the_heading_along(side: float) -> None:
    corners = [(SIDE_M, 0.0), (SIDE_M, side * SIDE_M), (0.0, side * SIDE_M), (0.0, 0.0)] * SQUARES
    waypoints = tuple({"north_m": north, "east_m": east} for north, east in corners)
    mission = MissionParameters.model_validate(
        {"kind": "waypoints", "speed_m_s": SPEED_M_S, "reached_m": 1.0, "waypoints": waypoints}
    )
    navigator, gate = Navigator(mission, GateParameters()), Gate(GateParameters())
    vehicle = PointMass(np.array([0.0, 0.0, -HEIGHT_M]))
    state = vehicle(Demand(np.zeros(2), -HEIGHT_M, 0.0), 0.0)
    setpoints: list[Setpoint] = []
    turned_rad = now_s = 0.0
    for _ in range(1200):
        guidance = navigator.step(Moment(now_s, state.position[:2]))
        if guidance.arrived:
            break
        wanted, wanted_s = Wanted(guidance.velocity, np.zeros(2), guidance.course_rad), now_s
        for _ in range(PERIODS):
            R = state.R_ned_body
            around = surroundings(
                (), 0.0, moved=np.zeros(3), position=state.position[:2], velocity=state.velocity,
                yaw_rad=math.atan2(R[1, 0], R[0, 0]), height_m=HEIGHT_M, obstacles=np.empty((0, 2)),
            )  # fmt: skip
            verdict = gate.step(now_s, Request(Permission(Action.FLY, now_s), wanted, wanted_s, HEIGHT_M, around))
            assert verdict.objections == ()
            assert verdict.setpoint is not None
            setpoints.append(verdict.setpoint)
            before_rad = math.atan2(R[1, 0], R[0, 0])
            state = vehicle(Demand(verdict.setpoint.velocity, -HEIGHT_M, verdict.setpoint.yaw_rad), PERIOD_S)
            R = state.R_ned_body
            turned_rad += math.remainder(math.atan2(R[1, 0], R[0, 0]) - before_rad, math.tau)
            now_s += PERIOD_S
    assert guidance.sentence == f"at waypoint {4 * SQUARES} of {4 * SQUARES}"
    assert turned_rad == pytest.approx(side * math.tau * SQUARES, abs=2.0), "as often as it went around"
    speeds = np.hypot(*np.array([setpoint.velocity for setpoint in setpoints[10:-40]]).T)
    assert speeds.min() > 0.5 * SPEED_M_S, "it never stands"
    headings = [setpoint.yaw_rad for setpoint in setpoints]
    assert all(-math.pi < heading <= math.pi for heading in headings)
    jumps = [abs(math.remainder(after - before, math.tau)) for before, after in pairwise(headings)]
    assert max(jumps) <= TURN_RAD_S * PERIODS * PERIOD_S + 1e-9
