"""The swarm loop in lockstep: render each drone's frames, step its pilot, step the vehicles."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from flockd import __version__
from flockd.choices import TRUTH_ROLES, SimulatedPerception
from flockd.config.scenario import ScenarioConfig
from flockd.errors import UsageError
from flockd.flight_log.builder import FlightLogBuilder
from flockd.flight_log.capture import capture, key_frame_steps
from flockd.flight_log.key_frames import KeyFrame
from flockd.flight_log.log import FlightLog
from flockd.flight_log.metadata import FlightMetadata
from flockd.flocking import FlockingLaw, course, desired_velocity
from flockd.messages import FloatArray, PilotOutput
from flockd.perception import load_networks
from flockd.pilot import FlockPilot, StepTrace
from flockd.recording import Recorder
from flockd.recording.truth import TrueDrone, Truth
from flockd.sim.camera_simulator import CameraSimulator
from flockd.sim.exact_states import fly_exact_states, step_times
from flockd.sim.truth_perception import TruthPerception
from flockd.sim.vehicles import SimulatedAutopilot, Vehicles
from flockd.telemetry import TelemetrySink, publish_step

_KEY_FRAME_DRONES = 8
"""Of more, only the first ones' are kept."""
_LEAST_STEPS = 2
"""A flight interrupted before has nothing to report."""


@dataclass(frozen=True, eq=False)
class Flight:
    """A finished flight: its log, and key frames of its drones, one after the other."""

    log: FlightLog
    key_frames: tuple[KeyFrame, ...]


def fly(
    scenario: ScenarioConfig,
    *,
    perception: SimulatedPerception = "learned",
    swap: frozenset[str] = frozenset(),
    telemetry: TelemetrySink | None = None,
    recorders: Sequence[Recorder] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
    preparing: Callable[[int, int], None] = lambda done, total: None,
) -> Flight:
    """Fly a scenario. The same scenario gives the same flight, bit for bit, except for the times it took.

    KeyboardInterrupt ends the flight early: after its second step the log of what was flown is returned.

    Args:
        scenario: what to fly.
        perception: `learned` flies from rendered images; `truth` from exact relative states.
        swap: roles of perception that take the truth instead of a network's estimate.
        telemetry: where every drone's output is published; nothing comes back from there.
        recorders: one a drone, or none; nothing comes back from there either.
        progress: called with (steps done, steps in all).
        preparing: the same, of what is done before the first step: the companion, the networks, the world.
    """
    unknown = swap - set(TRUTH_ROLES)
    if unknown:
        raise UsageError(
            f"there is no role {sorted(unknown)[0]!r} to swap for truth; choose from {', '.join(TRUTH_ROLES)}"
        )
    begin, began = time.perf_counter(), datetime.now(UTC)
    times = step_times(scenario)
    builder = FlightLogBuilder(times, len(scenario.vehicles))
    preparing(0, _PREPARATIONS)
    companion = fly_exact_states(scenario)[1:]
    pilots = (
        _ExactStatePilots(scenario)
        if perception == "truth"
        else _VisionPilots(scenario, swap, telemetry, recorders, companion, preparing)
    )
    preparing(_PREPARATIONS, _PREPARATIONS)
    yaw = course(scenario.drone.desired, 0.0)
    vehicles = Vehicles(scenario.vehicles, scenario.vehicle, yaw_rad=yaw, seed=scenario.seed)
    chosen = key_frame_steps(len(times))
    key_frames: list[KeyFrame] = []
    flown = 0
    try:
        for step, time_s in enumerate(times):
            builder.add_truth(step, vehicles.position, vehicles.velocity, vehicles.R_ned_body)
            builder.add_desired(step, desired_velocity(scenario.drone.desired, float(time_s)))
            velocity, yaws = pilots.step(step, float(time_s), vehicles, builder)
            if step in chosen:
                key_frames += pilots.key_frames()
            vehicles.step(velocity, yaws, scenario.drone.step_s)
            flown = step + 1
            progress(flown, len(times))
    except KeyboardInterrupt:
        if flown < _LEAST_STEPS:
            raise
        builder.cut(flown)
        companion = companion[0][:flown], companion[1][:flown]
    metadata = FlightMetadata.of_configuration(
        scenario.drone,
        scenario=scenario.scenario,
        drones=len(scenario.vehicles),
        duration_s=scenario.duration_s if flown == len(times) else flown * scenario.drone.step_s,
        interrupted=flown < len(times),
        began=began.isoformat(timespec="seconds"),
        version=__version__,
        seed=scenario.seed,
        perception=perception if not swap else f"learned, true {', '.join(sorted(swap))}",
        flow="none" if perception == "truth" else "truth" if "flow" in swap else scenario.drone.perception.flow,
        wall_s=time.perf_counter() - begin,
    )
    key_frames = sorted((frame for frame in key_frames if frame.time_s < metadata.duration_s), key=lambda f: f.drone)
    return Flight(builder.build(metadata, companion), tuple(key_frames))


