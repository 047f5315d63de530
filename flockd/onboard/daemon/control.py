"""The control loop, every 50 ms: supervisor step, setpoint, and requests to the autopilot. It feeds the watchdog."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flockd.core import services
from flockd.core.config import DroneConfig
from flockd.core.messages import VehicleState, Wanted
from flockd.flight.obstacles import nearest_points
from flockd.flight.safety import (
    FLYING,
    Action,
    Decision,
    Event,
    Permission,
    Request,
    State,
    Supervisor,
    Surroundings,
)
from flockd.flight.safety.surroundings import surroundings
from flockd.onboard.autopilot.autopilot_status import AutopilotStatus
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.autopilot.streamer import SetpointStreamer
from flockd.onboard.daemon.autopilot_tasks import AutopilotRequests, Takeover
from flockd.onboard.daemon.operator_orders import OperatorRequests
from flockd.onboard.daemon.pilot_loop import PilotLoop, VehicleHistory
from flockd.onboard.daemon.supervisor_inputs import InputCollector, position_from_home

PERIOD_S = services.CONTROL.period_s
_TAKEOVERS: dict[Action, Takeover] = {Action.ASK_HOLD: "hold", Action.ASK_RETURN: "return", Action.ASK_LAND: "land"}


class Control:
    """Ticks every `PERIOD_S`, independent of the pilot's steps."""

    def __init__(
        self,
        config: DroneConfig,
        link: AutopilotLink,
        streamer: SetpointStreamer,
        pilot_loop: PilotLoop,
        input_collector: InputCollector,
        requests: AutopilotRequests,
        history: VehicleHistory,
        operator: OperatorRequests,
        on_tick: Callable[[Decision, Decision], None],
        clock: Callable[[], float],
    ) -> None:
        """``on_tick`` is called at the end of each tick with the decision before and the one now."""
        assert config.autopilot is not None
        self._autopilot = config.autopilot
        self._sigmas = config.obstacles.sigmas
        self._link, self._streamer, self._pilot_loop = link, streamer, pilot_loop
        self._input_collector, self._requests, self._history = input_collector, requests, history
        self._operator, self._on_tick, self._clock = operator, on_tick, clock
        self._supervisor = Supervisor(config.safety)
        self._first_steps = max(2, config.tracking.confirm_steps(config.step_s))
        self._height_m = math.nan
        self._yaw_rad = math.nan
        self._flight = 0
        self._request: Request | None = None
        """The last request offered; None in silence."""
        self.decision = Decision(State.IDLE, Action.SILENCE, ())

    async def run(self) -> None:
        """Ticks until cancelled."""
        due_s = self._clock()
        while True:
            self.tick()
            now = self._clock()
            due_s = max(due_s + PERIOD_S, now)
            await asyncio.sleep(due_s - now)

    def tick(self) -> None:
        """One tick."""
        status, vehicle = self._link.status(), self._link.vehicle_state()
        if vehicle is not None:
            self._history.add(vehicle)
        obstacle_m = math.inf if self._request is None else self._request.around.nearest_obstacle_m
        inputs = self._input_collector.collect(
            status, vehicle, self._operator, self._end_of_mission(), self._streamer.report().fault, obstacle_m
        )
        before, now = self.decision, self._clock()
        self.decision = self._supervisor.step(now, inputs)
        self._begin_or_end_flight(before, vehicle)
        self._stream(now, status, vehicle, before)
        self._requests.takeover = self._takeover()
        self._on_tick(before, self.decision)

    def stand_still(self) -> None:
        """Called if no tick follows: the streamer sends standstill until it notices that the control loop is late."""
        if self._request is not None:
            self._streamer.offer(replace(self._request, permission=Permission(Action.ASK_HOLD, self._clock())))

    def _end_of_mission(self) -> str | None:
        """`MissionStatus.takeover` of this flight; None also while the drone does not fly."""
        result = self._pilot_loop.newest
        if self.decision.state not in FLYING or result is None or result.flight != self._flight:
            return None
        return result.output.mission.takeover

    def _begin_or_end_flight(self, before: Decision, vehicle: VehicleState | None) -> None:
        """A flight begins with a new pilot, and holds the drone's height and heading at that time."""
        flies = self.decision.state in FLYING
        if flies and before.state not in FLYING:
            self._flight += 1
            self._pilot_loop.begin_flight(self._flight)
        elif not flies and vehicle is not None:
            self._height_m = self._autopilot.height_m or vehicle.height_m
            self._yaw_rad = _yaw(vehicle)

    def _stream(self, now: float, status: AutopilotStatus, vehicle: VehicleState | None, before: Decision) -> None:
        """Offers the pilot's command with the supervisor's permission, or ends the stream."""
        action = self.decision.action
        if action is Action.SILENCE:
            self._request = None
            self._streamer.end(self.decision.reasons[0].sentence if self.decision.reasons else action)
            return
        if before.action is Action.SILENCE:
            self._streamer.begin()
        wanted, wanted_s = self._wanted(now)
        around = self._around(now, status, vehicle)
        self._request = Request(
            Permission(action, now), wanted, wanted_s, self._height_m, around, fastest_m_s=status.fastest_m_s
        )
        self._streamer.offer(self._request)
        self._streamer.beat()

    def _wanted(self, now: float) -> tuple[Wanted, float]:
        """The pilot's command and its time; standstill during a flight's first steps.

        Before them it knows neither its ego-motion nor its neighbours.
        """
        result = self._pilot_loop.newest
        if result is None or result.flight != self._flight or result.number < self._first_steps:
            return Wanted(np.zeros(2), np.zeros(2), self._yaw_rad), now
        return result.output.command, result.time_s

    def _around(self, now: float, status: AutopilotStatus, vehicle: VehicleState | None) -> Surroundings:
        known = vehicle is not None and now - vehicle.time_s <= services.MOTION.timeout
        velocity = vehicle.velocity_ned if vehicle is not None and known else None
        result = self._pilot_loop.newest
        ranges = None if result is None else result.output.obstacles
        return surroundings(
            () if result is None else result.output.neighbours,
            0.0 if result is None else now - result.time_s,
            moved=np.zeros(3) if result is None else self._history.moved_since(result.time_s),
            position=position_from_home(status) if known else np.full(2, np.nan),
            velocity=np.full(3, np.nan) if velocity is None else velocity,
            yaw_rad=math.nan if vehicle is None else _yaw(vehicle),
            height_m=math.nan if vehicle is None else vehicle.height_m,
            obstacles=np.empty((0, 2)) if ranges is None else nearest_points(ranges, self._sigmas),
            seen_m=None if result is None else result.output.seen_m,
        )

    def _takeover(self) -> Takeover | None:
        takeover = _TAKEOVERS.get(self.decision.action)
        by_people = {Event.SHUTDOWN_ASKED, Event.HOLD_ASKED} & {reason.event for reason in self.decision.reasons}
        return self._autopilot.on_failure if takeover == "hold" and not by_people else takeover


def _yaw(vehicle: VehicleState) -> float:
    R = vehicle.R_ned_body
    return math.atan2(R[1, 0], R[0, 0])
