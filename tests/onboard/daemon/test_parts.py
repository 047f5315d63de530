"""The daemon's small parts, one at a time."""

from __future__ import annotations

import asyncio
import math
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.drone import DroneConfig
from flockd.core.config.source import SourceParameters
from flockd.core.data import data_path
from flockd.core.errors import FlockdError, ModelError
from flockd.core.messages import (
    EgoMotion,
    Frame,
    FrameSet,
    LearnedSize,
    Neighbour,
    PilotOutput,
    RangeReading,
    Reason,
    ReasonKind,
    SizeStatus,
)
from flockd.flight.geometry import rotation_from_euler
from flockd.flight.inference import OnnxModel
from flockd.flight.perception import ImagePair
from flockd.flight.pilot.camera_agreement import moves_otherwise
from flockd.flight.safety import Action, Decision, Gate, Inputs, Permission, Request, State
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.onboard.daemon import Daemon
from flockd.onboard.daemon.control import Control
from flockd.onboard.daemon.message_sinks import MessageSinks
from flockd.onboard.daemon.operator_orders import OperatorRequests
from flockd.onboard.daemon.pilot_loop import (
    PilotLoop,
    Reports,
    StepResult,
    VehicleHistory,
    last_seen_s,
)
from flockd.onboard.daemon.status import ServiceManager
from flockd.onboard.daemon.supervisor_inputs import CameraMonitor, InputCollector, LoopLag, Thermometer, thermal_zones
from flockd.onboard.daemon.watched_networks import NetworkStuckError, WatchedNetworks
from flockd.onboard.recording import Recorder
from flockd.onboard.sources import CameraStatus, Count
from flockd.onboard.worker import Worker
from flockd.sim.sitl.processes import free_endpoint
from tests.make import around, autopilot_status, camera, changed, drone, neighbour, output, vehicle, wanted
from tests.onboard.autopilot.flight import until
from tests.onboard.daemon.aboard import TinyPerceiver, config_for

IMAGE = np.zeros((48, 64, 3), np.uint8)
FRAME = Frame("front", IMAGE, 0.0, 0)
PAIR = ImagePair(FRAME, FRAME, np.zeros((48, 64), np.uint8))


@pytest.mark.fault("network-stuck")
def test_a_stuck_network_is_ended_then_abandoned_then_hopeless() -> None:
    tiny = TinyPerceiver()
    networks = WatchedNetworks(tiny, deadline_s=0.5)
    networks.flows([PAIR])
    assert (networks.stuck, networks.hopeless) == (False, False)

    tiny.hangs.set()
    with pytest.raises(NetworkStuckError, match=r"took longer than 0\.5 s"):
        networks.flows([PAIR])
    assert (networks.stuck, networks.ended, tiny.told_to_end, networks.hopeless) == (True, 1, 1, False)
    networks.flows([PAIR])
    assert not networks.stuck, "it answers again"

    tiny.ends_when_told = False
    tiny.hangs.set()
    for hopeless in (False, True):
        with pytest.raises(NetworkStuckError):
            networks.flows([PAIR])
        assert networks.hopeless is hopeless
    tiny.hangs.clear()
    networks.flows([PAIR])
    assert not networks.hopeless, "a worker of its own answers"


def test_the_shipped_networks_end_when_told() -> None:
    """A picture of 16 megapixels takes a flow network many seconds on any computer that flies."""
    model = OnnxModel(data_path("models") / "flow.yaml", threads=1)
    image = np.zeros((1, 4096, 4096, 3), np.uint8)
    worker = Worker("test")
    call = worker.submit(model.run, dict.fromkeys(model.manifest.inputs, image))
    assert not call.done()
    while not call.done():
        model.terminate()
        time.sleep(0.01)
    with pytest.raises(Exception, match="terminate"):
        call.result()
    worker.leave(5.0)


