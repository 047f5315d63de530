"""The swarm loop: render what each drone sees, let its pilot decide, let the vehicles fly; in lockstep."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from flockd.choices import ROLES, SimulatedPerception
from flockd.config.scenario import ScenarioConfig
from flockd.errors import UsageError
from flockd.flocking import FlockingLaw, course, desired_velocity
from flockd.messages import FloatArray, PilotOutput
from flockd.perception import load_networks
from flockd.pilot import FlockPilot, StepTrace
from flockd.recording import Recorder
from flockd.recording.truth import TrueDrone, Truth
from flockd.report.filmstrip import FilmstripFrame
from flockd.sim.log import FlightLog
from flockd.sim.log_book import LogBook
from flockd.sim.photographer import Photographer
from flockd.sim.pictures import picture, pictured_steps
from flockd.sim.truth import fly_truth, step_times
from flockd.sim.truth_perception import TruthPerception
from flockd.sim.vehicles import SimulatedAutopilot, Vehicles
from flockd.telemetry import TelemetrySink, publish_step

_FILMSTRIP_DRONE = 0


@dataclass(frozen=True, eq=False)
class Flight:
    """A finished flight: its log, and a few moments of one drone as pictures."""

    log: FlightLog
    filmstrip: tuple[FilmstripFrame, ...]


def fly(
    scenario: ScenarioConfig,
    *,
    perception: SimulatedPerception = "learned",
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
    book = LogBook(times, len(scenario.vehicles))
    companion = fly_truth(scenario)[1:]
    crew = (
        _ExactCrew(scenario) if perception == "truth" else _SeeingCrew(scenario, swap, telemetry, recorders, companion)
    )
    yaw = course(scenario.drone.desired, 0.0)
    vehicles = Vehicles(scenario.vehicles, scenario.vehicle, yaw_rad=yaw, seed=scenario.seed)
    pictured = pictured_steps(len(times))
    filmstrip = []
    for step, time_s in enumerate(times):
        book.truth(step, vehicles.position, vehicles.velocity, vehicles.R_ned_body)
        book.desired(step, desired_velocity(scenario.drone.desired, float(time_s)))
        velocity, yaws = crew.decide(step, float(time_s), vehicles, book)
        if step in pictured:
            filmstrip += crew.picture()
        vehicles.step(velocity, yaws, scenario.drone.step_s)
        progress(step + 1, len(times))
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
        "perception": perception if not swap else f"learned, true {', '.join(sorted(swap))}",
        "flow": "none" if perception == "truth" else "truth" if "flow" in swap else scenario.drone.perception.flow,
        "scale": scenario.drone.perception.scale,
        "wall_s": time.perf_counter() - begin,
    }
    return Flight(book.log(meta, companion), tuple(filmstrip))


class _ExactCrew:
    """Pilots that know everybody's exact state."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        self._config = scenario.drone
        self._law = FlockingLaw(scenario.drone.flocking)

    def decide(self, step: int, time_s: float, vehicles: Vehicles, book: LogBook) -> tuple[FloatArray, FloatArray]:
        """Velocity setpoints (n, 2) and headings (n,)."""
        positions, velocities = vehicles.position, vehicles.velocity
        count = len(positions)
        desired = desired_velocity(self._config.desired, time_s)
        commands = np.zeros((count, 2))
        for i in range(count):
            others = np.arange(count) != i
            relative = positions[others] - positions[i]
            commands[i], acceleration = self._law.command(
                velocities[i, :2], relative[:, :2], velocities[others, :2], desired, self._config.step_s
            )
            book.exact(step, i, others, relative, velocities, commands[i], acceleration)
        return commands, np.full(count, course(self._config.desired, time_s))

    def picture(self) -> list[FilmstripFrame]:
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
        companion: tuple[FloatArray, FloatArray],
    ) -> None:
        self._companion = companion
        self._telemetry, self._recorders = telemetry, recorders
        self._photographer = Photographer(scenario)
        count = len(scenario.vehicles)
        learned = load_networks(scenario.drone.perception)
        self._truths = [TruthPerception(learned, swap, self._photographer.rig) for _ in range(count)] if swap else []
        self._pilots = [
            FlockPilot(scenario.drone, self._truths[i] if swap else learned, stopwatch=time.perf_counter)
            for i in range(count)
        ]
        self._autopilots = [SimulatedAutopilot(scenario.sensors, seed=scenario.seed, drone=i) for i in range(count)]
        # Pilots share nothing but the networks, so their order does not matter: each thinks as soon as its images are
        # rendered, all at a time, for five one after the other on two cores would leave one core idle for the last.
        self._side_by_side = ThreadPoolExecutor(min(count, 2 * (os.cpu_count() or 1) + 1))
        self._traces = [StepTrace() for _ in range(count)]
        self._outputs: list[PilotOutput] = []

    def decide(self, step: int, time_s: float, vehicles: Vehicles, book: LogBook) -> tuple[FloatArray, FloatArray]:
        """Velocity setpoints (n, 2) and headings (n,)."""
        steps = []
        render_ms = []
        self._traces = [StepTrace() for _ in self._pilots]
        for i, pilot in enumerate(self._pilots):
            begin = time.perf_counter()
            frames, shot = self._photographer.photograph(i, step, time_s, vehicles)
            if self._truths:
                self._truths[i].show(shot)
            render_ms.append(1e3 * (time.perf_counter() - begin))
            state = self._autopilots[i].read(time_s, vehicles.position[i], vehicles.velocity[i], vehicles.R_ned_body[i])
            steps.append((frames, state, self._side_by_side.submit(pilot.step, frames, state, self._traces[i])))
        self._outputs = [thinking.result() for _, _, thinking in steps]
        truth = self._truth(step, time_s, vehicles)
        for i, (output, (frames, state, _)) in enumerate(zip(self._outputs, steps, strict=True)):
            if self._telemetry is not None:
                publish_step(self._telemetry, f"drone{i + 1}", state, output)
            if self._recorders:
                self._recorders[i].drain()  # simulated time stands still, so nothing need ever be dropped
                self._recorders[i].step(frames, state, output, truth)
            book.seen(step, i, output, state.R_ned_body, {"render": render_ms[i], **output.stages_ms})
        commands = [output.command for output in self._outputs]
        return np.array([c.velocity for c in commands]), np.array([c.yaw_rad for c in commands])

    def _truth(self, step: int, time_s: float, vehicles: Vehicles) -> Truth:
        """For recordings only: no pilot is told."""
        drones = (
            TrueDrone(
                name=f"drone{i + 1}",
                position=vehicles.position[i],
                velocity=vehicles.velocity[i],
                R_ned_body=vehicles.R_ned_body[i],
                exact_position=self._companion[0][step, i],
                exact_velocity=self._companion[1][step, i],
            )
            for i in range(len(vehicles.position))
        )
        return Truth(time_s, tuple(drones))

    def picture(self) -> list[FilmstripFrame]:
        """What the chosen drone's pilot worked with in the last step."""
        return picture(self._traces[_FILMSTRIP_DRONE], self._outputs[_FILMSTRIP_DRONE], _FILMSTRIP_DRONE)
