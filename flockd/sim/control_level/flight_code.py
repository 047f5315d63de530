"""The flight code of each drone of a batch, one object a drone: its avoidance and its safety gate as they fly."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flockd.core.config.drone import DroneConfig
from flockd.core.messages import FloatArray, ObstacleRanges, Wanted
from flockd.flight.flocking import FlockingLaw
from flockd.flight.flocking.passing import Passing
from flockd.flight.obstacles import Avoidance, nearest_points
from flockd.flight.safety import Action, Gate, Permission, Request, Surroundings
from flockd.flight.safety.approach import towards_neighbours
from flockd.sim.control_level.perceived_flock import Seen

_SETPOINT_RATE_HZ = 20.0
"""Rate for a drone without an autopilot's section, as by default in one."""


Known = tuple[Seen, ObstacleRanges | None]
"""What one drone knows as a step begins: of its neighbours, and of obstacles, None without any."""


class FlightCode:
    """The code of `drones` drones of one configuration, whatever flight they are in."""

    def __init__(self, drone: DroneConfig, drones: int) -> None:
        self._drone, self._law = drone, FlockingLaw(drone.flocking)
        gate, step_s = drone.safety.gate, drone.step_s
        self._avoidances = [Avoidance(drone.obstacles, gate, step_s) for _ in range(drones)]
        self._gates = [Gate(gate) for _ in range(drones)]
        self._passings = [Passing(self._law, gate.vertical_separation_m) for _ in range(drones)]
        rate_hz = _SETPOINT_RATE_HZ if drone.autopilot is None else drone.autopilot.setpoint_rate_hz
        self._ticks = max(round(step_s * rate_hz), 1)

    def ask(
        self, i: int, velocity: FloatArray, command: FloatArray, desired: FloatArray, seen: Seen,
        ranges: ObstacleRanges | None,
    ) -> FloatArray:  # fmt: skip
        """The velocity (2,) m/s that drone `i` at `velocity` (2,) asks for instead of its `command` (2,).

        Among obstacles it is the avoidance's, for the `desired` (2,) m/s of the mission; in open air it passes its
        neighbours. Where these have no numbers no side is remembered.
        """
        offsets, level = seen.offsets, seen.velocities[:, :2]
        if ranges is not None:
            return self._avoidances[i].command(self._law, velocity, offsets, level, desired, ranges, seen.ages_s)[0]
        gate = self._drone.safety.gate
        passing = self._passings[i]
        if not (seen.numbers >= 0).any():
            passing = Passing(self._law, gate.vertical_separation_m)
        near = np.hypot(offsets[:, 0], offsets[:, 1]) <= self._drone.flocking.observation_distance_m
        offsets, level, numbers = offsets[near], level[near], seen.numbers[near].tolist()
        limits = towards_neighbours(gate, offsets, level, gate.min_separation_m, unseen_s=np.zeros(len(offsets)))
        return passing.clear(command, velocity, offsets, level, numbers, limits)

    def fly_gated(
        self,
        begin_s: float,
        states: FloatArray,
        commands: FloatArray,
        heights: FloatArray,
        known: Sequence[Known],
        fly: Callable[[float, float, FloatArray, FloatArray], None],
    ) -> None:
        """One step from `begin_s` at the rate of setpoints, each drone as its gate lets it.

        Of all drones: `states` (6, drones), which `fly` moves in place, `commands` (2, drones) m/s and `heights`
        (drones,) m, NaN: as high as now. `fly` is called with the time and for how long, s, and setpoints of velocity
        (2, drones) and height (drones,). Neighbours go on as they flew when they became `known`.
        """
        tick_s = self._drone.step_s / self._ticks
        sigmas = self._drone.obstacles.sigmas
        points = [np.empty((0, 2)) if ranges is None else nearest_points(ranges, sigmas) for _, ranges in known]
        wanted = [Wanted(command.copy(), np.zeros(2), 0.0) for command in commands.T]
        holds, began = np.isnan(heights), states[:3].copy()
        asked_m = np.where(holds, -states[2], heights)
        sent, sent_m = np.zeros_like(commands), np.full_like(heights, np.nan)
        for tick in range(self._ticks):
            now_s, age_s = begin_s + tick * tick_s, tick * tick_s
            moved = states[:3] - began
            for i, (one, _) in enumerate(known):
                around = Surroundings(
                    position=states[:2, i].copy(),
                    velocity=states[3:5, i].copy(),
                    yaw_rad=0.0,
                    neighbours=_by_now(one, age_s, moved[:, i]),
                    neighbour_velocities=one.velocities[:, :2],
                    neighbour_unseen_s=np.full(len(one.offsets), age_s),
                    height_m=float(-states[2, i]),
                    obstacles=points[i] - moved[:2, i],
                )
                request = Request(Permission(Action.FLY, now_s), wanted[i], begin_s, float(asked_m[i]), around)
                setpoint = self._gates[i].step(now_s, request).setpoint
                assert setpoint is not None, "all that it is told is finite and of now"
                sent[:, i] = setpoint.velocity
                sent_m[i] = np.nan if holds[i] else setpoint.height_m
            fly(now_s, tick_s, sent, sent_m)


def _by_now(known: Seen, age_s: float, moved: FloatArray) -> FloatArray:
    """(k, 3) m from the drone, which `moved` (3,) m, to its neighbours, as `surroundings` has it."""
    braked = known.offsets - moved
    flown = braked + age_s * known.velocities
    through = (flown[:, :2] * braked[:, :2]).sum(axis=1) <= 0
    return np.where(through[:, None], braked, flown)
