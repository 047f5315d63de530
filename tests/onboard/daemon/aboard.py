"""A daemon in a test: real MAVSDK to the fake autopilot, real frames over zenoh, a tiny perceiver, a watcher."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import zenoh

from flockd.cli import main
from flockd.core.config import DroneConfig
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.drone import OperatorCommand, TelemetryParameters
from flockd.core.config.flocking import FlockingParameters
from flockd.core.config.geometry import GeometryParameters
from flockd.core.config.mission import MissionParameters
from flockd.core.config.perception import PerceptionConfig
from flockd.core.config.safety import GateParameters, SafetyParameters
from flockd.core.config.source import SharedMemoryParameters, SourceParameters
from flockd.core.messages import Float32Array, Frame, UInt8Array
from flockd.fleet.watcher import FleetWatcher, Heard
from flockd.flight.geometry import RigCamera, ZMap
from flockd.flight.perception import Crops, OneByOne, RangeEstimates, SceneMaps
from flockd.onboard.autopilot.refusal_reasons import REASONS
from flockd.onboard.daemon import Daemon, ServiceManager
from flockd.onboard.sources import FramePublisher
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.sitl.processes import free_endpoint
from tests import make
from tests.calm import clock
from tests.flight.perception.cameras import SECOND_STAGE
from tests.onboard.autopilot.flight import until

WIDTH, HEIGHT = 64, 48
COARSE_PX = 8
CAMERAS = ("front", "back")
FRAMES_HZ = 10.0
STEP_S = 0.25
SPEED_M_S = 1.0
COMMANDS: tuple[OperatorCommand, ...] = ("resume", "land", "goto", "velocity")
SECONDS_TO_FAIL = 60.0
"""Limit on the event loop's clock. Nothing is promised within it: it ends a story that hangs."""
QUIET_S = 1.5
"""For which nothing may be sent; PX4 would be back in offboard with one setpoint."""
PATIENT = SafetyParameters(
    gate=GateParameters(command_timeout_s=5.0),
    degraded_load=50.0,
    max_load=100.0,
    max_loop_lag_s=2.0,
    estimate_timeout_s=5.0,
    recovery_s=0.5,
)
"""These stories are not about how fast the computer is that tells them."""


class TinyPerceiver(OneByOne):
    """Not networks: says that all stands still before a tilted wall, and sees no drone. A test may spoil it."""

    map_stride = 2
    second_stage = SECOND_STAGE

    def __init__(self) -> None:
        self.not_finite = 0
        """So many of the first camera's next flows are not finite."""
        self.unexpected = 0
        """So many of the first camera's next flows end in an error that nobody expects."""
        self.hangs = threading.Event()
        """Set: does not answer."""
        self.slow_s = 0.0
        """Each flow takes this much longer."""
        self.ends_when_told = True
        self.told_to_end = 0

    def terminate(self) -> None:
        self.told_to_end += 1
        if self.ends_when_told:
            self.hangs.clear()

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        of_first = first.camera == CAMERAS[0]  # cameras are computed side by side, in any order
        if of_first and self.not_finite > 0:
            self.not_finite -= 1
            raise FloatingPointError("model tiny: output flow is not finite")
        time.sleep(self.slow_s)
        if of_first and self.unexpected > 0:
            self.unexpected -= 1
            raise KeyError("for the test")
        while self.hangs.is_set():
            time.sleep(0.01)
        return np.zeros((*first.image.shape[:2], 2), np.float32)

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        height, width = frame.image.shape[:2]
        rows, columns = np.mgrid[0:height, 0:width]
        depth = (5.0 + 0.02 * rows + 0.01 * columns).astype(np.float32)
        return SceneMaps(ZMap(depth), np.zeros((height, width), np.uint8), ())

    def ranges(self, crops: Crops) -> RangeEstimates:
        return RangeEstimates.unknown(0)


Image = Callable[[str, int], UInt8Array]
"""What a camera sees, by its name and the number of the frame."""