@pytest.mark.parametrize("abstract", [False, True])
def test_a_service_manager_hears_the_protocol_of_sd_notify(abstract: bool, tmp_path: Path) -> None:
    name = f"@flockd-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    now_s = 100.0
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(name.replace("@", "\0"))
        manager.settimeout(1.0)
        environment = {"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}
        service = ServiceManager(environment, clock=lambda: now_s)
        service.starting("waits", 2.5)
        assert manager.recv(999) == b"EXTEND_TIMEOUT_USEC=2500000\nSTATUS=waits"
        service.ready("idle")
        assert manager.recv(999) == b"READY=1\nSTATUS=idle"
        for now_s in (100.0, 100.1, 100.4, 100.6, 100.7):  # noqa: B007 - read by the service's clock
            service.alive()
        service.stopping()
        assert [manager.recv(999) for _ in range(3)] == [b"WATCHDOG=1", b"WATCHDOG=1", b"STOPPING=1"]


def test_without_a_service_manager_or_its_watchdog_nothing_is_said_and_nothing_fails(tmp_path: Path) -> None:
    ServiceManager({}).ready("idle")
    ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "none"), "WATCHDOG_USEC": "1"}).alive()
    other = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1", "WATCHDOG_PID": "1"}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(other["NOTIFY_SOCKET"])
        manager.setblocking(False)
        ServiceManager(other).alive()
        with pytest.raises(BlockingIOError):
            manager.recv(999)


def test_a_thermal_zone_that_cannot_be_read_does_not_count(tmp_path: Path) -> None:
    assert thermal_zones(tmp_path) == []
    for number, reading in enumerate(("41500", "67250", "", "off")):
        (tmp_path / f"thermal_zone{number}").mkdir()
        (tmp_path / f"thermal_zone{number}" / "temp").write_text(reading, encoding="ascii")
        (tmp_path / f"thermal_zone{number}" / "type").write_text("cpu\n", encoding="ascii")
    assert thermal_zones(tmp_path) == [("cpu", 41.5), ("cpu", 67.25)]


async def test_a_temperature_that_cannot_be_read_costs_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """With one for each attempt, the service's TasksMax would end the flight after some minutes."""
    hangs, answers = threading.Event(), threading.Event()

    def zones() -> list[tuple[str, float]]:
        if hangs.is_set():
            answers.wait()
        return [("cpu", 41.5)]

    monkeypatch.setattr("flockd.onboard.daemon.supervisor_inputs.thermal_zones", zones)
    monkeypatch.setattr("flockd.onboard.daemon.supervisor_inputs.READ_EVERY_S", 0.02)
    others, thermometer = set(threading.enumerate()), Thermometer()
    reading = asyncio.create_task(thermometer.run())
    await until(lambda: thermometer.hottest_c == 41.5)
    hangs.set()
    await until(lambda: thermometer.hottest_c is None)
    for _ in range(5):
        await asyncio.sleep(0.05)
    assert [thread.name for thread in threading.enumerate() if thread not in others] == ["thermometer"]
    hangs.clear()
    answers.set()
    await until(lambda: thermometer.hottest_c == 41.5)
    reading.cancel()


def test_a_blocked_event_loop_is_seen_while_it_is_and_after() -> None:
    now_s = 100.0

    async def story() -> None:
        nonlocal now_s
        lag = LoopLag(lambda: now_s)
        task = asyncio.create_task(lag.run())
        await asyncio.sleep(0.2)
        assert lag.worst_s() == 0.0
        now_s += 5.0  # while the loop runs nothing
        assert lag.worst_s() > 4.5
        await asyncio.sleep(0.2)
        assert lag.worst_s() > 4.5
        task.cancel()

    asyncio.run(story())


def _status(fault: str | None, **counts: int) -> dict[str, CameraStatus]:
    known: dict[Count, int] = {"received": 0, **counts}  # type: ignore[dict-item]
    return {"front": CameraStatus(0.1, fault, known)}


