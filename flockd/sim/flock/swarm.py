"""The swarm loop in lockstep: render each drone's frames, step its pilot, step the vehicles."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from flockd import __version__
from flockd.core.choices import SimulatedPerception
from flockd.core.messages import FloatArray
from flockd.flight.mission.circle_then_tangent import desired_of
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
from flockd.sim.flock.pilots import Pilots, Stepped
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.vehicles.pose_trail import LateAttitude
from flockd.sim.vehicles.vehicles import UNDISTURBED, Disturbances, SimulatedAutopilot, Vehicles
from flockd.sim.world.obstacle_worlds import with_obstacles

_KEY_FRAME_DRONES = 8
"""Key frames are kept of the first drones only, this many."""
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
    gated: bool = True,
    shown: FlockTelemetry | None = None,
    recorders: Sequence[Recorder] = (),
    threads: int | None = None,
    pictured: bool = True,
    progress: Callable[[int, int], None] = lambda done, total: None,
    preparing: Callable[[int, int], None] = lambda done, total: None,
) -> Flight:
    """Fly a scenario. The same scenario gives the same flight, bit for bit, except for the times it took.

    KeyboardInterrupt ends the flight early: after its second step the log of what was flown is returned.

    Args:
        scenario: what to fly.
        perception: `learned` flies from rendered images; `truth` from exact relative states.
        swap: of `TRUTH_ROLES`, those that take the truth instead of a network's estimate.
        gated: whether each drone's gate turns what its pilot asks for into setpoints, as in the daemon.
        shown: where every drone's output is published; operators' orders come from there. A flight on exact states
            then takes as long as it takes in the air.
        recorders: one a drone, or none; nothing comes back from there.
        threads: for pilots that see, and as many for their images; 0: all on the calling one; None: as many as there
            are processors.
        pictured: keep key frames for the report.
        progress: called with (steps done, steps in all).
        preparing: the same, of what is done before the first step: the companion, the networks, the world.
    """
    begin, began = time.perf_counter(), datetime.now(UTC)
    times = step_times(scenario)
    builder = FlightLogBuilder(times, len(scenario.vehicles))
    preparing(0, _PREPARATIONS)
    loop = ControlLoop(scenario, gated=gated)
    vehicles = vehicles_of(scenario)
    chosen = key_frame_steps(len(times)) if pictured else set()
    key_frames: list[KeyFrame] = []
    flown = 0
    companion = None
    pilots: ExactStatePilots | VisionPilots = ExactStatePilots(scenario, shown, gated=gated)
    if perception == "learned":
        companion = fly_exact_states(scenario, gated=gated)[1:]
        pilots = VisionPilots(scenario, swap, shown, recorders, companion, preparing, threads)
    preparing(_PREPARATIONS, _PREPARATIONS)
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
        perception=perception if not swap else f"learned, true {', '.join(sorted(swap))}",
        flow="none" if perception == "truth" else "truth" if "flow" in swap else scenario.drone.perception.flow,
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
    """Takes what operators asked of the autopilots, flies one step, and publishes who flies each drone."""
    if shown is not None:
        shown.take_requests(time_s, loop, vehicles)
    loop.fly(time_s, vehicles, commands, disturbed)
    if shown is not None:
        shown.show_flight(time_s, loop)


_PREPARATIONS = 4
"""The companion on exact states, the world, the networks, the pilots."""


class ExactStatePilots:
    """The flocking law on the exact states of all drones."""

    key_frames: Sequence[KeyFrame] = ()

    def __init__(self, scenario: ScenarioConfig, shown: FlockTelemetry | None, *, gated: bool) -> None:
        self._scenario, self._gated, self._shown = scenario, gated, shown
        self.begin_again()

    def begin_again(self) -> None:
        """For another flight from the beginning."""
        self._flock = ExactFlock(self._scenario, passes=self._gated)

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
        """Commands for all drones; there are no images. ``builder``: None where nothing is kept."""
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


class VisionPilots:
    """One pilot a drone, each given only its own images and its own autopilot's readings."""

    def __init__(
        self,
        scenario: ScenarioConfig,
        swap: frozenset[str],
        shown: FlockTelemetry | None,
        recorders: Sequence[Recorder],
        companion: tuple[FloatArray, FloatArray] | None,
        preparing: Callable[[int, int], None],
        threads: int | None = None,
    ) -> None:
        """``companion``: for what is recorded; None where nothing is. ``swap``, ``threads``: see `fly`."""
        self._companion = companion
        preparing(1, _PREPARATIONS)
        self._shown, self._recorders = shown, recorders
        self._cameras = CameraSimulator(scenario, threads=threads)
        preparing(2, _PREPARATIONS)
        self._pilots = Pilots(scenario, swap, threads)
        preparing(3, _PREPARATIONS)
        self._drones = self._pilots.drones
        self._scenario, self._yaw_rad = scenario, start_yaw(scenario)
        self._begin()

    def begin_again(self) -> None:
        """For another flight from the beginning, in the same world and with the same networks."""
        self._cameras.begin_again()
        self._pilots.begin_again()
        self._begin()

    def _begin(self) -> None:
        scenario = self._scenario
        self._hands = {i: navigator_of(scenario, i) for i in range(len(scenario.vehicles)) if i not in self._drones}
        ground = self._cameras.ground_height
        self._autopilots = {
            i: SimulatedAutopilot(scenario.sensors, seed=scenario.seed, drone=i, ground=ground) for i in self._drones
        }
        late = None if scenario.camera_faults is None else scenario.camera_faults.attitude
        self._attitudes = {} if late is None else {i: LateAttitude(late, scenario.seed, i) for i in self._drones}
        self._stepped: dict[int, Stepped] = {}
        self.key_frames: Sequence[KeyFrame] = ()
        """What the pilots worked with in the last step, where that was asked for."""

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
        """Commands for all drones. Each steps as soon as its images are drawn. ``builder``: as of exact states."""
        steps = {}
        render_ms = {}
        flying = [i for i in self._drones if i not in disturbed.removed]
        orders = {} if self._shown is None else self._shown.take_orders(flying)
        turn_rates = vehicles.trail.motion_at(time_s).turn
        for i in flying:
            begin = time.perf_counter()
            frames, seen = self._cameras.capture(i, step, time_s, vehicles, vehicles.trail, disturbed)
            render_ms[i] = 1e3 * (time.perf_counter() - begin)
            state = self._autopilots[i].read(
                time_s, vehicles.position[i], vehicles.velocity[i], vehicles.R_ned_body[i], turn_rates[i],
                vehicles.errors[i] if vehicles.errors else None,
            )  # fmt: skip
            if self._attitudes:
                state = self._attitudes[i].heard(state, vehicles.trail)
            with_pictures = pictured and i in self._drones[:_KEY_FRAME_DRONES]
            stepping = self._pilots.step(i, frames, state, seen, pictured=with_pictures, order=orders.get(i))
            steps[i] = frames, state, stepping
        self._stepped = {i: stepping.result() for i, (_, _, stepping) in steps.items()}
        self.key_frames = [frame for stepped in self._stepped.values() for frame in stepped.key_frames]
        truth = None if self._companion is None else self._truth(step, time_s, vehicles, self._companion)
        for i, stepped in self._stepped.items():
            frames, state, _ = steps[i]
            output = stepped.output
            if self._shown is not None:
                self._shown.show(i, frames, state, output)
            if self._recorders and truth is not None:
                recorder = self._recorders[self._drones.index(i)]
                recorder.drain()  # simulated time stands still, so nothing need ever be dropped
                recorder.step(frames, state, output, truth, orders.get(i))
            if builder is not None:
                builder.add_output(step, i, output, {"render": render_ms[i], **output.stages_ms})
        return self._commands(time_s, vehicles)

    def _commands(self, time_s: float, vehicles: Vehicles) -> Commands:
        """Commands of the pilots, and of the people who fly drones by hand."""
        commands = Commands.of(len(self._scenario.vehicles))
        for i, stepped in self._stepped.items():
            output, command = stepped.output, stepped.output.command
            commands.velocity[i], commands.acceleration[i] = command.velocity, command.acceleration
            commands.yaw_rad[i] = self._yaw_rad if command.yaw_rad is None else command.yaw_rad
            commands.height_m[i] = np.nan if command.height_m is None else command.height_m
            commands.missions[i], commands.obstacles[i] = output.mission, output.obstacles
            commands.neighbours[i] = output.neighbours
            commands.desired[i] = desired_of(self._scenario.drone_of(i).mission, time_s, output.mission)
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