_PREPARATIONS = 4
"""The companion on exact states, the world, the networks, the pilots."""


class _ExactStatePilots:
    """The flocking law on the exact states of all drones."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        self._config = scenario.drone
        self._law = FlockingLaw(scenario.drone.flocking)

    def step(
        self, step: int, time_s: float, vehicles: Vehicles, builder: FlightLogBuilder
    ) -> tuple[FloatArray, FloatArray]:
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
            builder.add_exact_states(step, i, others, relative, velocities, commands[i], acceleration)
        return commands, np.full(count, course(self._config.desired, time_s))

    def key_frames(self) -> list[KeyFrame]:
        """None, as there are no images."""
        return []


class _VisionPilots:
    """One pilot a drone, each given only its own images and its own autopilot's readings."""

    def __init__(
        self,
        scenario: ScenarioConfig,
        swap: frozenset[str],
        telemetry: TelemetrySink | None,
        recorders: Sequence[Recorder],
        companion: tuple[FloatArray, FloatArray],
        preparing: Callable[[int, int], None],
    ) -> None:
        self._companion = companion
        preparing(1, _PREPARATIONS)
        self._telemetry, self._recorders = telemetry, recorders
        self._cameras = CameraSimulator(scenario)
        preparing(2, _PREPARATIONS)
        count = len(scenario.vehicles)
        learned = load_networks(scenario.drone.perception)
        preparing(3, _PREPARATIONS)
        self._truths = [TruthPerception(learned, swap, self._cameras.rig) for _ in range(count)] if swap else []
        self._pilots = [
            FlockPilot(scenario.drone, self._truths[i] if swap else learned, stopwatch=time.perf_counter)
            for i in range(count)
        ]
        self._autopilots = [SimulatedAutopilot(scenario.sensors, seed=scenario.seed, drone=i) for i in range(count)]
        # Pilots share nothing but the networks, so their order does not matter: each steps as soon as its images are
        # rendered, all at a time, for five one after the other on two cores would leave one core idle for the last.
        self._executor = ThreadPoolExecutor(min(count, 2 * (os.cpu_count() or 1) + 1))
        self._traces = [StepTrace() for _ in range(count)]
        self._outputs: list[PilotOutput] = []

    def step(
        self, step: int, time_s: float, vehicles: Vehicles, builder: FlightLogBuilder
    ) -> tuple[FloatArray, FloatArray]:
        """Velocity setpoints (n, 2) and headings (n,)."""
        steps = []
        render_ms = []
        self._traces = [StepTrace() for _ in self._pilots]
        for i, pilot in enumerate(self._pilots):
            begin = time.perf_counter()
            frames, render_truth = self._cameras.capture(i, step, time_s, vehicles)
            if self._truths:
                self._truths[i].show(render_truth)
            render_ms.append(1e3 * (time.perf_counter() - begin))
            state = self._autopilots[i].read(time_s, vehicles.position[i], vehicles.velocity[i], vehicles.R_ned_body[i])
            steps.append((frames, state, self._executor.submit(pilot.step, frames, state, self._traces[i])))
        self._outputs = [future.result() for _, _, future in steps]
        truth = self._truth(step, time_s, vehicles)
        for i, (output, (frames, state, _)) in enumerate(zip(self._outputs, steps, strict=True)):
            if self._telemetry is not None:
                publish_step(self._telemetry, f"drone{i + 1}", state, output)
            if self._recorders:
                self._recorders[i].drain()  # simulated time stands still, so nothing need ever be dropped
                self._recorders[i].step(frames, state, output, truth)
            builder.add_output(step, i, output, state.R_ned_body, {"render": render_ms[i], **output.stages_ms})
        commands = [output.command for output in self._outputs]
        return np.array([c.velocity for c in commands]), np.array([c.yaw_rad for c in commands])

    def _truth(self, step: int, time_s: float, vehicles: Vehicles) -> Truth:
        """For recordings only: no pilot gets it."""
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

    def key_frames(self) -> list[KeyFrame]:
        """What the pilots worked with in the last step."""
        of_drones = zip(self._traces[:_KEY_FRAME_DRONES], self._outputs, strict=False)
        return [
            frame.at_half_size()
            for drone, (trace, output) in enumerate(of_drones)
            for frame in capture(trace, output, drone)
        ]