def test_monitor_tell_frozen_from_unplugged_and_count_bad_frames_of_late() -> None:
    monitor = CameraMonitor(_flyable("front"))
    fine = monitor.update(0.0, _status(None, received=100, frozen=3))[0]["front"]
    assert (fine.fault, fine.period_s) == (None, 0.1)
    gone = monitor.update(1.0, _status("front: no such device", received=100, frozen=3))[0]["front"]
    assert gone.fault == "unplugged"
    monitor.update(2.0, _status(None, received=110, frozen=3))
    frozen = monitor.update(3.0, _status("front: the image is frozen", received=120, frozen=5))[0]["front"]
    assert frozen.fault == "frozen"
    late = monitor.update(4.0, _status(None, received=140, corrupt=10))
    assert late[1] == 10 / 40
    assert monitor.update(12.0, _status(None, received=150, corrupt=10))[1] == 0.0


def _flyable(*cameras: str) -> DroneConfig:
    shared, link = SourceParameters(kind="shared_memory"), AutopilotParameters()
    return drone(*(camera(name) for name in cameras), source=shared, autopilot=link)


def test_images_found_useless_when_decoded_count_against_the_few_that_are_decoded() -> None:
    """A camera at 30 Hz of which every fifteenth image is used: 20 of 300, and yet all that anybody saw of it."""
    monitor = CameraMonitor(_flyable("front"))
    monitor.update(0.0, _status(None, received=0, used=0))
    assert monitor.update(1.0, _status(None, received=300, used=15, corrupt=5, undecodable=5))[1] == 5 / 20
    assert monitor.update(2.0, _status(None, received=600, used=40), noisy_images=10)[1] == 10 / 40
    assert monitor.update(3.0, _status(None, received=900, used=40, corrupt=600))[1] == 600 / 900


def test_a_camera_whose_images_are_noise_for_three_of_its_periods_is_lost() -> None:
    monitor = CameraMonitor(_flyable("front", "back"))
    status = {**_status(None), "back": _status(None)["front"]}

    def lost(now: float, *noisy: str) -> list[str]:
        return [name for name, health in monitor.update(now, status, noisy)[0].items() if health.fault == "noisy"]

    assert lost(10.0) == []
    assert lost(10.25, "front") == []  # at 10 Hz, 0.3 s are allowed
    assert lost(10.35, "front") == ["front"]
    assert lost(10.4) == []


