"""The swarm loop: render what each drone sees, let its pilot decide, let the vehicles fly; in lockstep."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np

from flockd.config.scenario import ScenarioConfig
from flockd.errors import UsageError
from flockd.flocking import FlockingLaw, course, desired_velocity
from flockd.messages import FloatArray, PilotOutput, VehicleState
from flockd.perception import Perception
from flockd.pilot import FlockPilot
from flockd.pilot.pilot import load_perception
from flockd.recording import Recorder
from flockd.report.filmstrip import FilmstripFrame
from flockd.sim.log import FlightLog, match_neighbours
from flockd.sim.photographer import Photographer
from flockd.sim.truth import fly_truth, step_times
from flockd.sim.truth_perception import ROLES, TruthPerception
from flockd.sim.vehicles import SimulatedAutopilot, Vehicles
from flockd.telemetry import TelemetrySink, publish_step

FILMSTRIP_FRAMES = 6
_FILMSTRIP_DRONE = 0


@dataclass(frozen=True, eq=False)
class Flight:
    """A finished flight: its log, and a few moments of one drone as pictures."""

    log: FlightLog
    filmstrip: tuple[FilmstripFrame, ...]


def fly(
    scenario: ScenarioConfig,
    *,
    perception: Literal["learned", "truth"] = "learned",
    swap: frozenset[str] = frozenset(),
    telemetry: TelemetrySink | None = None,
    recorders: Sequence[Recorder] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Flight:
    """Fly a scenario. The same scenario gives the same flight, bit for bit, except for the times it took.

    Args:
        scenario: what to fly.
        perception: `learned` flies from rendered images; `truth` from exact relative states.
        swap: roles of perception that are answered by the truth instead of a network.
        telemetry: where every drone's output is published; nothing comes back from there.
        recorders: one a drone, or none; nothing comes back from there either.
        progress: told (steps done, steps in all).
    """
    unknown = swap - set(ROLES)
    if unknown:
        raise UsageError(f"there is no role {sorted(unknown)[0]!r} to swap for truth; choose from {', '.join(ROLES)}")
    begin = time.perf_counter()
    times = step_times(scenario)
    recorder = _Recorder(scenario, times)
    crew = _ExactCrew(scenario) if perception == "truth" else _SeeingCrew(scenario, swap, telemetry, recorders)
    yaw = course(scenario.drone.desired, 0.0)
    vehicles = Vehicles(scenario.vehicles, scenario.vehicle, yaw_rad=yaw, seed=scenario.seed)
    pictured = set(np.linspace(1, len(times) - 1, FILMSTRIP_FRAMES).astype(int).tolist())
    filmstrip = []
    for step, time_s in enumerate(times):
        velocity, yaws = crew.decide(step, float(time_s), vehicles, recorder)
        if step in pictured:
            filmstrip += crew.picture(float(time_s))
        vehicles.step(velocity, yaws, scenario.drone.step_s)
        progress(step + 1, len(times))
    facts = {
        "perception": perception if not swap else f"learned, true {', '.join(sorted(swap))}",
        "flow": "none" if perception == "truth" else "truth" if "flow" in swap else scenario.drone.perception.flow,
        "scale": scenario.drone.perception.scale,
        "wall_s": time.perf_counter() - begin,
    }
    return Flight(recorder.log(facts), tuple(filmstrip))


class _ExactCrew:
    """Pilots that know everybody's exact state."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        self._config = scenario.drone
        self._law = FlockingLaw(scenario.drone.flocking)

    def decide(
        self, step: int, time_s: float, vehicles: Vehicles, recorder: _Recorder
    ) -> tuple[FloatArray, FloatArray]:
        """Velocity setpoints (n, 2) and headings (n,)."""
        positions, velocities = vehicles.position, vehicles.velocity
        count = len(positions)
        desired = desired_velocity(self._config.desired, time_s)
        commands = np.zeros((count, 2))
        recorder.truth(step, vehicles, desired)
        for i in range(count):
            others = np.arange(count) != i
            relative = positions[others] - positions[i]
            commands[i], acceleration = self._law.command(
                velocities[i, :2], relative[:, :2], velocities[others, :2], desired, self._config.step_s
            )
            recorder.exact(step, i, others, relative, velocities, commands[i], acceleration)
        return commands, np.full(count, course(self._config.desired, time_s))

    def picture(self, time_s: float) -> list[FilmstripFrame]:
        """Nothing was seen."""
        return []


