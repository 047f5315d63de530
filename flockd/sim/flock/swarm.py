"""The swarm loop in lockstep: render each drone's frames, step its pilot, step the vehicles."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from flockd import __version__
from flockd.core.choices import SimulatedPerception
from flockd.core.messages import FloatArray, PilotOutput
from flockd.flight.perception import load_networks
from flockd.onboard.recording import Recorder
from flockd.onboard.recording.truth import TrueDrone, Truth
from flockd.review.flight_log.builder import FlightLogBuilder
from flockd.review.flight_log.key_frames import KeyFrame, key_frame_steps
from flockd.review.flight_log.log import FlightLog
from flockd.review.flight_log.metadata import FlightMetadata, MissionMetadata
from flockd.sim.cameras.camera_simulator import CameraSimulator
from flockd.sim.flock.control_loop import Commands, ControlLoop
from flockd.sim.flock.exact_states import (
    ExactFlock,
    fly_by_hand,
    fly_exact_states,
    navigator_of,
    start_yaw,
    step_times,
    vehicles_of,
)
from flockd.sim.flock.flock_telemetry import FlockTelemetry
from flockd.sim.flock.pilots import PilotProcesses, Pilots, PilotsHere, PilotStep
from flockd.sim.renderer.airframe import DroneModel
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.vehicles.vehicles import UNDISTURBED, Disturbances, SimulatedAutopilot, Vehicles
from flockd.sim.world.obstacle_worlds import with_obstacles

_KEY_FRAME_DRONES = 8
"""Key frames are kept of the first drones only, this many."""
_LEAST_STEPS = 2
"""With fewer steps an interrupted flight has nothing to report."""


@dataclass(frozen=True, eq=False)
class Flight:
    """A finished flight: its log, and key frames of its drones, one after the other."""

    log: FlightLog
    key_frames: tuple[KeyFrame, ...]


def fly(
    scenario: ScenarioConfig,
    *,
    perception: SimulatedPerception = "learned",
    gated: bool = True,
    shown: FlockTelemetry | None = None,
    recorders: Sequence[Recorder] = (),
    threads: int | None = None,
    models: Sequence[DroneModel] | None = None,
    pictured: bool = True,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Flight:
    """Fly a scenario. The same scenario gives the same flight, bit for bit, except for the times it took.

    KeyboardInterrupt ends the flight early: after its second step the log of what was flown is returned.

    Args:
        scenario: what to fly.
        perception: `learned` flies from rendered images; `truth` from exact relative states.
        gated: whether each drone's gate turns what its pilot asks for into setpoints, as in the daemon.
        shown: where every drone's output is published; operators' orders come from there. A flight on exact states then
            takes as long as it takes in the air.
        recorders: one a drone, or none.
        threads: for images; 0: these and pilots on the calling one; None: as many as there are processors. Pilots that
            see step all at once, in processes of their own.
        models: what each drone looks like; None: as the scenario says.
        pictured: keep key frames for the report.
        progress: called with (steps done, steps in all).
    """
    begin, began = time.perf_counter(), datetime.now(UTC)
    times = step_times(scenario)
    builder = FlightLogBuilder(times, len(scenario.vehicles))
    loop = ControlLoop(scenario, gated=gated)
    vehicles = vehicles_of(scenario)
    chosen = key_frame_steps(len(times)) if pictured else set()
    key_frames: list[KeyFrame] = []
    flown = 0
    companion = None
    pilots: ExactStatePilots | VisionPilots = ExactStatePilots(scenario, shown, gated=gated)
    if perception == "learned":
        companion = fly_exact_states(scenario, gated=gated)[1:]
        eyes = eyes_of(scenario, threads, models)
        pilots = VisionPilots(scenario, *eyes, shown, recorders, companion)
    first_s = time.perf_counter()
    try:
        for step, time_s in enumerate(times):
            if shown is not None and companion is None:
                time.sleep(max(0.0, first_s + float(time_s) - time.perf_counter()))
            builder.add_truth(step, vehicles.position, vehicles.velocity, vehicles.R_ned_body)
            commands = pilots.step(step, float(time_s), vehicles, builder, pictured=step in chosen)
            builder.add_missions(step, commands.desired, commands.missions)
            key_frames += pilots.key_frames
            fly_commands(commands, float(time_s), loop, vehicles, shown)
            flown = step + 1
            progress(flown, len(times))
    except KeyboardInterrupt:
        if flown < _LEAST_STEPS:
            raise
        builder.cut(flown)
        companion = companion and (companion[0][:flown], companion[1][:flown])
    metadata = FlightMetadata.of_configuration(
        scenario.drone,
        scenario=scenario.scenario,
        drones=len(scenario.vehicles),
        mission=MissionMetadata.of(scenario.missions),
        duration_s=scenario.duration_s if flown == len(times) else flown * scenario.drone.step_s,
        interrupted=flown < len(times),
        began=began.isoformat(timespec="seconds"),
        version=__version__,
        seed=scenario.seed,
        perception=perception,
        flow="none" if perception == "truth" else scenario.drone.perception.flow,
        wall_s=time.perf_counter() - begin,
        gated=gated,
        slowed_share=loop.slowed.share,
        slowed_by=loop.slowed.by_cause,
        handed_over=loop.handed_over,
    )
    key_frames = sorted((frame for frame in key_frames if frame.time_s < metadata.duration_s), key=lambda f: f.drone)
    return Flight(with_obstacles(builder.build(metadata, companion or builder.true_path), scenario), tuple(key_frames))


def fly_commands(
    commands: Commands,
    time_s: float,
    loop: ControlLoop,
    vehicles: Vehicles,
    shown: FlockTelemetry | None,
    disturbed: Disturbances = UNDISTURBED,
) -> None:
    """Obeys operators' requests to autopilots, flies one step, and publishes the state of each drone."""
    if shown is not None:
        shown.take_requests(time_s, loop, vehicles)
    loop.fly(time_s, vehicles, commands, disturbed)
    if shown is not None:
        shown.show_flight(time_s, loop)


