"""The daemon's control loop in simulated time: each drone's gate turns what its pilot asks for into setpoints."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from flockd.core.errors import UsageError
from flockd.core.messages import NO_STATUS, FloatArray, MissionStatus, Neighbour, ObstacleRanges, Setpoint, Wanted
from flockd.flight.obstacles import nearest_points
from flockd.flight.safety import (
    OFFBOARD,
    Action,
    CameraHealth,
    Decision,
    Event,
    Gate,
    Inputs,
    Objection,
    Permission,
    Request,
    State,
    Supervisor,
    Surroundings,
    Verdict,
    outside_fence,
    outside_heights,
)
from flockd.flight.safety.surroundings import surroundings
from flockd.review.flight_log.metadata import HandedOver
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.vehicles.vehicles import UNDISTURBED, Disturbances, Vehicles


@dataclass(frozen=True, eq=False)
class Commands:
    """What n drones are asked for in one step."""

    velocity: FloatArray
    """(n, 2) m/s, north and east."""
    acceleration: FloatArray
    """(n, 2) m/s^2; 0 of a drone that is flown by hand."""
    yaw_rad: FloatArray
    """(n,)"""
    height_m: FloatArray
    """(n,), up positive; NaN: as high as now."""
    missions: list[MissionStatus]
    """See `PilotOutput.mission`."""
    desired: FloatArray
    """(n, 2) m/s: what each mission wants, times its pull."""
    obstacles: list[ObstacleRanges | None]
    """What each drone saw of them; None where it does not look for any."""
    seen_m: list[FloatArray | None]
    """See `PilotOutput.seen_m`."""
    neighbours: list[tuple[Neighbour, ...]]
    """What each drone knows of the others."""

    @classmethod
    def of(cls, n: int) -> Self:
        """Commands of n drones that stand still, to be filled in."""
        still = (np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n), np.full(n, np.nan))
        return cls(*still, [NO_STATUS] * n, np.zeros((n, 2)), [None] * n, [None] * n, [()] * n)


RETURN_M_S = 2.0
_THERE_M = 0.5
_HOLD_PER_S = 0.95
"""Velocity for each metre from where an autopilot holds: PX4's default of MPC_XY_P."""
_HOLD_BRAKING_M_S2 = 3.0
"""Deceleration to the place where it holds, once it answers: PX4's default of MPC_ACC_HOR."""


_SEES = CameraHealth(age_s=0.0, period_s=1.0, fault=None)
_LOST = replace(_SEES, fault="unplugged")
_WELL = Inputs(
    cameras={"one": _SEES}, dropped_share=0.0, estimate_age_s=0.0, ego_motion_age_s=0.0, network_faults=0,
    inference_stuck=False, load=0.0, temperature_c=None, loop_lag_s=0.0, velocity_late_s=0.0, velocity_error_m_s=0.0,
    dead_tasks=(),
    neighbours_age_s=0.0, nearest_neighbour_m=math.inf, refused_commands=0, obstacle_near=False,
    outside_fence=False, outside_heights=False, motion_age_s=0.0,
    heartbeat_age_s=0.0, message_age_s=0.0, stream_fault=None, autopilot_failsafe=False, foreign_setpoints=None,
    parameter_fault=None, frame_jumped=False, flight_mode=OFFBOARD, armed=True, in_air=True, battery_low=False,
    position_lost=False, shutdown_asked=False, hold_asked=False, land_asked=False, resume_asked=False,
)  # fmt: skip


class _Drone:
    """The control loop of one gated drone's daemon; the drone is in flight from the start."""

    def __init__(self, scenario: ScenarioConfig, number: int) -> None:
        self._parameters = scenario.drone_of(number).safety
        self.gate = Gate(self._parameters.gate)
        self._cameras = dict.fromkeys((camera.name for camera in scenario.drone.rig.cameras), _SEES)
        self.degraded_by: frozenset[Event] = frozenset()
        """Why the drone was last degraded: it flies slower for a while after that is over."""
        self._supervisor = Supervisor(self._parameters)
        for changes in ({"armed": False, "in_air": False, "flight_mode": "hold"}, {"flight_mode": "hold"}, {}):
            self._supervisor.step(-math.inf, replace(_WELL, **changes))

    def decide(self, now_s: float, around: Surroundings, lost: Collection[str]) -> Decision:
        """The supervisor's decision as of `now_s`; `lost`: the names of its lost cameras."""
        limits = self._parameters.gate
        inputs = replace(
            _WELL,
            cameras={**self._cameras, **dict.fromkeys(lost, _LOST)},
            velocity_late_s=self.gate.response.late_s,
            velocity_error_m_s=self.gate.response.error_m_s,
            obstacle_near=around.nearest_obstacle_m < self._parameters.hold_room_m,
            outside_fence=outside_fence(limits, around.position),
            outside_heights=outside_heights(limits, around.height_m),
        )
        decision = self._supervisor.step(now_s, inputs)
        if decision.state is State.DEGRADED and decision.reasons:
            self.degraded_by = frozenset(reason.event for reason in decision.reasons)
        return decision


