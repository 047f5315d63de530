"""The control loop: asks the supervisor what to do, and does it. The setpoints and the watchdog live by it."""

from __future__ import annotations

import asyncio
import bisect
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from flockd.autopilot.mavsdk_link import AutopilotLink
from flockd.autopilot.status import AutopilotStatus
from flockd.autopilot.streamer import SetpointStreamer
from flockd.config import DroneConfig
from flockd.daemon.inspection import Asked, Inspector, position_from_home
from flockd.daemon.requests import Requests, Wish
from flockd.daemon.sight import Sight
from flockd.messages import FloatArray, Setpoint, VehicleState, VelocityCommand
from flockd.safety import (
    Action,
    Decision,
    Event,
    Gate,
    Permission,
    State,
    Supervisor,
    Surroundings,
    Wanted,
)

PERIOD_S = 0.05
HISTORY_S = 2.0
FLYING = frozenset({State.NORMAL, State.DEGRADED, State.HOVER, State.ASKING})
_WISHES: dict[Action, Wish] = {Action.ASK_HOLD: "hold", Action.ASK_RETURN: "return", Action.ASK_LAND: "land"}


@dataclass(frozen=True, eq=False)
class Clearance:
    """What the gate goes by, as of the last tick."""

    permission: Permission
    around: Surroundings
    command_time_s: float
    """When the command in the setpoints was made."""


class Door:
    """The last gate as the streamer calls it, on its own thread: judges each setpoint just before it is sent."""

    def __init__(self, gate: Gate, clock: Callable[[], float]) -> None:
        self._gate, self._clock = gate, clock
        self.clearance: Clearance | None = None

    def __call__(self, setpoint: Setpoint) -> Setpoint | None:
        """What may be sent in its place."""
        clearance = self.clearance
        if clearance is None:
            return None
        command = VelocityCommand(setpoint.velocity, np.zeros(2), setpoint.yaw_rad)
        wanted = Wanted(command, clearance.command_time_s, setpoint.height_m)
        return self._gate.step(self._clock(), clearance.permission, wanted, clearance.around).setpoint


class VehicleHistory:
    """The vehicle's last states, for frames that were taken a moment ago."""

    def __init__(self) -> None:
        self._states: deque[VehicleState] = deque()

    def add(self, state: VehicleState) -> None:
        """The newest."""
        if not self._states or state.time_s > self._states[-1].time_s:
            self._states.append(state)
        while self._states[-1].time_s - self._states[0].time_s > HISTORY_S:
            self._states.popleft()

    def at(self, time_s: float) -> VehicleState | None:
        """The state at that time, between two that are known; for frames of another clock, the newest."""
        if not self._states:
            return None
        if not self._states[0].time_s - HISTORY_S <= time_s <= self._states[-1].time_s + HISTORY_S:
            return self._states[-1]
        later = bisect.bisect_left(self._states, time_s, key=lambda state: state.time_s)
        if later in (0, len(self._states)):
            return self._states[max(0, later - 1)]
        return _between(self._states[later - 1], self._states[later], time_s)


def _between(before: VehicleState, after: VehicleState, time_s: float) -> VehicleState:
    """As if it had turned and moved evenly from the one to the other."""
    share = (time_s - before.time_s) / (after.time_s - before.time_s)
    turn, _ = cv2.Rodrigues(before.R_ned_body.T @ after.R_ned_body)
    part, _ = cv2.Rodrigues(share * np.asarray(turn, np.float64))
    velocity = after.velocity_ned
    if velocity is not None and before.velocity_ned is not None:
        velocity = before.velocity_ned + share * (velocity - before.velocity_ned)
    return VehicleState(
        time_s=time_s,
        R_ned_body=before.R_ned_body @ np.asarray(part, np.float64),
        height_m=before.height_m + share * (after.height_m - before.height_m),
        velocity_ned=velocity,
    )