class ExactStatePilots:
    """The flocking law on the exact states of all drones."""

    key_frames: Sequence[KeyFrame] = ()

    def __init__(self, scenario: ScenarioConfig, shown: FlockTelemetry | None, *, gated: bool) -> None:
        self._scenario, self._shown = scenario, shown
        self._flock = ExactFlock(scenario, passes=gated)

    def step(
        self,
        step: int,
        time_s: float,
        vehicles: Vehicles,
        builder: FlightLogBuilder | None,
        *,
        pictured: bool,
        disturbed: Disturbances = UNDISTURBED,
    ) -> Commands:
        """Commands for all drones, without images. ``builder``: of the flight's log; None: no log is kept."""
        positions, velocities = vehicles.position, vehicles.velocity
        orders = {} if self._shown is None else self._shown.take_orders(range(len(positions)))
        own = None if self._scenario.detections is None else vehicles.known_velocity
        commands = self._flock.step(time_s, positions, velocities, orders, disturbed, own)
        if self._shown is not None:
            self._shown.show_exact(step, time_s, vehicles, commands)
        for i, vehicle in enumerate(self._scenario.vehicles):
            if builder is not None and not vehicle.by_hand:
                others = np.arange(len(positions)) != i
                relative = positions[others] - positions[i]
                builder.add_exact_states(step, i, others, relative, velocities, commands.velocity[i])
        return commands


def eyes_of(
    scenario: ScenarioConfig, threads: int | None = None, models: Sequence[DroneModel] | None = None
) -> tuple[CameraSimulator, Pilots]:
    """The cameras of all drones, and their pilots. Raises ModelError."""
    cameras = CameraSimulator(scenario, threads, models)
    if threads == 0:
        return cameras, PilotsHere(load_networks(scenario.drone.perception))
    return cameras, PilotProcesses(scenario.drone.perception, len(scenario.vehicles))