_OBJECTED = {
    Objection.SEPARATION: "neighbour", Objection.OBSTACLE: "obstacle", Objection.FENCE: "fence",
    Objection.UNSEEN: "unseen",
}  # fmt: skip
_DEGRADED = {
    Event.VELOCITY_OFF: "wind", Event.NO_ROOM_TO_HOLD: "wind", Event.CAMERA_LOST: "camera", Event.FENCE_LEFT: "fence",
}  # fmt: skip
"""Causes by the gate's objection, and by why the supervisor slowed a drone down; all else is `other`."""
_SLOWED = 0.05
"""A velocity that differs from the one asked for by a smaller share of it counts as the same."""


class SlowedTime:
    """For how long gates let drones fly otherwise than they were asked to, by cause; a moment may have several."""

    def __init__(self) -> None:
        self._flown_s = self._slowed_s = 0.0
        self._by_cause_s: dict[str, float] = {}

    def add(self, period_s: float, request: Request, verdict: Verdict, degraded_by: Collection[Event] = ()) -> None:
        """Counts `period_s` of one drone's flight; `degraded_by`: why it was last degraded."""
        self._flown_s += period_s
        asked, setpoint = request.wanted.velocity, verdict.setpoint
        if setpoint is None or math.hypot(*(setpoint.velocity - asked)) <= _SLOWED * math.hypot(*asked):
            return
        self._slowed_s += period_s
        causes = {_OBJECTED[objection] for objection in verdict.objections if objection in _OBJECTED}
        if request.permission.action is Action.FLY_DEGRADED:
            causes |= {_DEGRADED.get(event, "other") for event in degraded_by}
        for cause in sorted(causes or {"other"}):
            self._by_cause_s[cause] = self._by_cause_s.get(cause, 0.0) + period_s

    @property
    def share(self) -> float | None:
        """Share of the time flown; None: no time was flown."""
        return self._slowed_s / self._flown_s if self._flown_s else None

    @property
    def by_cause(self) -> dict[str, float]:
        """Share of the time flown, by cause."""
        return {cause: slowed_s / self._flown_s for cause, slowed_s in sorted(self._by_cause_s.items())}


PERIOD_S = 0.05
"""Between two setpoints, as `autopilot.setpoint_rate_hz` is by default."""
_SAME_TIME_S = 1e-9


class _Order(NamedTuple):
    """What drones were asked for, by their pilots or by autopilots that took over, when, and where they were."""

    time_s: float
    places: FloatArray
    commands: Commands


