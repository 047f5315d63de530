"""What many drones of many flights want: the velocities and heights of `flockd.flight.mission`, as arrays.

Missions of which all drones want the same at one time are asked once; waypoints are flown by each drone for itself.
"""

from __future__ import annotations

import numpy as np

from flockd.core.config.mission import MissionParameters
from flockd.core.config.safety import GateParameters
from flockd.core.errors import UsageError
from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.mission import Moment, Navigator
from flockd.flight.mission.guidance import SLOW_DOWN_S
from flockd.flight.mission.places import place_of_waypoint
from flockd.flight.mission.waypoints import PATIENCE_S, PROGRESS
from flockd.flight.safety.fence import outside_fence
from flockd.sim.scenario import ScenarioConfig

HOME_DEG = (1.0, 1.0)
"""Latitude and longitude of the world's origin, as in the simulator."""


class ManyMissions:
    """The missions of all drones of a batch: the scenario's own, or those of single vehicles."""

    def __init__(self, scenario: ScenarioConfig, flights: int) -> None:
        n = len(scenario.vehicles)
        by_hand = next((i for i, vehicle in enumerate(scenario.vehicles) if vehicle.by_hand), None)
        if by_hand is not None:
            raise UsageError(
                f"vehicles[{by_hand}] is flown by hand, which flights at control level do not have; delete `by_hand`"
            )
        groups: dict[str, tuple[MissionParameters, list[int]]] = {}
        for i in range(n):
            mission = scenario.drone_of(i).mission
            groups.setdefault(mission.model_dump_json(), (mission, []))[1].append(i)
        gate = scenario.drone.safety.gate
        self._groups: list[tuple[np.ndarray, _Shared | _Waypoints]] = [
            (np.array(who), _Waypoints(mission, gate, flights, len(who)) if mission.kind == "waypoints"
             else _Shared(mission, gate))
            for mission, who in groups.values()
        ]  # fmt: skip
        self._desired = np.zeros((2, flights, n))
        self._height_m = np.full((flights, n), np.nan)
        self.reached_m = max(scenario.drone_of(i).mission.reached_m for i in range(n))
        """How near to its last goal the middle of a flock counts as there."""

    def step(self, time_s: float, positions: FloatArray, middles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Desired velocities (2, flights, n) m/s, times the pull, and heights (flights, n) m, up positive, NaN: as now.

        `positions` (2, flights, n) m; `middles` (2, flights, n) m from each drone to the middle of those that it sees.
        Called in order of time.
        """
        for who, mission in self._groups:
            velocity, height_m = mission.step(time_s, positions[:, :, who] + middles[:, :, who])
            self._desired[:, :, who], self._height_m[:, who] = velocity, height_m
        return self._desired, self._height_m

    def goal(self) -> tuple[FloatArray, BoolArray] | None:
        """The last goal (2,) m of the largest group that has goals, and which flights (flights,) fly to it by now.

        A flight does so once any drone of the group does. None without goals.
        """
        led = [(len(who), mission) for who, mission in self._groups if isinstance(mission, _Waypoints)]
        if not led:
            return None
        mission = max(led, key=lambda pair: pair[0])[1]
        return mission.places[-1], np.asarray(mission.last().any(axis=1))


class _Shared:
    """A mission of which all drones want the same."""

    def __init__(self, mission: MissionParameters, gate: GateParameters) -> None:
        self._navigator = Navigator(mission, gate)

    def step(self, time_s: float, flock: FloatArray) -> tuple[FloatArray, FloatArray]:
        guidance = self._navigator.step(Moment(time_s, np.zeros(2), home_deg=np.array(HOME_DEG)))
        height_m = np.nan if guidance.height_m is None else guidance.height_m
        return self._navigator.pull(guidance)[:, None, None], np.array(height_m)


class _Waypoints:
    """`flockd.flight.mission.waypoints.Waypoints` of many drones.

    An autopilot does not take over at the end: the drones hold their last goal whatever `at_end` says.
    """

    def __init__(self, mission: MissionParameters, gate: GateParameters, flights: int, drones: int) -> None:
        self._mission = mission
        origin = np.array(mission.origin_m)
        found = [place_of_waypoint(w, origin, np.array(HOME_DEG)) for w in mission.waypoints]
        self.places = np.array([place for place in found if place is not None])
        for number, place in enumerate(self.places):
            if outside_fence(gate, place):
                raise UsageError(f"waypoint {number + 1} is outside the fence; move it, or widen the fence")
        self._speed = np.array([mission.speed_m_s if w.speed_m_s is None else w.speed_m_s for w in mission.waypoints])
        heights = [np.nan if w.height_m is None else w.height_m for w in mission.waypoints]
        for i in range(1, len(heights)):
            heights[i] = heights[i - 1] if np.isnan(heights[i]) else heights[i]
        default = np.nan if mission.height_m is None else mission.height_m
        self._height_m = np.where(np.isnan(heights), default, heights) + mission.height_offset_m
        self._next = np.zeros((flights, drones), np.int64)
        self._arrived = np.zeros((flights, drones), dtype=bool)
        # Of the waypoint flown to: how far it was, the nearest since, and when that was; inf before the first step.
        self._first_m, self._nearest_m = np.full((2, flights, drones), np.inf)
        self._since_s = np.zeros((flights, drones))

    def step(self, time_s: float, flock: FloatArray) -> tuple[FloatArray, FloatArray]:
        p, final = self._mission, len(self.places) - 1
        for _ in self.places:  # one that is at several waypoints at once passes them all
            away_m = np.hypot(*(self.places[self._next].transpose(2, 0, 1) - flock))
            there = ((away_m <= p.reached_m) | self._come_no_nearer(time_s, away_m)) & ~self._arrived
            self._arrived |= there & (self._next == final)
            self._next = np.where(there, np.minimum(self._next + 1, final), self._next)
            self._first_m[there] = self._nearest_m[there] = np.inf
        way = self.places[self._next].transpose(2, 0, 1) - flock
        distance = np.hypot(*way)
        speed = self._speed[self._next]
        speed = np.where(self._next == final, np.minimum(speed, distance / SLOW_DOWN_S), speed)
        share = np.divide(speed, distance, out=np.zeros_like(distance), where=distance > 0)
        return way * share * p.pull, self._height_m[self._next]

    def _come_no_nearer(self, time_s: float, away_m: FloatArray) -> BoolArray:
        """Whose flock has come near to its waypoint and comes no nearer, (flights, n); see `Waypoints`."""
        reach_m = PATIENCE_S * self._speed[self._next]
        first = np.isinf(self._first_m)
        self._first_m = np.where(first, away_m, self._first_m)
        reached_m = self._mission.reached_m
        anew = first | (away_m > reached_m + 2 * reach_m) | (away_m <= self._nearest_m - PROGRESS * reach_m)
        self._nearest_m = np.where(anew, away_m, self._nearest_m)
        self._since_s = np.where(anew, time_s, self._since_s)
        moved, near = self._nearest_m < self._first_m, self._nearest_m <= reached_m + reach_m
        return np.asarray(moved & near & (time_s - self._since_s >= PATIENCE_S))

    def last(self) -> BoolArray:
        """Who flies to the last waypoint, (flights, n)."""
        return np.asarray(self._next == len(self.places) - 1)
