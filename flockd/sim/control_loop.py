"""The daemon's control loop in simulated time: each drone's gate turns what its pilot asks for into setpoints."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flockd.core.config.scenario import ScenarioConfig
from flockd.core.messages import FloatArray, Setpoint, Wanted
from flockd.flight.obstacles import nearest_points
from flockd.flight.safety import Action, Gate, Permission, Request
from flockd.flight.safety.surroundings import surroundings
from flockd.sim.commands import Commands
from flockd.sim.handover import Handover
from flockd.sim.vehicles import Vehicles

PERIOD_S = 0.05
"""Between two setpoints, as `autopilot.setpoint_rate_hz` is by default."""
_SLOWED = 0.05
"""A velocity that differs from the one asked for by a smaller share of it counts as the same."""


_SAME_TIME_S = 1e-9


class _Order(NamedTuple):
    """What pilots asked for, and when and where the drones were as they looked."""

    time_s: float
    places: FloatArray
    commands: Commands
    velocity: FloatArray
    """(n, 2) m/s, and heights (n,) m, as asked for or as the autopilots that took over fly."""
    height_m: FloatArray


class ControlLoop:
    """Flies all drones of a flight from one step of their pilots to the next.

    A person's drone, and one whose autopilot has taken over, fly without a gate.
    """

    def __init__(self, scenario: ScenarioConfig, *, gated: bool = True) -> None:
        """Not `gated`: setpoints are what the pilots ask for."""
        self._step_s, self._sigmas = scenario.drone.step_s, scenario.drone.obstacles.sigmas
        self._handover = Handover(scenario)
        self._gates = {
            i: Gate(scenario.drone_of(i).safety.gate)
            for i, vehicle in enumerate(scenario.vehicles)
            if gated and not vehicle.by_hand
        }
        self._start_m = [-vehicle.position_m[2] for vehicle in scenario.vehicles]
        self._latency_s = scenario.detections.latency_s if scenario.detections is not None else 0.0
        self._in_force: _Order | None = None
        self._flown_s = self._slowed_s = 0.0

    @property
    def slowed_share(self) -> float | None:
        """Share of time in which gates let drones fly otherwise than their pilots asked for; None: no gates."""
        return self._slowed_s / self._flown_s if self._flown_s else None

    def fly(self, time_s: float, vehicles: Vehicles, commands: Commands) -> None:
        """From `time_s` one step on."""
        velocity, height_m = self._handover.applied(
            commands.takeovers, vehicles.position, commands.velocity, commands.height_m
        )
        gates = {i: gate for i, gate in self._gates.items() if i not in self._handover.taken}
        coming = _Order(time_s, vehicles.position, commands, velocity, height_m)
        order = self._in_force or coming
        periods = max(round(self._step_s / PERIOD_S), 1) if gates or self._latency_s else 1
        period_s = self._step_s / periods
        for period in range(periods):
            now_s = time_s + period * period_s
            if now_s - time_s >= self._latency_s - _SAME_TIME_S:
                order = coming
            setpoints, heights = order.velocity.copy(), order.height_m.copy()
            for i, gate in gates.items():
                setpoint = self._setpoint(i, gate, now_s, vehicles, order)
                setpoints[i] = setpoint.velocity
                if math.isfinite(order.height_m[i]):
                    heights[i] = setpoint.height_m
                asked = order.velocity[i]
                off_m_s = math.hypot(*(setpoint.velocity + gate.drift - asked))
                self._slowed_s += period_s * (off_m_s > _SLOWED * math.hypot(*asked))
                self._flown_s += period_s
            vehicles.step(setpoints, order.commands.yaw_rad, period_s, heights)
        self._in_force = coming

    def _setpoint(self, i: int, gate: Gate, now_s: float, vehicles: Vehicles, order: _Order) -> Setpoint:
        here, height_m, commands = vehicles.position[i], float(order.commands.height_m[i]), order.commands
        ranges = commands.obstacles[i]
        around = surroundings(
            commands.neighbours[i],
            now_s - order.time_s,
            moved=here - order.places[i],
            position=here[:2],
            velocity=vehicles.velocity[i],
            yaw_rad=float(commands.yaw_rad[i]),
            height_m=float(-here[2]),
            obstacles=np.empty((0, 2)) if ranges is None else nearest_points(ranges, self._sigmas),
        )
        wanted = Wanted(commands.velocity[i], commands.acceleration[i], float(commands.yaw_rad[i]))
        held_m = height_m if math.isfinite(height_m) else self._start_m[i]
        request = Request(Permission(Action.FLY, now_s), wanted, order.time_s, held_m, around)
        setpoint = gate.step(now_s, request).setpoint
        assert setpoint is not None, "all that it is told is finite and of now"
        return setpoint