def test_frames_get_the_vehicle_state_of_their_time() -> None:
    history = VehicleHistory()
    assert history.at(1.0) is None
    for number in range(100):
        yaw = math.radians(number)
        turned = np.array([[math.cos(yaw), -math.sin(yaw), 0.0], [math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        velocity = np.array([0.1 * number, 0.0, 0.0])
        history.add(vehicle(100.0 + 0.05 * number, float(number), R_ned_body=turned, velocity_ned=velocity))
    found = [history.at(time_s) for time_s in (104.62, 104.95, 103.0, math.inf, 7.0)]
    assert [state and state.height_m for state in found] == pytest.approx([92.4, 99.0, 60.0, 99.0, 99.0])


def test_frames_get_the_range_that_was_taken_nearest_to_them() -> None:
    """Between two ranges there is none: over an edge, their mean would be of nothing."""
    history = VehicleHistory()
    for time_s, reading in ((1.0, RangeReading(0.98, 4.0)), (1.1, RangeReading(1.09, 2.5)), (1.2, None)):
        history.add(vehicle(time_s, ground_range=reading))
    found = [history.at(time_s) for time_s in (1.02, 1.06, 1.18)]
    assert [state and state.ground_range and state.ground_range.range_m for state in found] == [4.0, 2.5, 2.5]


def test_a_range_finder_that_fails_is_an_event_and_so_is_its_return() -> None:
    reports = Reports()
    weak, old = (
        Reason(ReasonKind.HEIGHT, f"height: the range{fault}; the barometer's is used")
        for fault in (" finder's signal is too weak", " is too old")
    )
    left = Reason(ReasonKind.CAMERA, "camera left: no frame")
    steps: tuple[tuple[Reason, ...], ...] = ((), (left, weak), (weak,), (old,), (left,), ())
    found = [reports.update(output(reasons=reasons)) for reasons in steps]
    assert found == [[], [weak.text], [], [old.text], ["height: the range finder works again"], []]


def test_a_camera_that_is_flown_without_is_said_once_a_flight() -> None:
    reports, told = Reports(), Reason(ReasonKind.RIG, f"{moves_otherwise('left')} The drone flies without it.")
    steps: tuple[tuple[Reason, ...], ...] = ((), (told,), (), (told,))
    assert [reports.update(output(reasons=reasons)) for reasons in steps] == [[], [told.text], [], []]
    reports.begin()
    assert reports.update(output(reasons=(told,))) == [told.text]


def test_who_has_seen_another_twice_is_not_alone_though_it_is_not_confirmed_yet() -> None:
    def track(unseen_s: float, probability: float, *, confirmed: bool) -> Neighbour:
        return neighbour(
            [1.0, 1.0, 1.0], unseen_s=unseen_s, confirmed=confirmed, existence_probability=probability, hits=2
        )

    confirmed, twice, once = (
        track(2.0, 0.7, confirmed=True),
        track(1.0, 0.95, confirmed=False),
        track(0.0, 0.5, confirmed=False),
    )
    seen = [last_seen_s(20.0, tracks) for tracks in ((), (once,), (confirmed, once), (confirmed, twice, once))]
    assert seen == [-math.inf, -math.inf, 18.0, 19.0]


def test_what_is_learned_of_the_others_size_is_an_event_each_time_that_it_is_new() -> None:
    reports = Reports()
    steps = (None, SizeStatus(weaves=True), SizeStatus(weaves=True), *[SizeStatus(False, 0.431, 0.08)] * 2)
    told = [[text.partition(";")[0] for text in reports.update(output(size=size))] for size in steps]
    weaves = "size: moves up and down to learn how large the others are"
    assert told == [[], [weaves], [], ["size: the others are 0.43 m large, +-8%"], []]


def test_the_own_motion_is_missed_from_the_last_step_that_found_it() -> None:
    """In seconds of the steps, also where a flight begins, whose first step has nothing to compare with."""
    anything: Any = None
    loop = PilotLoop(_flyable("front"), anything, anything, anything, anything, anything, lambda: 0.0)
    found, ages = EgoMotion(np.eye(3), np.zeros(3), 0.1, 9, 9, 0.1), []
    steps = [(5.0, 1, None), (5.1, 2, found), (5.2, 3, None), (5.9, 4, None), (6.0, 5, found), (80.0, 1, None)]
    for time_s, number, ego in steps:
        loop.newest = StepResult(time_s, output(time_s, ego_motion=ego), 1, number)
        loop._count(loop.newest)
        ages.append(loop.ego_motion_age_s)
    assert ages == pytest.approx([0.0, 0.0, 0.1, 0.8, 0.0, 0.0])


def test_what_was_learned_goes_into_the_next_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[LearnedSize | None, bool]] = []

    class Pilot:
        def __init__(self, *_: object, learned: LearnedSize | None, flies: bool, stopwatch: object) -> None:
            made.append((learned, flies))
            self.learned = LearnedSize(0.1 * len(made), 0.05)

        def step(self, frames: FrameSet, *_: object) -> PilotOutput:
            for begin in during:
                begin()
            return output(frames.time_s)

    monkeypatch.setattr("flockd.onboard.daemon.pilot_loop.FlockPilot", Pilot)
    anything: Any = lambda *_: None  # noqa: E731
    networks: Any = SimpleNamespace(leave=lambda: None)
    loop = PilotLoop(_flyable("front"), anything, networks, anything, anything, anything, lambda: 0.0)
    state = vehicle(height_m=0.0, velocity_ned=None)
    during: list[Callable[[], None]] = []  # what happens while a step is under way
    begun: list[Callable[[], None]] = [lambda: None, lambda: loop.begin_flight(1), lambda: loop.begin_flight(2)]

    async def tell() -> None:
        for begin in begun:
            begin()
            await loop._step(0.0, 0.0, FrameSet(0.0, {}), state)

    asyncio.run(tell())
    newest, during = loop.newest, [lambda: loop.begin_flight(3)]
    asyncio.run(loop._step(0.0, 0.0, FrameSet(9.0, {}), state))
    assert loop.newest is newest, "a flight began while the step was under way: its result is nobody's"
    loop.leave()
    sizes_m = [None if learned is None else round(learned.size_m, 3) for learned, _ in made]
    assert sizes_m == [None, 0.1, 0.2]
    assert [flies for _, flies in made] == [False, True, True]


@pytest.mark.parametrize(("step_s", "first"), [(0.5, 2), (0.1, 6)])
def test_standstill_is_wanted_until_neighbours_can_be_confirmed(step_s: float, first: int) -> None:
    """Two detections, half a second apart."""
    config = changed(_flyable("front"), step_s=step_s)
    anything: Any = None
    loop: Any = SimpleNamespace(newest=None)
    control = Control(
        config, anything, anything, loop, anything, anything, anything, OperatorRequests(), anything, lambda: 0.0
    )
    flown = []
    for number in range(1, 9):
        loop.newest = StepResult(0.0, output(command=wanted([1.0, 1.0])), control._flight, number)
        flown.append(bool(control._wanted(0.0)[0].velocity.any()))
    assert flown.index(True) + 1 == first


def test_the_supervisor_is_told_of_an_obstacle_where_hold_needs_room() -> None:
    """As of the last tick's surroundings: `safety.hold_room_m` is 2 m."""
    config, status = _flyable("front"), autopilot_status(flight_mode="offboard")
    parts: Any = SimpleNamespace(  # all that the control loop asks, of whichever part
        newest=None, noisy_images=Counter(), ego_motion_age_s=0.0, neighbour_seen_s=0.0, load=lambda: 0.5, faults=0,
        stuck=False, worst_s=lambda: 0.0, hottest_c=None, report=lambda: SimpleNamespace(fault=None), end=str,
        takeover=None, status=dict,
    )  # fmt: skip
    collector = InputCollector(config, parts, parts, parts, Gate(config.safety.gate), parts, parts, {}, lambda: 0.0)
    link: Any = SimpleNamespace(status=lambda: status, vehicle_state=lambda: None)
    control = Control(
        config, link, parts, parts, collector, parts, parts, OperatorRequests(), lambda before, now: None, lambda: 0.0
    )
    told: list[Inputs] = []

    def step(_: float, inputs: Inputs) -> Decision:
        told.append(inputs)
        return Decision(State.IDLE, Action.SILENCE, ())

    control._supervisor = SimpleNamespace(step=step)  # type: ignore[assignment]
    for away_m in (1.9, 2.1):
        near = around(obstacles=[[away_m, 0.0]])
        control._request = Request(Permission(Action.FLY, 0.0), wanted(), 0.0, 5.0, near)
        control.tick()
    control.tick()  # in silence nothing is known to be near
    assert [inputs.obstacle_near for inputs in told] == [True, False, False]


async def test_a_disk_that_takes_its_time_to_end_a_recording_delays_no_telemetry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended, heard = threading.Event(), threading.Event()
    monkeypatch.setattr(Recorder, "close", lambda self, timeout_s: ended.wait(10.0))

    def publish(drone: str, topic: str, message: Mapping[str, object]) -> None:
        if "after" in message:
            heard.set()

    telemetry: Any = SimpleNamespace(publish=publish)
    sinks = MessageSinks(_flyable("front"), telemetry, {}, tmp_path, lambda: 0.0)
    sinks.begin_recording()
    sinks.end_recording()
    sinks.publish("flight", {"after": True})
    assert await asyncio.to_thread(heard.wait, 5.0)
    ended.set()
    await sinks.close()


async def test_a_message_of_another_thread_as_a_recording_ends_is_no_error() -> None:
    """Of an operator, whose order would get no answer."""
    recorders = iter([Mock(), None])

    class Ending(MessageSinks):
        _recorder: Any = property(lambda self: next(recorders), lambda self, value: None)

    sinks = Ending(_flyable("front"), Mock(), {}, None, lambda: 0.0)
    sinks.event("an operator asked for hold")
    assert list(recorders) == [None], "it was looked up once"


@pytest.mark.parametrize(
    ("load_s", "told"), [(60.0, "it is damaged"), (0.1, r"loading: not done within 0\.1 s; check disk and load")]
)
async def test_a_link_that_is_there_before_the_networks_fail_to_load_is_closed(
    load_s: float, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that a serial port is given back: the process may live on, and the next one needs it."""
    closed = asyncio.Event()

    async def close() -> None:
        closed.set()

    async def connect(*_: Any, **__: Any) -> Any:
        return SimpleNamespace(close=close)

    def fail() -> Any:
        time.sleep(0.2)
        raise ModelError("it is damaged")

    monkeypatch.setattr(AutopilotLink, "connect", connect)
    monkeypatch.setattr("flockd.onboard.daemon.daemon.LOAD_S", load_s)
    config = config_for(14540, free_endpoint(), free_endpoint())
    service = ServiceManager({})
    daemon = Daemon(config, "x.yaml", load_networks=fail, models={}, recordings=None, service=service)
    with pytest.raises(FlockdError, match=told):
        await daemon.run()
    assert closed.is_set()


def _turning_and_gathering_speed() -> VehicleHistory:
    """From 100 s on 2 m/s^2 north and 1 m/s down, from 1 m north and 2 m east; 0.5 rad/s to the right."""
    history = VehicleHistory()
    for k in range(11):
        t = 0.1 * k
        history.add(
            vehicle(
                100.0 + t, 5.0 - t, R_ned_body=rotation_from_euler(0.0, 0.0, 0.5 * t),
                velocity_ned=[2.0 * t, 0.0, 1.0], position=[1.0 + t**2, 2.0],
            )
        )  # fmt: skip
    return history


def test_how_far_it_moved_since_then_is_the_integral_of_its_velocity() -> None:
    moved = _turning_and_gathering_speed().moved_since(100.45)
    np.testing.assert_allclose(moved, [1.0 - 0.45**2, 0.0, 0.55], atol=1e-9)


def test_before_the_first_state_and_without_velocities_nothing_moved() -> None:
    assert VehicleHistory().moved_since(1.0).tolist() == [0.0, 0.0, 0.0]
    history = VehicleHistory()
    for time_s in (1.0, 2.0):
        history.add(vehicle(time_s, velocity_ned=None))
    assert history.moved_since(1.0).tolist() == [0.0, 0.0, 0.0]


def test_between_two_states_place_velocity_height_and_attitude_are_between() -> None:
    state = _turning_and_gathering_speed().at(100.525)
    assert state is not None and state.position is not None and state.velocity_ned is not None
    assert state.turn_rate is not None
    np.testing.assert_allclose(state.position, [1.0 + 0.75 * 0.5**2 + 0.25 * 0.6**2, 2.0], atol=1e-9)
    np.testing.assert_allclose(state.velocity_ned, [1.05, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(state.turn_rate, [0.0, 0.0, 0.5], atol=1e-9)
    assert state.height_m == pytest.approx(5.0 - 0.525)
    assert math.atan2(state.R_ned_body[1, 0], state.R_ned_body[0, 0]) == pytest.approx(0.5 * 0.525)