class ControlLoop:
    """Flies all drones of a flight from one step of their pilots to the next.

    Each has a gate, and a supervisor that knows of wind, fence, heights and, with made-up detections, lost cameras:
    it flies slower, or asks for Hold. A person's drone, and one whose autopilot has taken over, fly without them.
    """

    def __init__(self, scenario: ScenarioConfig, *, gated: bool = True) -> None:
        """Not `gated`: setpoints are what the pilots ask for.

        Raises UsageError for steps so far apart that gates would send nothing before the next one.
        """
        oldest_s = scenario.drone.step_s + scenario.step_latency_s
        silent_s = scenario.drone.safety.gate.command_timeout_s
        if gated and oldest_s > silent_s:
            raise UsageError(
                f"a command gets {oldest_s:g} s old, with drone.step_s {scenario.drone.step_s:g} and its latency, and "
                f"gates send none above safety.gate.command_timeout_s {silent_s:g}; write a smaller step_s"
            )
        self._scenario, self._step_s = scenario, scenario.drone.step_s
        self._drones = {i: _Drone(scenario, i) for i, one in enumerate(scenario.vehicles) if gated and not one.by_hand}
        self._starts = np.array([vehicle.position_m for vehicle in scenario.vehicles])
        self._taken: dict[int, str] = {}
        """How an autopilot has taken over, `hold`, `land` or `return`: its pilot's commands no longer count."""
        self._held: dict[int, FloatArray] = {}
        """Where those in Hold stay, (3,) m NED."""
        self._orders: deque[_Order] = deque()
        """The one in force, and those that are still being computed."""
        self._disturbed = UNDISTURBED
        self._supervised: dict[int, Decision] = {}
        self.slowed = SlowedTime()
        """How long gates let drones fly otherwise than their pilots asked for."""
        self.handed_over: dict[int, HandedOver] = {}
        """By the drone's number, from 0."""

    def hold(self, i: int, time_s: float, vehicles: Vehicles, why: str = "an operator asked for Hold") -> None:
        """The drone's autopilot takes over, goes into Hold and stays where it comes to rest."""
        config, velocity = self._scenario.vehicle, vehicles.known_velocity[i]
        response_s = config.dead_time_s + config.velocity_time_constant_s
        stops_s = response_s + math.hypot(*velocity[:2]) / (2 * _HOLD_BRAKING_M_S2)
        self._taken[i], self._held[i] = "hold", vehicles.known_position[i] + velocity * [stops_s, stops_s, 0.0]
        self.handed_over[i] = HandedOver(time_s=time_s, reason=why)

    def resume(self, i: int) -> None:
        """An operator lets a drone that its autopilot holds fly on as its pilot asks."""
        if self._taken.pop(i, None) is None:
            return
        self._held.pop(i, None)
        self._supervised.pop(i, None)
        if i in self._drones:
            self._drones[i] = _Drone(self._scenario, i)

    def status(self, i: int) -> tuple[State, tuple[str, ...]]:
        """Who flies a drone, and why, as in telemetry."""
        if i in self._taken:
            return State.ASKING, (self.handed_over[i].reason,) if i in self.handed_over else ()
        decision = self._supervised.get(i)
        if decision is None:
            return State.NORMAL, ()
        return decision.state, tuple(reason.sentence for reason in decision.reasons)

    def velocity_error_m_s(self, i: int) -> float:
        """How far a drone's velocity deviates from its setpoints, as its gate measures; 0 without a gate."""
        return self._drones[i].gate.response.error_m_s if i in self._drones else 0.0

    def fly(self, time_s: float, vehicles: Vehicles, commands: Commands, disturbed: Disturbances = UNDISTURBED) -> None:
        """Flies one step from `time_s` on."""
        self._disturbed = disturbed
        taken = {i: one.takeover for i, one in enumerate(commands.missions) if one.takeover is not None}
        for takeover in self._scenario.takeovers:
            if time_s - self._step_s < takeover.time_s <= time_s:
                if takeover.to == "hold":
                    self.hold(takeover.drone - 1, time_s, vehicles)
                else:
                    taken[takeover.drone - 1] = takeover.to
        self._taken = {**taken, **self._taken}
        self._orders.append(_Order(time_s, vehicles.known_position, self._with_landings(commands, vehicles)))
        latency_s = self._scenario.step_latency_s
        periods = max(round(self._step_s / PERIOD_S), 1) if self._drones or latency_s else 1
        period_s = self._step_s / periods
        for period in range(periods):
            now_s = time_s + period * period_s
            while len(self._orders) > 1 and now_s - self._orders[1].time_s >= latency_s - _SAME_TIME_S:
                self._orders.popleft()
            order, asked = self._orders[0], self._orders[0].commands
            setpoints, heights = asked.velocity.copy(), asked.height_m.copy()
            for i in self._drones.keys() - self._taken.keys() - disturbed.removed:
                setpoint = self._setpoint(i, now_s, period_s, vehicles, order)
                setpoints[i] = setpoint.velocity
                if math.isfinite(asked.height_m[i]):
                    heights[i] = setpoint.height_m
            for i, held in self._held.items():
                setpoints[i] = _HOLD_PER_S * (held - vehicles.known_position[i])[:2]
                heights[i] = -held[2]
            vehicles.step(setpoints, asked.yaw_rad, period_s, heights)

    def _with_landings(self, commands: Commands, vehicles: Vehicles) -> Commands:
        """The pilots' commands, with those of the autopilots that land or return."""
        velocity, height_m = commands.velocity.copy(), commands.height_m.copy()
        for i, takeover in self._taken.items():
            if takeover == "hold":
                continue
            way = (self._starts[i] - vehicles.known_position[i])[:2]
            away_m = math.hypot(*way)
            if takeover == "return" and away_m > _THERE_M:
                velocity[i] = way * (min(RETURN_M_S, away_m) / away_m)
            else:
                self._taken[i] = "land"
                velocity[i], height_m[i] = 0.0, 0.0
        return replace(commands, velocity=velocity, height_m=height_m)

    def _setpoint(self, i: int, now_s: float, period_s: float, vehicles: Vehicles, order: _Order) -> Setpoint:
        """What the gate of a drone makes of its order now; its supervisor may hand it over instead."""
        drone, commands, here = self._drones[i], order.commands, vehicles.known_position[i]
        ranges, yaw_rad = commands.obstacles[i], float(commands.yaw_rad[i])
        sigmas = self._scenario.drone.obstacles.sigmas
        around = surroundings(
            commands.neighbours[i],
            now_s - order.time_s,
            moved=here - order.places[i],
            position=here[:2],
            velocity=vehicles.known_velocity[i],
            yaw_rad=yaw_rad,
            height_m=float(-here[2]),
            obstacles=np.empty((0, 2)) if ranges is None else nearest_points(ranges, sigmas),
            seen_m=commands.seen_m[i],
        )
        lost = self._disturbed.cameras_off_of(i)
        if self._scenario.detections is not None:
            lost |= self._scenario.lost_cameras(i, now_s)
        decision = self._supervised[i] = drone.decide(now_s, around, lost)
        if decision.state is State.ASKING:
            self.hold(i, now_s, vehicles, decision.reasons[0].sentence)
        height_m = float(commands.height_m[i])
        wanted = Wanted(commands.velocity[i], commands.acceleration[i], yaw_rad)
        held_m = height_m if math.isfinite(height_m) else -float(self._starts[i, 2])
        request = Request(Permission(decision.action, now_s), wanted, order.time_s, held_m, around)
        verdict = drone.gate.step(now_s, request)
        assert verdict.setpoint is not None, "all that it is told is finite and of now"
        if decision.state is not State.ASKING:
            self.slowed.add(period_s, request, verdict, drone.degraded_by)
        return verdict.setpoint
