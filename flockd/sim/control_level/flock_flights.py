"""Flies many flights of one scenario at once, without images: the law, the missions and the vehicles alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flockd.core.errors import UsageError
from flockd.core.messages import FloatArray, IntArray
from flockd.flight.flocking import FlockingLaw, level_offsets, lookahead_s
from flockd.flight.mission import Moment, Navigator
from flockd.sim.control_level.flock_figures import Figures, FlightFigures
from flockd.sim.control_level.perceived_flock import Near, Perception, Seen
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.scenario.perceived import PerceivedErrors
from flockd.sim.vehicles.vehicles import REFERENCE_DEG, Motion, limit_norms

_PLACELESS = ("circle_then_tangent", "velocity", "hover", "follow")
_PAIRS = 1_000_000
"""Most pairs of drones of flights that are flown side by side, but for one flight alone: they take 0.3 GB."""


def fly_flocks(scenarios: Sequence[ScenarioConfig], *, errors: PerceivedErrors | None = None) -> list[Figures]:
    """Flies each scenario once; the figures of each flight, in their order.

    Those that differ in nothing but seed, start positions and start velocities fly side by side. A flight is the same
    bit for bit whatever others are flown with it.

    Args:
        scenarios: with any number of vehicles (`flockd.sim.flock.start`). The seed rules gusts and the
            errors of perception. Rig, sensors and safety gates do not count.
        errors: of what the drones perceive of each other; None: they are given exact states.

    Raises UsageError for drones flown by hand, missions that go by places, and worlds with obstacles.
    """
    alike: dict[str, list[int]] = {}
    for number, scenario in enumerate(scenarios):
        missions = [(vehicle.mission, vehicle.by_hand) for vehicle in scenario.vehicles]
        key = f"{scenario.model_copy(update={'seed': 0, 'vehicles': ()})!r} {missions}"
        alike.setdefault(key, []).append(number)
    found: dict[int, Figures] = {}
    for numbers in alike.values():
        side_by_side = max(_PAIRS // len(scenarios[numbers[0]].vehicles) ** 2, 1)
        for begin in range(0, len(numbers), side_by_side):
            batch = numbers[begin : begin + side_by_side]
            flights = FlockFlights([scenarios[number] for number in batch], errors)
            for step in range(flights.steps):
                flights.step(step)
            found |= zip(batch, flights.figures(), strict=True)
    return [found[number] for number in range(len(scenarios))]


class FlockFlights:
    """A batch of flights that differ in seeds and starts only, all at the same time; see `fly_flocks`."""

    def __init__(self, scenarios: Sequence[ScenarioConfig], errors: PerceivedErrors | None = None) -> None:
        scenario = scenarios[0]
        if scenario.world.obstacles is not None:
            raise UsageError("flights at control level have no obstacles; fly on exact states, or delete them")
        drone, seeds = scenario.drone, [one.seed for one in scenarios]
        f, n = self._shape = len(scenarios), len(scenario.vehicles)
        self._drone, self._law = drone, FlockingLaw(drone.flocking)
        self.steps = round(scenario.duration_s / drone.step_s)
        starts = [[*start.position_m, *start.velocity_m_s, 0.0] for one in scenarios for start in one.vehicles]
        self.states = np.ascontiguousarray(np.array(starts, dtype=float).T).reshape(6, f, n)
        """(6, flights, n) m and m/s: position and velocity, NED."""
        self._missions = Missions(scenario, f)
        self._perception = None if errors is None else Perception(errors, drone.step_s, seeds, n)
        self._motion = Motion(scenario.vehicle, seeds, n)
        self._figures = FlightFigures(scenario, f)
        p = drone.flocking
        self._reach_m = max(p.observation_distance_m, p.separation_distance_m)
        if errors is not None:
            self._reach_m = min(errors.range_limit_m, 2 * self._reach_m)
        self.sums = np.zeros((2, f, n))
        """u of Eq. 38 without u_vf, m/s^2, as last perceived."""
        self._own = np.zeros((f * n, 2))

    def step(self, step: int) -> None:
        """One step of all flights."""
        near = self.perceive(step)
        begin_s, for_s = step * self._drone.step_s, self._drone.step_s
        desired, heights = self._missions.step(begin_s, len(self._own))
        self._figures.add(self.states, near)
        p = self._drone.flocking
        u = limit_norms(_rows(self.sums) + p.velocity * p.own_weight * desired, p.max_acceleration_m_s2)
        commands = limit_norms(self._own + u * lookahead_s(for_s), p.max_speed_m_s)
        setpoints = np.ascontiguousarray(commands.T).reshape(2, *self._shape)
        self._motion.fly(begin_s, for_s, self.states, setpoints, heights.reshape(self._shape))

    def perceive(self, step: int) -> Near:
        """Who is near whom now; what the law makes of what each drone sees of the others is in `sums`."""
        near, states, p = Near(self.states), _rows(self.states), self._drone.flocking
        reach_m: float | FloatArray = self._reach_m
        if self._perception is None:
            if p.weight.kind == "nearest":  # no one else counts
                counts_m = np.maximum(near.nearest(p.weight.nearest)[0], p.separation_distance_m)
                reach_m = np.minimum(reach_m, counts_m)
            owners, others = near.pairs(reach_m)
            places, velocities = states[others, :3] - states[owners, :3], states[others, 3:]
            self._own, ages_s = states[:, 3:5], np.full(len(owners), math.inf)
            seen, offsets = Seen(owners, places, velocities, ages_s), places[:, :2]
        else:
            self._own = self._perception.own_velocities(states[:, 3:5], step)
            seen = self._perception.perceive(self._reach_m, near, states, step)
            offsets = level_offsets(seen.offsets)
        still = np.zeros_like(self._own)
        u = self._law.accelerations(self._own, seen.owners, offsets, seen.velocities[:, :2], still, seen.ages_s)
        self.sums = u.T.reshape(2, *self._shape)
        return near

    def figures(self) -> list[Figures]:
        """The figures of each flight."""
        return self._figures.of_flights()


class Missions:
    """What the drones of all flights want: each mission is asked once, as none goes by a drone's place."""

    def __init__(self, scenario: ScenarioConfig, flights: int) -> None:
        missions, n = [mission for mission, _ in scenario.missions], len(scenario.vehicles)
        for i, (mission, by_hand) in enumerate(scenario.missions):
            if by_hand or mission.kind not in _PLACELESS:
                fault = "is flown by hand" if by_hand else f"has the mission `{mission.kind}`, which goes by places"
                raise UsageError(f"vehicles[{i}] {fault}, which control level does not have; fly on exact states")
        self._navigators = list[tuple[Navigator, IntArray]]()
        for mission in dict.fromkeys(missions):
            rows = n * np.arange(flights)[:, None] + np.flatnonzero([one == mission for one in missions])
            self._navigators.append((Navigator(mission, scenario.drone.safety.gate), rows.ravel()))

    def step(self, time_s: float, drones: int) -> tuple[FloatArray, FloatArray]:
        """Desired velocities (drones, 2) m/s, times the pull, and heights (drones,) m, up positive, NaN: as now.

        Called in order of time.
        """
        desired, heights = np.zeros((drones, 2)), np.full(drones, np.nan)
        for navigator, rows in self._navigators:
            guidance = navigator.step(Moment(time_s, np.zeros(2), np.zeros(2), np.array(REFERENCE_DEG)))
            desired[rows] = navigator.pull(guidance)
            heights[rows] = np.nan if guidance.height_m is None else guidance.height_m
        return desired, heights


def _rows(values: FloatArray) -> FloatArray:
    """(drones, k) of (k, flights, n)."""
    return values.reshape(len(values), -1).T