class _SeeingCrew:
    """One pilot a drone, each given only its own images and its own autopilot's readings."""

    def __init__(
        self,
        scenario: ScenarioConfig,
        swap: frozenset[str],
        telemetry: TelemetrySink | None,
        recorders: Sequence[Recorder],
    ) -> None:
        self._scenario = scenario
        self._telemetry, self._recorders = telemetry, recorders
        self._photographer = Photographer(scenario)
        count = len(scenario.vehicles)
        learned: Perception = load_perception(scenario.drone)
        self._truths = [TruthPerception(learned, swap, self._photographer.rig) for _ in range(count)] if swap else []
        self._pilots = [
            FlockPilot(scenario.drone, self._truths[i] if swap else learned, stopwatch=time.perf_counter)
            for i in range(count)
        ]
        self._autopilots = [SimulatedAutopilot(scenario.sensors, seed=scenario.seed, drone=i) for i in range(count)]
        # Pilots share nothing but the networks, so their order does not matter: all think at a time, for five one after
        # the other on two cores would leave one core idle for the last. Rendering uses all cores by itself.
        self._side_by_side = ThreadPoolExecutor(min(count, 2 * (os.cpu_count() or 1) + 1))
        self._outputs: list[PilotOutput] = []

    def decide(
        self, step: int, time_s: float, vehicles: Vehicles, recorder: _Recorder
    ) -> tuple[FloatArray, FloatArray]:
        """Velocity setpoints (n, 2) and headings (n,)."""
        recorder.truth(step, vehicles, desired_velocity(self._scenario.drone.desired, time_s))
        steps = []
        render_ms = []
        for i, pilot in enumerate(self._pilots):
            begin = time.perf_counter()
            frames, shot = self._photographer.photograph(i, step, time_s, vehicles)
            if self._truths:
                self._truths[i].show(shot)
            render_ms.append(1e3 * (time.perf_counter() - begin))
            state = self._autopilots[i].read(time_s, vehicles.position[i], vehicles.velocity[i], vehicles.R_ned_body[i])
            steps.append((pilot, frames, state))
        self._outputs = list(self._side_by_side.map(lambda one: one[0].step(one[1], one[2]), steps))
        for i, (output, (_, frames, state)) in enumerate(zip(self._outputs, steps, strict=True)):
            if self._telemetry is not None:
                publish_step(self._telemetry, f"drone{i + 1}", state, output)
            if self._recorders:
                self._recorders[i].drain()  # simulated time stands still, so nothing need ever be dropped
                self._recorders[i].step(frames, state, output)
            recorder.seen(step, i, output, state, vehicles, {"render": render_ms[i], **output.stages_ms})
        commands = [output.command for output in self._outputs]
        return np.array([c.velocity for c in commands]), np.array([c.yaw_rad for c in commands])

    def picture(self, time_s: float) -> list[FilmstripFrame]:
        """What the chosen drone's pilot worked with in the last step."""
        pilot, output = self._pilots[_FILMSTRIP_DRONE], self._outputs[_FILMSTRIP_DRONE]
        view = pilot.last_view
        if view is None:
            return []
        cameras = view.cameras
        return [
            FilmstripFrame(
                time_s=time_s,
                drone=_FILMSTRIP_DRONE,
                cameras=tuple(cameras),
                images={name: c.image for name, c in cameras.items()},
                depth={name: np.where(c.depth < 75.0, c.depth, np.float32(np.inf)) for name, c in cameras.items()},
                labels={name: np.where(c.labels == 255, np.uint8(0), c.labels) for name, c in cameras.items()},
                flow=dict(pilot.last_flows),
                track_ids={s.label: t for s, t in zip(output.sightings, output.sighting_tracks, strict=True)},
                ranges={s.label: float(np.linalg.norm(s.position)) for s in output.sightings},
            )
        ]