class VisionPilots:
    """One pilot a drone, each given only its own images and its own autopilot's readings."""

    def __init__(
        self,
        scenario: ScenarioConfig,
        cameras: CameraSimulator,
        pilots: Pilots,
        shown: FlockTelemetry | None,
        recorders: Sequence[Recorder] = (),
        companion: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        """For a flight from the beginning. ``companion``: for what is recorded; None where nothing is."""
        self._scenario, self._yaw_rad, self._cameras = scenario, start_yaw(scenario), cameras
        self._shown, self._recorders, self._companion = shown, recorders, companion
        cameras.begin_again()
        self._hands = {i: navigator_of(scenario, i) for i, one in enumerate(scenario.vehicles) if one.by_hand}
        self._drones = tuple(i for i in range(len(scenario.vehicles)) if i not in self._hands)
        self._pilots = pilots
        pilots.begin({i: scenario.drone_of(i) for i in self._drones})
        ground = cameras.ground_height
        self._autopilots = {
            i: SimulatedAutopilot(scenario.sensors, seed=scenario.seed, drone=i, ground=ground) for i in self._drones
        }
        self.key_frames: list[KeyFrame] = []
        """What the pilots worked with in the last step, at half size, where that was asked for."""

    def step(
        self,
        step: int,
        time_s: float,
        vehicles: Vehicles,
        builder: FlightLogBuilder | None,
        *,
        pictured: bool,
        disturbed: Disturbances = UNDISTURBED,
    ) -> Commands:
        """Commands for all drones, each of whose pilots steps once its images are drawn. ``builder``: see
        `ExactStatePilots`."""
        flying = [i for i in self._drones if i not in disturbed.removed]
        orders = {} if self._shown is None else self._shown.take_orders(flying)
        turn_rates = vehicles.trail.motion_at(time_s).turn
        drawing = {i: self._cameras.capture(i, step, time_s, vehicles, vehicles.trail, disturbed) for i in flying}
        given, render_ms = dict[int, PilotStep](), dict[int, float]()

        def drawn() -> Iterator[PilotStep]:
            for i, frame_set in drawing.items():
                begin = time.perf_counter()
                frames = frame_set()
                render_ms[i] = 1e3 * (time.perf_counter() - begin)
                state = self._autopilots[i].read(
                    time_s, vehicles.position[i], vehicles.velocity[i], vehicles.R_ned_body[i], turn_rates[i],
                    vehicles.errors[i] if vehicles.errors else None,
                )  # fmt: skip
                with_pictures = pictured and i in self._drones[:_KEY_FRAME_DRONES]
                given[i] = PilotStep(i, frames, state, with_pictures, orders.get(i))
                yield given[i]

        results = self._pilots.step(drawn())
        outputs, self.key_frames = dict[int, PilotOutput](), []
        truth = None if self._companion is None else self._truth(step, time_s, vehicles, self._companion)
        for i, one in given.items():
            output, seen = results[i]
            outputs[i] = output
            self.key_frames += seen
            if self._shown is not None:
                self._shown.show(i, one.frames, one.vehicle, output)
            if self._recorders and truth is not None:
                recorder = self._recorders[self._drones.index(i)]
                recorder.drain()  # simulated time stands still, so nothing need ever be dropped
                recorder.step(one.frames, one.vehicle, output, truth, one.order)
            if builder is not None:
                builder.add_output(step, i, output, {"render": render_ms[i], **output.stages_ms})
        return self._commands(time_s, vehicles, outputs)

    def _commands(self, time_s: float, vehicles: Vehicles, outputs: Mapping[int, PilotOutput]) -> Commands:
        """Commands of the pilots, and of the people who fly drones by hand."""
        commands = Commands.of(len(self._scenario.vehicles))
        for i, output in outputs.items():
            command = output.command
            commands.velocity[i], commands.acceleration[i] = command.velocity, command.acceleration
            commands.yaw_rad[i] = self._yaw_rad if command.yaw_rad is None else command.yaw_rad
            commands.height_m[i] = np.nan if command.height_m is None else command.height_m
            commands.missions[i], commands.obstacles[i] = output.mission, output.obstacles
            commands.seen_m[i], commands.neighbours[i] = output.seen_m, output.neighbours
            commands.desired[i] = output.mission.desired
        for i, hand in self._hands.items():
            commands.missions[i] = fly_by_hand(hand, i, time_s, vehicles.position[i, :2], commands)
            commands.yaw_rad[i] = self._yaw_rad
        return commands

    def _truth(self, step: int, time_s: float, vehicles: Vehicles, companion: tuple[FloatArray, FloatArray]) -> Truth:
        """For recordings only: no pilot gets it."""
        drones = (
            TrueDrone(
                name=f"drone{i + 1}",
                position=vehicles.position[i],
                velocity=vehicles.velocity[i],
                R_ned_body=vehicles.R_ned_body[i],
                exact_position=companion[0][step, i],
                exact_velocity=companion[1][step, i],
            )
            for i in range(len(vehicles.position))
        )
        return Truth(time_s, tuple(drones))