class Control:
    """One tick every 50 ms, whatever else happens."""

    def __init__(
        self,
        config: DroneConfig,
        link: AutopilotLink,
        streamer: SetpointStreamer,
        door: Door,
        sight: Sight,
        inspector: Inspector,
        requests: Requests,
        history: VehicleHistory,
        asked: Asked,
        on_tick: Callable[[Decision, Decision], None],
        clock: Callable[[], float],
    ) -> None:
        """``on_tick`` is told the decision before and the one now, when all is done."""
        assert config.autopilot is not None
        self._autopilot = config.autopilot
        self._link, self._streamer, self._door, self._sight = link, streamer, door, sight
        self._inspector, self._requests, self._history = inspector, requests, history
        self._asked, self._on_tick, self._clock = asked, on_tick, clock
        self._supervisor = Supervisor(config.safety)
        self._enough_looks = max(2, config.tracking.confirm_hits)
        self._height_m = math.nan
        self._yaw_rad = math.nan
        self._flight = 0
        self.decision = Decision(State.IDLE, Action.SILENCE, ())

    async def run(self) -> None:
        """Ticks for ever."""
        due_s = self._clock()
        while True:
            self.tick()
            now = self._clock()
            due_s = max(due_s + PERIOD_S, now)
            await asyncio.sleep(due_s - now)

    def tick(self) -> None:
        """Everything, once."""
        status, vehicle = self._link.status(), self._link.vehicle_state()
        if vehicle is not None:
            self._history.add(vehicle)
        inputs = self._inspector.inspect(status, vehicle, self._asked)
        before, now = self.decision, self._clock()
        self.decision = self._supervisor.step(now, inputs)
        self._turn(before, vehicle)
        self._speak(now, status, vehicle, before)
        self._requests.wish = self._wish()
        self._on_tick(before, self.decision)

    def stand_still(self) -> None:
        """For when there is no next tick: from now on the streamer sends standstill, until it notices and is silent."""
        if self._door.clearance is not None:
            permission = Permission(Action.ASK_HOLD, self._clock())
            self._door.clearance = replace(self._door.clearance, permission=permission)

    def _turn(self, before: Decision, vehicle: VehicleState | None) -> None:
        """A flight begins with a fresh pilot, and at the height and with the heading that the drone has then."""
        flies = self.decision.state in FLYING
        if flies and before.state not in FLYING:
            self._flight += 1
            self._sight.begin_flight(self._flight)
        elif not flies and vehicle is not None:
            self._height_m = self._autopilot.height_m or vehicle.height_m
            self._yaw_rad = _yaw(vehicle)

    def _speak(self, now: float, status: AutopilotStatus, vehicle: VehicleState | None, before: Decision) -> None:
        """Offers a setpoint with what the gate needs to judge it, or ends the stream."""
        action = self.decision.action
        if action is Action.SILENCE:
            self._door.clearance = None
            self._streamer.end(self.decision.reasons[0].sentence if self.decision.reasons else action)
            return
        if before.action is Action.SILENCE:
            self._streamer.begin()
        velocity, yaw_rad, made_s = self._command(now)
        around = self._around(now, status, vehicle)
        self._door.clearance = Clearance(Permission(action, now), around, made_s)
        self._streamer.offer(Setpoint(now, velocity, self._height_m, yaw_rad))
        self._streamer.beat()

    def _command(self, now: float) -> tuple[FloatArray, float, float]:
        """Velocity, heading, and when that was decided: standstill until this flight's pilot has looked often enough.

        It knows neither its own motion nor its neighbours before that.
        """
        look = self._sight.newest
        if look is None or look.flight != self._flight or look.number < self._enough_looks:
            return np.zeros(2), self._yaw_rad, now
        return look.output.command.velocity, look.output.command.yaw_rad, look.time_s

    def _around(self, now: float, status: AutopilotStatus, vehicle: VehicleState | None) -> Surroundings:
        known = vehicle is not None and vehicle.velocity_ned is not None
        velocity = vehicle.velocity_ned if vehicle is not None and known else np.full(3, np.nan)
        assert velocity is not None
        return Surroundings(
            position=position_from_home(status),
            velocity=velocity[:2],
            yaw_rad=math.nan if vehicle is None else _yaw(vehicle),
            neighbours=self._neighbours(now, velocity),
        )

    def _neighbours(self, now: float, velocity: FloatArray) -> FloatArray:
        """(n, 3) where the confirmed ones are now, if nobody has changed its velocity since they were seen."""
        look = self._sight.newest
        if look is None:
            return np.empty((0, 3))
        own = np.nan_to_num(velocity)
        age_s = now - look.time_s
        places = [n.position + age_s * (n.velocity - own) for n in look.output.neighbours if n.confirmed]
        return np.reshape(places, (len(places), 3))

    def _wish(self) -> Wish | None:
        wish = _WISHES.get(self.decision.action)
        by_people = {Event.SHUTDOWN_ASKED, Event.HOLD_ASKED} & {reason.event for reason in self.decision.reasons}
        return self._autopilot.on_failure if wish == "hold" and not by_people else wish


def _yaw(vehicle: VehicleState) -> float:
    R = vehicle.R_ned_body
    return math.atan2(R[1, 0], R[0, 0])
