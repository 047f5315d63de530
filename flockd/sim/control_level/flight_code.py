"""The flight code of each drone of a batch, one object a drone: its avoidance and its safety gate as they fly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flockd.core.config.drone import DroneConfig
from flockd.core.config.scenario import VehicleConfig
from flockd.core.messages import FloatArray, ObstacleRanges, Wanted
from flockd.flight.flocking import FlockingLaw
from flockd.flight.flocking.passing import Passing
from flockd.flight.obstacles import Avoidance, nearest_points
from flockd.flight.safety import Action, Gate, Permission, Request, Surroundings
from flockd.flight.safety.approach import towards_neighbours
from flockd.sim.control_level import motion

_SETPOINT_RATE_HZ = 20.0
"""Rate for a drone without an autopilot's section, as by default in one."""


class Seen(NamedTuple):
    """What one drone knows of its neighbours as a step begins."""

    offsets: FloatArray
    """(k, 3) m, NED, from the drone."""
    velocities: FloatArray
    """(k, 3) m/s, NED, over ground."""
    ages_s: FloatArray | float = math.inf
    """(k,) for how long it has known them."""
    numbers: Sequence[int] = ()
    """The k neighbours' numbers; empty: not known from step to step."""


class FlightCode:
    """The code of `drones` drones of one configuration, whatever flight they are in."""

    def __init__(self, drone: DroneConfig, vehicle: VehicleConfig, drones: int) -> None:
        self._drone, self._law = drone, FlockingLaw(drone.flocking)
        gate, step_s = drone.safety.gate, drone.step_s
        self._avoidances = [Avoidance(drone.obstacles, gate, step_s) for _ in range(drones)]
        self._gates = [Gate(gate) for _ in range(drones)]
        self._passings = [Passing(self._law, gate.vertical_separation_m) for _ in range(drones)]
        rate_hz = _SETPOINT_RATE_HZ if drone.autopilot is None else drone.autopilot.setpoint_rate_hz
        self._ticks = max(round(step_s * rate_hz), 1)
        self._tick_s = step_s / self._ticks
        self._substeps = motion.Substeps.of(vehicle, self._tick_s)
        self.substeps = self._substeps._replace(times=self._ticks * self._substeps.times)
        """Substeps of a step with gates: the same number in each of its setpoints."""
        self._sent, self._height_m = np.zeros((2, drones)), np.zeros(drones)

    def around(
        self, i: int, velocity: FloatArray, seen: Seen, desired: FloatArray, ranges: ObstacleRanges
    ) -> FloatArray:
        """The velocity (2,) m/s that drone `i` at `velocity` (2,) asks for among obstacles; see `Avoidance`."""
        level = seen.velocities[:, :2]
        return self._avoidances[i].command(self._law, velocity, seen.offsets, level, desired, ranges, seen.ages_s)[0]

    def clear(self, i: int, velocity: FloatArray, command: FloatArray, seen: Seen) -> FloatArray:
        """The velocity (2,) m/s that drone `i` at `velocity` (2,) asks for in open air instead of its `command` (2,).

        Where neighbours have no numbers no side is remembered.
        """
        gate = self._drone.safety.gate
        near = np.hypot(seen.offsets[:, 0], seen.offsets[:, 1]) <= self._drone.flocking.observation_distance_m
        offsets, level = seen.offsets[near], seen.velocities[near, :2]
        numbers = np.array(seen.numbers)[near].tolist() if seen.numbers else [-1 - one for one in range(len(offsets))]
        passing = self._passings[i] if seen.numbers else Passing(self._law, gate.vertical_separation_m)
        limits = towards_neighbours(gate, offsets, level, gate.min_separation_m)
        return passing.clear(command, velocity, offsets, level, numbers, limits)

    def fly_gated(
        self, i: int, begin_s: float, states: FloatArray, blown: FloatArray, commands: FloatArray, heights: FloatArray,
        gusts: FloatArray, seen: Seen, ranges: ObstacleRanges | None,
    ) -> None:  # fmt: skip
        """Moves drone `i` on by one step from `begin_s`, at the rate of setpoints, as its gate lets it.

        Of all drones: `states` (6, drones) in place, towards `commands` (2, drones) m/s and `heights` (drones,) m, NaN:
        as high as now; `blown` and `gusts` as of `motion.fly`. Neighbours go on as they flew when they were `seen`.
        """
        points = np.empty((0, 2)) if ranges is None else nearest_points(ranges, self._drone.obstacles.sigmas)
        wanted = Wanted(commands[:, i].copy(), np.zeros(2), 0.0)
        holds = bool(np.isnan(heights[i]))
        height_m = float(-states[2, i] if holds else heights[i])
        began = states[:3, i].copy()
        for tick in range(self._ticks):
            age_s = tick * self._tick_s
            moved = states[:3, i] - began
            around = Surroundings(
                position=states[:2, i].copy(),
                velocity=states[3:5, i].copy(),
                yaw_rad=0.0,
                neighbours=seen.offsets + age_s * seen.velocities - moved,
                neighbour_velocities=seen.velocities[:, :2],
                height_m=float(-states[2, i]),
                obstacles=points - moved[:2],
            )
            now_s = begin_s + age_s
            request = Request(Permission(Action.FLY, now_s), wanted, begin_s, height_m, around)
            setpoint = self._gates[i].step(now_s, request).setpoint
            assert setpoint is not None, "all that it is told is finite and of now"
            self._sent[:, i] = setpoint.velocity
            motion.fly(i, i + 1, now_s, states, blown, self._sent, gusts, self._substeps)
            if not holds:
                self._height_m[i] = setpoint.height_m
                motion.climb(i, i + 1, states, self._height_m, self._substeps)