def noise(camera: str, number: int, grain_px: int = 1) -> UInt8Array:
    """(HEIGHT, WIDTH, 3), different in each frame."""
    rng = np.random.default_rng([CAMERAS.index(camera), number])
    pattern = rng.integers(0, 256, (HEIGHT // grain_px, WIDTH // grain_px, 3), dtype=np.uint8)
    return pattern.repeat(grain_px, axis=0).repeat(grain_px, axis=1)


def coarse(camera: str, number: int) -> UInt8Array:
    """The same in patches, which is no noise: enough where `TinyPerceiver` stands in for networks."""
    return noise(camera, number, COARSE_PX)


class Cameras:
    """Publishes pictures of all cameras until told otherwise."""

    def __init__(self, endpoint: str, image: Image = coarse, clock: Callable[[], float] = time.monotonic) -> None:
        self.silent: set[str] = set()
        self.spoil: Callable[[Frame], Frame] = lambda frame: frame
        """What a story does to each frame before it is sent."""
        self._image, self._clock = image, clock
        self.noisy: set[str] = set()
        self._publisher = FramePublisher(listen=[endpoint])
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._publisher.close()

    def _run(self) -> None:
        number = 0
        while not self._closing.wait(1.0 / FRAMES_HZ):
            number += 1
            for camera in CAMERAS:
                if camera not in self.silent:
                    show = noise if camera in self.noisy else self._image
                    frame = Frame(camera, show(camera, number), self._clock(), number)
                    self._publisher.publish("tiny", self.spoil(frame))


def config_for(
    port: int,
    frames: str,
    telemetry: str,
    own_velocity: Literal["vision", "autopilot"] = "autopilot",
    **autopilot: Any,
) -> DroneConfig:
    return make.drone(
        *(make.camera(name, yaw_deg=yaw) for name, yaw in zip(CAMERAS, (0.0, 180.0), strict=True)),
        name="tiny",
        step_s=STEP_S,
        perception=PerceptionConfig(deadline_s=0.5),
        geometry=GeometryParameters(hypotheses=20),
        safety=PATIENT,
        source=SourceParameters(
            kind="shared_memory",
            shared_memory=SharedMemoryParameters(drone="tiny", connect=(frames,), rate_hz=FRAMES_HZ / 2),
        ),
        autopilot=AutopilotParameters(address=f"udpin://127.0.0.1:{port}", **autopilot),
        telemetry=TelemetryParameters(fleet="test", listen=(telemetry,), commands=COMMANDS),
        flocking=FlockingParameters(max_speed_m_s=2.0),
        mission=MissionParameters(speed_m_s=SPEED_M_S, circle_until_s=0.0),
        own_velocity=own_velocity,
        yaw="hold",
    )


@dataclass
class Watched:
    """A daemon that is watched from outside, and its world, which a story can touch."""

    config: DroneConfig
    fake_autopilot: FakeAutopilot
    cameras: Cameras
    watcher: FleetWatcher
    session: zenoh.Session
    events: list[str]
    orders: int = field(default=0, kw_only=True)

    def heard(self) -> dict[str, Heard]:
        return {topic: heard for drone in self.watcher.drones() for topic, heard in drone.topics.items()}

    def state(self) -> str:
        flight = self.heard().get("flight")
        return "" if flight is None else str(flight.message["state"])

    def mission(self, key: str) -> object:
        """A key of the newest message on its mission; None before the first."""
        heard = self.heard().get("mission")
        return None if heard is None else heard.message[key]

    def matters(self) -> set[str]:
        """The supervisor's events."""
        return self._reasons() - REASONS.keys()

    def refusals(self) -> set[str]:
        """Why the autopilot would refuse to arm or to fly offboard."""
        return self._reasons() & REASONS.keys()

    def _reasons(self) -> set[str]:
        flight = self.heard().get("flight")
        return set() if flight is None else {reason["event"] for reason in flight.message["reasons"]}

    async def until_state(self, *states: str) -> None:
        await until(lambda: self.state() in states, SECONDS_TO_FAIL)

    async def until_event(self, beginning: str) -> None:
        try:
            await until(lambda: any(event.startswith(beginning) for event in self.events), SECONDS_TO_FAIL)
        except AssertionError as problem:
            raise AssertionError(f"no event begins with {beginning!r}: {self.events}") from problem

    async def until_matters(self, *events: str, over: tuple[str, ...] = ()) -> None:
        """Until these events of the supervisor are there, and those that are ``over`` are not."""
        await until(lambda: {*events} <= self.matters() and not {*over} & self.matters(), SECONDS_TO_FAIL)

    async def until_mode(self, mode: str = "LOITER") -> None:
        """Until the autopilot is in it; ours is Hold."""
        await until(lambda: self.fake_autopilot.mode == mode, SECONDS_TO_FAIL)

    async def until_linked(self) -> None:
        """Until the autopilot's heartbeats come."""
        await until(lambda: self.heard()["flight"].message["heartbeat_age_s"] < 1.0, SECONDS_TO_FAIL)

    @asynccontextmanager
    async def sends_nothing(self) -> AsyncIterator[None]:
        """No setpoint meanwhile, nor for a while afterwards."""
        sent = len(self.fake_autopilot.setpoints)
        yield
        await asyncio.sleep(QUIET_S)
        assert len(self.fake_autopilot.setpoints) == sent, "one more, and PX4 would be in offboard again"

    async def steps_on(self, more: int = 4) -> None:
        """Until so many steps more were made, and one."""
        steps = self.heard()["computer"].message["steps"]
        await until(lambda: self.heard()["computer"].message["steps"] > steps + more, SECONDS_TO_FAIL)

    async def ask(self, what: str) -> dict[str, Any]:
        """The answer to a query, with zenoh alone as any other program would put it."""
        payload = b""
        if what.startswith("ask/"):
            clock = json.loads(await self._query("time"))
            who = {"identity": clock["identity"], "operator": "a test", "session": "of a test"}
            self.orders += 1
            ask = {**who, "sequence": self.orders, "time_s": clock["time_s"], "order": None}
            payload = json.dumps(ask).encode()
        answer: dict[str, Any] = json.loads(await self._query(what, payload))
        return answer

    async def fleet(self, *arguments: str) -> int:
        """The exit code of `flockd fleet`, as a person runs it."""
        endpoint = self.config.telemetry.listen[0]
        return await asyncio.to_thread(main, ["fleet", *arguments, "--connect", endpoint])

    async def picture(self, camera: str) -> bytes:
        return await self._query(f"image/{camera}")

    async def _query(self, what: str, payload: bytes = b"") -> bytes:
        key = f"flockd/v1/test/tiny/{what}"
        for _ in range(100):  # until the two have found each other; zenoh tries again ever less often
            replies = await asyncio.to_thread(
                lambda: list(self.session.get(key, payload=payload, timeout=SECONDS_TO_FAIL))
            )
            if replies:
                break
            await asyncio.sleep(0.1)
        (reply,) = replies
        answer = reply.ok or reply.err
        assert answer is not None
        return bytes(answer.payload.to_bytes())

    async def is_ready_in_the_air(self) -> None:
        """As after a restart in the air, once an operator has said that it may fly again."""
        await self.until_state("idle")
        await until(lambda: self.matters() == {"started", "not_offboard", "neighbours_lost"}, SECONDS_TO_FAIL)
        assert (await self.ask("ask/resume"))["accepted"] is True
        await self.until_state("ready")

    async def flies(self) -> None:
        """The pilot selects offboard; and again, as often as a busy computer lets go of it before the drone is fast."""
        px4 = self.fake_autopilot
        await until(lambda: len(px4.setpoints) > 5, SECONDS_TO_FAIL)
        px4.pilot_selects("OFFBOARD")
        async with asyncio.timeout(3 * SECONDS_TO_FAIL):
            await asyncio.sleep(0.5)
            while self.speed() < 0.8 * SPEED_M_S:
                await asyncio.sleep(0.01)
                if px4.mode == "OFFBOARD":
                    continue
                px4.pilot_selects("LOITER")
                while self.state() != "ready":
                    await self.ask("ask/resume")
                    await asyncio.sleep(0.5)
                self.events.clear()
                px4.pilot_selects("OFFBOARD")
                await asyncio.sleep(0.5)

    def last_setpoint_s(self) -> float:
        """When the newest came, on the autopilot's clock."""
        return self.fake_autopilot.setpoints[-1][0]

    def standing_still(self, after_s: float) -> bool:
        """Setpoints came after this time, and all of them command standstill.

        But for what the gate adds to bring a drone there that still moves.
        """
        sent = [setpoint for at_s, setpoint in list(self.fake_autopilot.setpoints) if at_s > after_s]
        return bool(sent) and all(np.linalg.norm(one.velocity) < 0.2 for one in sent)

    def speed(self) -> float:
        return float(np.linalg.norm(self.fake_autopilot.state.velocity[:2]))


@dataclass
class Aboard(Watched):
    """A daemon in this process, so that a story can touch its inside too."""

    perceiver: TinyPerceiver
    daemon: Daemon
    ending: asyncio.Task[None]
    service: list[str]

    async def until_state(self, *states: str) -> None:
        """Raises what ended the daemon, if it is over before."""
        await until(lambda: self.state() in states or self.ending.done(), SECONDS_TO_FAIL)
        if self.ending.done():
            self.ending.result()
            assert self.state() in states


@asynccontextmanager
async def aboard(
    fake_autopilot: FakeAutopilot,
    port: int,
    tmp_path: Path,
    *,
    recordings: Path | None = None,
    own_velocity: Literal["vision", "autopilot"] = "autopilot",
    change: Callable[[DroneConfig], DroneConfig] = lambda config: config,
    **autopilot: Any,
) -> AsyncIterator[Aboard]:
    """A daemon that runs, watched. The story ends it, or else it is asked to end.

    ``change`` makes another configuration of the usual one.
    """
    frames, telemetry = free_endpoint(), free_endpoint()
    perceiver, cameras = TinyPerceiver(), Cameras(frames, clock=clock)
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(tmp_path / "notify"))
    manager.setblocking(False)
    config = change(config_for(port, frames, telemetry, own_velocity, **autopilot))
    environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000000"}
    daemon = Daemon(
        config,
        "tiny.yaml",
        load_networks=lambda: perceiver,
        models={"tiny": "0" * 64},
        recordings=recordings,
        service=ServiceManager(environment, clock=clock),
        clock=clock,
    )
    ending = asyncio.create_task(daemon.run())
    told: list[str] = []
    listening = asyncio.create_task(_listen(manager, told))
    with watched(telemetry, clock) as (watcher, session, events):
        try:
            yield Aboard(config, fake_autopilot, cameras, watcher, session, events, perceiver, daemon, ending, told)
        finally:
            perceiver.hangs.clear()
            listening.cancel()
            daemon.ask_to_stop()
            await asyncio.wait({ending})
            cameras.close()
            manager.close()


@contextmanager
def watched(
    telemetry: str, clock: Callable[[], float] = time.monotonic
) -> Iterator[tuple[FleetWatcher, zenoh.Session, list[str]]]:
    """A watcher of a daemon's telemetry, a session to ask it with, and the events that it has published."""
    watcher = FleetWatcher("test", listen=[], connect=[telemetry], clock=clock)
    session = zenoh.open(client(telemetry))
    events: list[str] = []
    watcher._session.declare_subscriber(  # who has heard a state on it hears the next event; another may connect later
        "flockd/v1/test/tiny/events", lambda sample: events.append(json.loads(sample.payload.to_bytes())["event"])
    )
    try:
        yield watcher, session, events
    finally:
        session.close()  # type: ignore[no-untyped-call]
        watcher.close()


async def _listen(manager: socket.socket, told: list[str]) -> None:
    while True:
        told += (await asyncio.get_running_loop().sock_recv(manager, 4096)).decode().splitlines()


def client(endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    return config
