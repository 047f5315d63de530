"""A simulated flock's telemetry, as of a real one: states, pictures on request, and orders that it flies."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Self

import numpy as np

from flockd import __version__
from flockd.core.messages import FrameSet, MissionOrder, PilotOutput, VehicleState, Wanted
from flockd.flight.geometry import build_rig
from flockd.flight.mission import order_fault
from flockd.flight.safety import State
from flockd.onboard.daemon.operator_orders import ORDERS, OrderChecks
from flockd.onboard.telemetry import TelemetrySink, publish_step
from flockd.onboard.telemetry.order_messages import parse_ask, parse_order
from flockd.onboard.telemetry.preview import Previews, Step
from flockd.onboard.telemetry.publisher import ZenohTelemetry
from flockd.onboard.telemetry.topics import AboutMessage, AnswerMessage, EventMessage, FlightMessage, ReasonMessage
from flockd.sim.cameras.camera_simulator import CameraSimulator
from flockd.sim.flock.control_loop import Commands, ControlLoop
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.vehicles.pose_trail import FlockPose
from flockd.sim.vehicles.vehicles import REFERENCE_DEG, UNDISTURBED, Disturbances, Vehicles

EVERY_S = 1.0
"""Less than the age at which a watcher counts a message as stale."""


class Repeater:
    """A telemetry sink that hands on each message at once, and the newest of each topic again every second.

    Its thread runs between ``__enter__`` and ``__exit__``.
    """

    def __init__(self, sink: TelemetrySink, every_s: float = EVERY_S) -> None:
        self._sink, self._every_s = sink, every_s
        self._newest: dict[tuple[str, str], Mapping[str, object]] = {}
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._repeat, name="telemetry repeater", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def forget(self, drone: str) -> None:
        """Stops repeating the messages of a drone that was removed."""
        with self._lock:
            self._newest = {key: message for key, message in self._newest.items() if key[0] != drone}

    def publish(self, drone: str, topic: str, message: Mapping[str, object]) -> None:
        """See `TelemetrySink`."""
        with self._lock:
            if topic != "events":  # each happened once
                self._newest[drone, topic] = message
            self._sink.publish(drone, topic, message)

    def _repeat(self) -> None:
        while not self._over.wait(self._every_s):
            with self._lock:
                for (drone, topic), message in self._newest.items():
                    self._sink.publish(drone, topic, message)


REQUESTS = frozenset({"hold", "resume"})
"""Of an operator, beside orders: to the drone's autopilot, and back."""


