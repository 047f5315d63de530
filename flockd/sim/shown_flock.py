"""A simulated flock as watchers find a real one: states, pictures on request, and orders that it flies."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

import numpy as np

from flockd import __version__
from flockd.core.config.scenario import ScenarioConfig
from flockd.core.messages import FrameSet, MissionOrder, PilotOutput, VehicleState, Wanted
from flockd.flight.geometry import build_rig
from flockd.flight.mission import order_fault
from flockd.onboard.daemon.operator_commands import ORDERS
from flockd.onboard.daemon.order_checks import OrderChecks
from flockd.onboard.telemetry import TelemetrySink, publish_step
from flockd.onboard.telemetry.order_messages import parse_ask, parse_order
from flockd.onboard.telemetry.preview import Previews
from flockd.onboard.telemetry.publisher import Ask, NewestImage
from flockd.onboard.telemetry.topics import AboutMessage, AnswerMessage
from flockd.sim.camera_simulator import CameraSimulator
from flockd.sim.commands import Commands
from flockd.sim.vehicles import REFERENCE_DEG, Vehicles


class Announcer(Protocol):
    """Where the flock is announced: `flockd.onboard.telemetry.publisher.ZenohTelemetry`."""

    @property
    def identity(self) -> str:
        """Of all drones that are announced there."""

    def announce(self, drone: str, about: AboutMessage, ask: Ask, newest_image: NewestImage) -> None:
        """A drone is alive, and replies to queries."""


class ShownFlock:
    """Publishes what the drones do, and keeps the orders that they are given until their pilots take them.

    Hold, land and resume are an autopilot's, which these drones have not got. Queries come on threads of zenoh's.
    """

    def __init__(self, scenario: ScenarioConfig, announcer: Announcer, sink: TelemetrySink) -> None:
        self._scenario, self._sink = scenario, sink
        self._drones = [i for i, vehicle in enumerate(scenario.vehicles) if not vehicle.by_hand]
        self._lock = threading.Lock()
        self._orders: dict[int, MissionOrder] = {}
        self._checks = {i: OrderChecks(announcer.identity, time.monotonic) for i in self._drones}
        self._states: dict[int, VehicleState] = {}
        self._stepped: dict[int, tuple[FrameSet, PilotOutput]] = {}
        self._drawn: _DrawnOnRequest | None = None
        rig = build_rig(scenario.drone.rig)
        for i in self._drones:
            about = AboutMessage(
                version=__version__,
                configuration=scenario.drone_of(i).model_dump(mode="json"),
                commands=sorted(ORDERS),
            )
            previews = Previews(rig, partial(self._newest, i))
            announcer.announce(f"drone{i + 1}", about, partial(self._ask, i), previews.picture)

    def take_order(self, drone: int) -> MissionOrder | None:
        """An operator's that no step has taken yet; it is taken now."""
        with self._lock:
            return self._orders.pop(drone, None)

    def show(self, drone: int, frames: FrameSet, vehicle: VehicleState, output: PilotOutput) -> None:
        """Publishes a step of a pilot that sees."""
        with self._lock:
            self._states[drone], self._stepped[drone] = vehicle, (frames, output)
        publish_step(self._sink, f"drone{drone + 1}", vehicle, output)

    def show_exact(self, step: int, time_s: float, vehicles: Vehicles, commands: Commands) -> None:
        """Publishes a step of all drones that fly on exact states; pictures of it are drawn when someone asks."""
        if self._drawn is None:
            self._drawn = _DrawnOnRequest(self._scenario)
        self._drawn.poses = _Poses(step, time_s, vehicles.position.copy(), vehicles.R_ned_body.copy())
        for i in self._drones:
            position, velocity = vehicles.position[i], vehicles.velocity[i]
            state = VehicleState(
                time_s, vehicles.R_ned_body[i], float(-position[2]), velocity, position[:2], np.array(REFERENCE_DEG)
            )
            wanted = Wanted(commands.velocity[i], commands.acceleration[i], float(commands.yaw_rad[i]))
            output = PilotOutput(
                time_s, None, velocity, (), (), {}, commands.neighbours[i], wanted,
                mission=commands.missions[i], obstacles=commands.obstacles[i],
            )  # fmt: skip
            with self._lock:
                self._states[i] = state
            publish_step(self._sink, f"drone{i + 1}", state, output)

    def _newest(self, drone: int) -> tuple[FrameSet | None, tuple[FrameSet, PilotOutput] | None]:
        if self._drawn is not None:
            return self._drawn.frames(drone), None
        with self._lock:
            stepped = self._stepped.get(drone)
        return (None, None) if stepped is None else (stepped[0], stepped)

    def _ask(self, drone: int, command: str, payload: bytes) -> AnswerMessage:
        if command not in ORDERS:
            return AnswerMessage(
                accepted=False, sentence=f"{command} is an autopilot's, and simulated drones have none"
            )
        try:
            ask = parse_ask(payload)
            order = parse_order(command, ask["order"])
        except ValueError as error:
            return AnswerMessage(accepted=False, sentence=str(error))
        with self._lock:
            state = self._states.get(drone)
        checks = self._checks[drone]
        fault = checks.fault(command, ask) or order_fault(self._scenario.drone_of(drone), order, state)
        if fault is not None:
            return AnswerMessage(accepted=False, sentence=fault)
        checks.take(command, ask)
        with self._lock:
            self._orders[drone] = order
        return AnswerMessage(accepted=True, sentence=f"{command} is being tried; the drone's state shows the result")


class RealTime:
    """Waits until as much real time has passed as simulated time."""

    def __init__(
        self, clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._clock, self._sleep = clock, sleep
        self._began_s: float | None = None

    def wait(self, time_s: float) -> None:
        """Until `time_s` of the flight."""
        if self._began_s is None:
            self._began_s = self._clock() - time_s
        self._sleep(max(0.0, self._began_s + time_s - self._clock()))


class _Poses:
    """Where all drones were in one step."""

    def __init__(self, step: int, time_s: float, position: np.ndarray, R_ned_body: np.ndarray) -> None:
        self.step, self.time_s, self.position, self.R_ned_body = step, time_s, position, R_ned_body


class _DrawnOnRequest:
    """Camera images of a flight whose drones look at none. The world is built when the first is asked for."""

    def __init__(self, scenario: ScenarioConfig) -> None:
        self._scenario = scenario
        self.poses: _Poses | None = None
        self._cameras: CameraSimulator | None = None
        self._building: threading.Thread | None = None
        self._lock = threading.Lock()
        self._frames: dict[int, FrameSet] = {}

    def frames(self, drone: int) -> FrameSet | None:
        """Of the newest step; None while the world is being built."""
        with self._lock:
            poses, cameras = self.poses, self._cameras
            if cameras is None or poses is None:
                if self._building is None:
                    self._building = threading.Thread(target=self._build, name="world", daemon=True)
                    self._building.start()
                return None
            known = self._frames.get(drone)
            if known is None or known.time_s != poses.time_s:
                self._frames[drone] = cameras.capture(drone, poses.step, poses.time_s, poses)[0]
            return self._frames[drone]

    def _build(self) -> None:
        self._cameras = CameraSimulator(self._scenario, threads=1)


def orders_of(shown: ShownFlock | None, drones: Sequence[int]) -> dict[int, MissionOrder]:
    """What operators have ordered since the last step, by drone."""
    taken = {} if shown is None else {i: shown.take_order(i) for i in drones}
    return {i: order for i, order in taken.items() if order is not None}