class _Recorder:
    """Fills the flight log, and judges estimates against the truth."""

    def __init__(self, scenario: ScenarioConfig, times: FloatArray) -> None:
        steps, n = len(times), len(scenario.vehicles)
        nan = np.nan
        self._scenario, self._times = scenario, times
        self.position, self.velocity = np.full((steps, n, 3), nan), np.full((steps, n, 3), nan)
        self.attitude = np.full((steps, n, 3, 3), nan)
        self.desired = np.full((steps, 2), nan)
        self.command_velocity, self.command_acceleration = np.full((steps, n, 2), nan), np.full((steps, n, 2), nan)
        self.ego_rotation, self.ego_translation = np.full((steps, n, 3, 3), nan), np.full((steps, n, 3), nan)
        self.ego_inlier_ratio = np.full((steps, n), nan)
        self.own_velocity = np.full((steps, n, 3), nan)
        self.neighbour_position, self.neighbour_velocity = (np.full((steps, n, n, 3), nan) for _ in range(2))
        self.sighting_position = np.full((steps, n, n, 3), nan)
        self.false_tracks = np.zeros((steps, n), np.int64)
        self._false_seen: list[set[int]] = [set() for _ in range(n)]
        self.stages: dict[str, list[float]] = {}

    def truth(self, step: int, vehicles: Vehicles, desired: FloatArray) -> None:
        self.position[step], self.velocity[step] = vehicles.position, vehicles.velocity
        self.attitude[step], self.desired[step] = vehicles.R_ned_body, desired

    def exact(
        self, step: int, i: int, others: FloatArray, relative: FloatArray, velocities: FloatArray,
        command: FloatArray, acceleration: FloatArray,
    ) -> None:  # fmt: skip
        self.neighbour_position[step, i, others] = relative
        self.neighbour_velocity[step, i, others] = velocities[others]
        self.own_velocity[step, i] = velocities[i]
        self.command_velocity[step, i], self.command_acceleration[step, i] = command, acceleration

    def seen(
        self, step: int, i: int, output: PilotOutput, state: VehicleState, vehicles: Vehicles,
        stages_ms: Mapping[str, float],
    ) -> None:  # fmt: skip
        others = [j for j in range(len(vehicles.position)) if j != i]
        true = vehicles.position[others] - vehicles.position[i]
        confirmed = [n for n in output.neighbours if n.confirmed]
        found = np.array([n.position for n in confirmed]).reshape(-1, 3)
        matches = match_neighbours(found, true)
        for estimate, truth in matches:
            self.neighbour_position[step, i, others[truth]] = confirmed[estimate].position
            self.neighbour_velocity[step, i, others[truth]] = confirmed[estimate].velocity
        matched = {estimate for estimate, _ in matches}
        false = {n.track for k, n in enumerate(confirmed) if k not in matched} - self._false_seen[i]
        self._false_seen[i] |= false
        self.false_tracks[step, i] = len(false)
        sighted = np.array([state.R_ned_body @ s.position for s in output.sightings]).reshape(-1, 3)
        for estimate, truth in match_neighbours(sighted, true):
            self.sighting_position[step, i, others[truth]] = sighted[estimate]
        ego = output.ego_motion
        if ego is not None:
            self.ego_rotation[step, i], self.ego_translation[step, i] = ego.rotation, ego.translation
            self.ego_inlier_ratio[step, i] = ego.inliers / ego.pairs
        if output.velocity is not None:
            self.own_velocity[step, i] = output.velocity
        self.command_velocity[step, i] = output.command.velocity
        self.command_acceleration[step, i] = output.command.acceleration
        for stage, ms in stages_ms.items():
            self.stages.setdefault(stage, []).append(ms)

    def log(self, facts: Mapping[str, object]) -> FlightLog:
        scenario = self._scenario
        _, truth_position, truth_velocity = fly_truth(scenario)
        meta = {
            "scenario": scenario.scenario,
            "drones": len(scenario.vehicles),
            "duration_s": scenario.duration_s,
            "step_s": scenario.drone.step_s,
            "seed": scenario.seed,
            "circle_until_s": scenario.drone.desired.circle_until_s,
            "desired_distance_m": scenario.drone.flocking.desired_distance_m,
            "observation_distance_m": scenario.drone.flocking.observation_distance_m,
            "separation_distance_m": scenario.drone.flocking.separation_distance_m,
            **facts,
        }
        return FlightLog(
            time_s=self._times, position=self.position, velocity=self.velocity, attitude=self.attitude,
            desired=self.desired, command_velocity=self.command_velocity,
            command_acceleration=self.command_acceleration, ego_rotation=self.ego_rotation,
            ego_translation=self.ego_translation, ego_inlier_ratio=self.ego_inlier_ratio,
            own_velocity_estimate=self.own_velocity, neighbour_position=self.neighbour_position,
            neighbour_velocity=self.neighbour_velocity, sighting_position=self.sighting_position,
            false_tracks=self.false_tracks, truth_position=truth_position, truth_velocity=truth_velocity,
            stages_ms={stage: np.array(ms) for stage, ms in self.stages.items()}, meta=meta,
        )  # fmt: skip