class FlockTelemetry:
    """Publishes what the drones do, and keeps the orders that they are given until their pilots take them.

    Of what an autopilot does it has Hold alone. Queries come on threads of zenoh's.
    """

    def __init__(self, scenario: ScenarioConfig, announcer: ZenohTelemetry, sink: Repeater) -> None:
        """`announcer`: where the flock is announced; `sink`: where it is published."""
        self._scenario, self._announcer, self._sink = scenario, announcer, sink
        self._drones = [i for i, vehicle in enumerate(scenario.vehicles) if not vehicle.by_hand]
        self._lock = threading.Lock()
        self._orders: dict[int, MissionOrder] = {}
        self._requests: dict[int, str] = {}
        self._refused = dict.fromkeys(self._drones, 0)
        self._disturbed = UNDISTURBED
        self._checks = {i: OrderChecks(announcer.identity, time.monotonic) for i in self._drones}
        self._stepped: dict[int, tuple[FrameSet | None, VehicleState, PilotOutput]] = {}
        """The newest step of each; without frames on exact states."""
        self._told = dict.fromkeys(self._drones, State.NORMAL.value)
        """The state of each drone in the last event, with its reasons."""
        self._drawn = _DrawnOnRequest(scenario)
        self.pictures: dict[int, Callable[[str], bytes | None]] = {}
        """Of each drone: the newest JPEG of a camera, with what was seen."""
        self._rig = build_rig(scenario.drone.rig)
        for i in self._drones:
            self._announce(i)

    def _announce(self, i: int) -> None:
        about = AboutMessage(
            version=__version__,
            configuration=self._scenario.drone_of(i).model_dump(mode="json"),
            commands=sorted(ORDERS | REQUESTS),
        )
        previews = Previews(self._rig, partial(self._newest, i))
        self.pictures[i] = previews.picture
        self._announcer.announce(f"drone{i + 1}", about, partial(self._ask, i), previews.picture)

    def begin_again(self) -> None:
        """Forgets orders and steps, as another flight begins with all drones."""
        with self._lock:
            self._orders, self._requests, self._stepped = {}, {}, {}
        self._told = dict.fromkeys(self._drones, State.NORMAL.value)
        self._drawn.begin_again()
        self.disturb(UNDISTURBED)

    def disturb(self, disturbed: Disturbances) -> None:
        """Takes the disturbances of a step: removed drones are withdrawn, restored ones announced again."""
        before, self._disturbed = self._disturbed, disturbed
        for i in disturbed.removed - before.removed:
            self._announcer.withdraw(f"drone{i + 1}")
            self._sink.forget(f"drone{i + 1}")
        for i in before.removed - disturbed.removed:
            self._announce(i)
        for i, camera in sorted(disturbed.cameras_off ^ before.cameras_off):
            self._tell(i, f"camera {camera} was switched {'off' if (i, camera) in disturbed.cameras_off else 'on'}")
        self._drawn.disturbed = disturbed

    def _tell(self, drone: int, sentence: str) -> None:
        stepped = self._stepped.get(drone)
        time_s = stepped[1].time_s if stepped else 0.0
        self._sink.publish(f"drone{drone + 1}", "events", {**EventMessage(time_s=time_s, event=sentence)})

    def take_requests(self, time_s: float, loop: ControlLoop, vehicles: Vehicles) -> None:
        """Holds and resumes drones as operators have asked since the last step."""
        with self._lock:
            requests, self._requests = self._requests, {}
        for i, command in requests.items():
            loop.hold(i, time_s, vehicles) if command == "hold" else loop.resume(i)

    def show_flight(self, time_s: float, loop: ControlLoop) -> None:
        """Publishes for each drone whether flockd or its autopilot flies it, and why."""
        for i in self._there():
            _, vehicle, output = self._stepped[i]
            (state, why), reasons = loop.status(i), [reason.text for reason in output.reasons]
            if (told := f"{state.value}: {'; '.join(why)}".removesuffix(": ")) != self._told[i]:
                self._told[i] = told
                self._tell(i, told)
            held = state is State.ASKING
            state = State.DEGRADED if state is State.NORMAL and reasons else state
            message = FlightMessage(
                time_s=time_s,
                state=state.value,
                reasons=[ReasonMessage(event="simulated", sentence=one) for one in (*why, *reasons)],
                flight_mode="hold" if held else "simulated",
                armed=True, in_air=True, heartbeat_age_s=None, heartbeats_lost=0, battery_share=None,
                height_m=vehicle.height_m, velocity_trim=[0.0, 0.0],
                velocity_error_m_s=loop.velocity_error_m_s(i),
                silence="its autopilot holds position" if held else None, setpoints_sent=0, setpoints_missed=0,
                orders=self._checks[i].recent(),
                orders_refused=self._refused[i],
            )  # fmt: skip
            self._sink.publish(f"drone{i + 1}", "flight", {**message})

    def _there(self) -> list[int]:
        return [i for i in self._drones if i not in self._disturbed.removed]

    def take_orders(self, drones: Sequence[int]) -> dict[int, MissionOrder]:
        """Returns and removes operators' orders to these drones that no step has taken yet, by drone."""
        with self._lock:
            return {i: self._orders.pop(i) for i in drones if i in self._orders}

    def show(self, drone: int, frames: FrameSet | None, vehicle: VehicleState, output: PilotOutput) -> None:
        """Publishes a step of a pilot, with the frames that it saw."""
        with self._lock:
            self._stepped[drone] = frames, vehicle, output
        publish_step(self._sink, f"drone{drone + 1}", vehicle, output)

    def show_exact(self, step: int, time_s: float, vehicles: Vehicles, commands: Commands) -> None:
        """Publishes a step of all drones that fly on exact states; pictures of it are drawn when someone asks."""
        self._drawn.newest = step, FlockPose(time_s, vehicles.position, vehicles.R_ned_body)
        for i in self._there():
            position, velocity = vehicles.position[i], vehicles.velocity[i]
            state = VehicleState(
                time_s, vehicles.R_ned_body[i], float(-position[2]), velocity, position[:2], np.array(REFERENCE_DEG)
            )
            wanted = Wanted(commands.velocity[i], commands.acceleration[i], float(commands.yaw_rad[i]))
            output = PilotOutput(
                time_s, None, velocity, (), (), commands.neighbours[i], wanted,
                mission=commands.missions[i], obstacles=commands.obstacles[i],
            )  # fmt: skip
            self.show(i, None, state, output)

    def _newest(self, drone: int) -> tuple[FrameSet | None, Step | None]:
        with self._lock:
            frames, vehicle, output = self._stepped.get(drone, (None, None, None))
        if frames is None or vehicle is None or output is None:
            return self._drawn.frames(drone) if self._drawn.newest else None, None
        return frames, (frames, vehicle, output)

    def _ask(self, drone: int, command: str, payload: bytes) -> AnswerMessage:
        try:
            self._take(drone, command, payload)
        except ValueError as error:
            self._refused[drone] += 1
            self._tell(drone, f"{command:.40} was refused: {error}")
            return AnswerMessage(accepted=False, sentence=str(error))
        return AnswerMessage(accepted=True, sentence=f"{command} is being tried; the drone's state shows the result")

    def _take(self, drone: int, command: str, payload: bytes) -> None:
        """Raises ValueError with the reason for which it is refused."""
        if command not in ORDERS | REQUESTS:
            raise ValueError(f"{command:.40} needs an autopilot; simulated drones only accept hold")
        ask = parse_ask(payload)
        order = parse_order(command, ask["order"]) if command in ORDERS else None
        with self._lock:
            stepped = self._stepped.get(drone)
        checks = self._checks[drone]
        fault = checks.fault(command, ask)
        if fault is None and order is not None:
            fault = order_fault(self._scenario.drone_of(drone), order, stepped and stepped[1])
        if fault is not None:
            raise ValueError(fault)
        checks.take(command, ask)
        self._tell(drone, f"{ask['operator']} ordered {command}")
        with self._lock:
            if order is None:
                self._requests[drone] = command
            else:
                self._orders[drone] = order


class _DrawnOnRequest:
    """Camera images of a flight whose drones use none. The world is built at the first request."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        self._scenario, self.disturbed = scenario, UNDISTURBED
        self.newest: tuple[int, FlockPose] | None = None
        """A step, and where all drones were in it."""
        self._cameras: Future[CameraSimulator] | None = None
        self._lock = threading.Lock()
        self._frames: dict[int, FrameSet] = {}

    def frames(self, drone: int) -> FrameSet | None:
        """Of the newest step; None while the world is being built."""
        with self._lock:
            if self._cameras is None:
                self._cameras = ThreadPoolExecutor(1, "world").submit(CameraSimulator, self._scenario, threads=1)
            if self.newest is None or not self._cameras.done():
                return None
            (step, poses), known = self.newest, self._frames.get(drone)
            if known is None or known.time_s != poses.time_s:
                cameras, time_s = self._cameras.result(), poses.time_s
                self._frames[drone] = cameras.capture(drone, step, time_s, poses, disturbed=self.disturbed)()
            return self._frames[drone]

    def begin_again(self) -> None:
        """For another flight from the beginning in the same world."""
        with self._lock:
            self._frames, self.newest = {}, None
            if self._cameras is not None:
                self._cameras.result().begin_again()
