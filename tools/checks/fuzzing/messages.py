"""Messages: MAVLink from an autopilot, telemetry and commands over zenoh, frames through shared memory, images."""

from __future__ import annotations

import asyncio
import io
import json
import math
import struct
import time
from contextlib import suppress
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any, get_args, get_origin, get_type_hints, is_typeddict

import cv2
import numpy as np
from pymavlink.dialects.v20 import all as dialect
from rich.console import Console

from flockd.cli.status import _table
from flockd.core.config import load_drone, load_scenario
from flockd.core.config.source import SourceParameters
from flockd.core.data import data_path
from flockd.core.messages import MissionOrder
from flockd.fleet.fleet_status import status_rows
from flockd.fleet.page.drone_rows import drone_rows, history_row
from flockd.fleet.ros.order_requests import Whereabouts, goal_of, velocity_of
from flockd.fleet.simulation import CONTROLS, MAX_GUST_M_S, MAX_SPEED, MIN_SPEED, SimulationMessage
from flockd.fleet.watcher import FleetWatcher
from flockd.onboard.autopilot.mavlink_messages import ReceivedMessages
from flockd.onboard.autopilot.mavsdk_link import RECEIVED
from flockd.onboard.daemon.operator_commands import OperatorCommands, OperatorRequests
from flockd.onboard.recording import foxglove
from flockd.onboard.recording.mcap_file import RecordingError
from flockd.onboard.recording.reader import decoded_image
from flockd.onboard.ros.cdr_images import RosImage, read_camera_info, read_compressed_image, read_image
from flockd.onboard.ros.message_trees import Names
from flockd.onboard.sources.image_formats import CorruptImageError, MjpegFormat, PackedFormat
from flockd.onboard.sources.ros_device import ENCODINGS
from flockd.onboard.sources.shared_memory import SharedMemorySource
from flockd.onboard.telemetry.order_messages import parse_order
from flockd.onboard.telemetry.schema import fault
from flockd.onboard.telemetry.topics import TOPICS
from flockd.sim.live_controls import LiveControls
from tools.checks.fuzzing.mutation import (
    ABSURD_NUMBERS,
    ABSURD_TEXTS,
    absurd,
    any_float,
    mutated_bytes,
    mutated_json,
    nested,
)
from tools.checks.fuzzing.target import CORPUS, Check, Target, assert_readable

COMMANDS = ("hold", "land", "goto", "velocity", "resume", "HOLD", "hold ", "hold/land", "__init__")
NAMES = ("drone1", "front", "\x1b[2J", "é", " ", "a" * 300)

# ------------------------------------------------------------------------------------------------------------ MAVLink


def _mavlink(folder: Path) -> Check:
    kinds = {name: _fields(name) for name in RECEIVED}

    def check(random: Random) -> None:
        said: list[str] = []
        received = ReceivedMessages(said.append)
        now_s = random.uniform(0.0, 1e5)
        for _ in range(random.randrange(1, 30)):
            now_s += random.choice((0.0, 0.02, 1.0, 3.0))
            name = random.choice(RECEIVED)
            received.add(name, {field: _value(random, kind) for field, kind in kinds[name].items()}, now_s)
            received.check_events.missing(now_s)
            if random.random() < 0.3:  # replies of TIMESYNC, whose times are whatever somebody sends
                for _ in range(random.choice((1, 6))):
                    received.clock.add(now_s, random.choice((now_s, now_s + 0.9, any_float(random))), now_s + 0.002)
            if random.random() < 0.1:
                received.add_other_heartbeat({"type": random.choice((2, 18, None, "18", 1e300))}, now_s)
        status, state = received.status(now_s), received.vehicle_state()
        for refusal in received.refusals(now_s, streams=random.random() < 0.5):
            assert_readable(refusal.sentence)
        assert status.battery_share is None or 0.0 <= status.battery_share <= 1.0, status.battery_share
        for vector in (status.position_ned, status.home_ned):
            assert vector is None or np.isfinite(vector).all()
        if state is not None:
            assert now_s - 60.0 <= state.time_s <= now_s, "a state of another time"
            R = state.R_ned_body
            assert np.allclose(R @ R.T, np.eye(3), atol=1e-6), "an attitude that is no rotation"
            assert math.isfinite(state.height_m)
        assert all(isinstance(count, int) for count in received.unknown_values().values())
        for sentence in said:
            assert_readable(sentence)

    return check


_NOT_IN_PYMAVLINK = {
    "EVENT": {
        "id": "uint32_t",
        "event_time_boot_ms": "uint32_t",
        "sequence": "uint16_t",
        "destination_component": "uint8_t",
        "destination_system": "uint8_t",
        "log_levels": "uint8_t",
        "arguments": "bytes",
    },
    "CURRENT_EVENT_SEQUENCE": {"sequence": "uint16_t", "flags": "uint8_t"},
}
"""MAVLink's EVENT, which pymavlink does not have."""


def _fields(name: str) -> dict[str, str]:
    if name in _NOT_IN_PYMAVLINK:
        return _NOT_IN_PYMAVLINK[name]
    kind = getattr(dialect, f"MAVLink_{name.lower()}_message")
    return dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))


def _value(random: Random, kind: str) -> Any:
    """What MAVSDK makes of a field of this type: any number that fits into it, NaN as null."""
    if kind == "char":
        return random.choice((*ABSURD_TEXTS, "low battery", "x" * 50)).replace("\0", "")[:50]
    if kind in ("float", "double"):
        number = any_float(random)
        return None if math.isnan(number) else max(min(number, 3.4e38), -3.4e38)
    if kind == "bytes":
        return random.choice(([random.randrange(256) for _ in range(random.choice((40, 40, 0, 3)))], None, [-1], ["a"]))
    bits, signed = int("".join(filter(str.isdigit, kind))), not kind.startswith("u")
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    return random.choice((0, 1, 2, 3, 4, 5, 6, 8, low, high, random.randint(low, high)))


# --------------------------------------------------------------------------------------------------------------- zenoh


def _example(kind: Any) -> Any:
    """A message of a topic's type."""
    origin, parts = get_origin(kind), get_args(kind)
    if is_typeddict(kind):
        return {name: _example(hint) for name, hint in get_type_hints(kind).items()}
    if origin is list:
        return [_example(parts[0])] * 3
    if origin is dict:
        return {"front": _example(parts[1])}
    if parts:
        return _example(next((part for part in parts if part is not type(None)), float))
    return {float: 1.0, int: 3, bool: True, str: "normal"}.get(kind, "normal")


def _sample(key: str, payload: bytes, attachment: bytes | None = None) -> Any:
    """What zenoh hands over, as far as flockd looks."""
    return SimpleNamespace(
        key_expr=key,
        payload=SimpleNamespace(to_bytes=lambda: payload, as_shm=lambda: payload),
        attachment=None if attachment is None else SimpleNamespace(to_bytes=lambda: attachment),
    )


def _status(folder: Path) -> Check:
    examples = {name: _example(topic.type) for name, topic in TOPICS.items()}
    now_s = [1000.0]
    watcher = FleetWatcher(None, listen=(), connect=(), clock=lambda: now_s[0])  # connected to nobody

    def check(random: Random) -> None:
        watcher._drones.clear()
        for _ in range(random.randrange(1, 12)):
            topic = random.choice(list(examples))
            message = mutated_json(random, examples[topic]) if random.random() < 0.9 else absurd(random)
            payload = json.dumps(message).encode("utf-8", "surrogatepass")
            if random.random() < 0.1:
                payload = random.choice((mutated_bytes(random, payload), nested(random), b"9" * 10_000))
            key = f"flockd/v1/{random.choice(NAMES)}/{random.choice(NAMES)}/{topic}"
            watcher._take_message(_sample(key, payload))
            now_s[0] += random.choice((0.0, 0.1))
        rows = status_rows(watcher.drones(), now_s[0] + random.choice((0.0, 1.0, 100.0)))
        json.dumps(rows, allow_nan=False)
        page = drone_rows(watcher.drones(), {}, now_s[0])
        history = [history_row(row, now_s[0]) for row in page.values()]
        json.dumps([page, history], allow_nan=False, ensure_ascii=False).encode()
        screen = io.StringIO()
        Console(file=screen, markup=False, highlight=False, width=1000).print(_table(rows))
        assert not {char for char in screen.getvalue() if char != "\n" and not char.isprintable()}

    return check


class _Missions:
    """Takes every order that it is given: what is wrong in itself is not to get here."""

    def __init__(self) -> None:
        self.orders: list[MissionOrder] = []

    def fault(self, order: MissionOrder) -> None:
        """None is refused."""
        values = (order.place, order.place_deg, order.velocity, order.height_m, order.speed_m_s)
        numbers = [np.atleast_1d(value) for value in values if value is not None]
        assert np.isfinite(np.concatenate(numbers)).all(), f"{order} is not finite"

    def apply(self, order: MissionOrder) -> None:
        """Keeps it."""
        self.orders.append(order)


def _commands(folder: Path) -> Check:
    loop = asyncio.new_event_loop()
    allowed = ("hold", "land", "goto", "velocity")
    orders = ({"north_m": 3.0, "east_m": 1.0, "speed_m_s": 1.0}, {"velocity_ne": [1.0, 0.5], "height_m": 4.0})
    ask = {"identity": "d", "operator": "a", "session": "s", "sequence": 1, "time_s": 7.0}
    seeds = [json.dumps({**ask, "order": order}).encode() for order in orders]

    def check(random: Random) -> None:
        said: list[str] = []
        requests, missions = OperatorRequests(), _Missions()
        command = random.choice((*ABSURD_TEXTS, *NAMES, *COMMANDS, *allowed))
        if random.random() < 0.5:
            command = mutated_bytes(random, command.encode("utf-8", "replace")).decode("utf-8", "replace")
        payload = random.choice(seeds)
        if random.random() < 0.7:
            payload = mutated_bytes(random, payload)
        commands = OperatorCommands(allowed, requests, missions, loop, said.append, identity="d", clock=lambda: 8.0)
        reply = commands.handle(command, payload)
        loop.call_soon(loop.stop)
        loop.run_forever()
        assert command in allowed or not reply["accepted"]
        assert len(missions.orders) == (reply["accepted"] and command in ("goto", "velocity"))
        taken = command if reply["accepted"] else ""
        assert (requests.hold, requests.land, requests.resume) == (taken == "hold", taken == "land", False)
        for sentence in (*said, reply["sentence"]):
            assert_readable(sentence)

    return check


def _simulation(folder: Path) -> Check:
    """Controls of a simulation that is flown live: refused, or values within their bounds."""
    scenario = load_scenario(data_path("config") / "paper_flight.yaml")
    values = (None, {"factor": 2.0}, {"gust_m_s": 0.5}, {"drone": "drone1", "camera": "front", "works": False})

    def check(random: Random) -> None:
        controls = LiveControls(scenario, "s", by_sight=False)
        control, value = random.choice((*ABSURD_TEXTS, *CONTROLS)), random.choice(values)
        ask = {"identity": "s", "operator": "a", "session": "s", "sequence": 1, "time_s": time.monotonic()}
        payload = json.dumps({**ask, "order": mutated_json(random, value)}).encode()
        answer = controls.ask(control, mutated_bytes(random, payload) if random.random() < 0.5 else payload)
        assert_readable(answer["sentence"])
        assert control in CONTROLS or not answer["accepted"]
        state = controls.state()
        assert fault(json.loads(json.dumps(state, allow_nan=False)), SimulationMessage) is None
        assert MIN_SPEED <= state["speed"] <= MAX_SPEED
        assert 0.0 <= state["gust_m_s"] <= MAX_GUST_M_S

    return check


# -------------------------------------------------------------------------------------------------------------- frames


def _frames(folder: Path) -> Check:
    config = load_drone(CORPUS / "drone.yaml")
    size = config.rig.cameras[0].size_px
    photo = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
    jpeg, png = (cv2.imencode(kind, photo)[1].tobytes() for kind in (".jpg", ".png"))
    yuyv = photo[..., :2].tobytes()
    recorded = foxglove.image(0, "front", png, "png")

    def check(random: Random) -> None:
        which = random.random()
        if which < 0.5:
            _shared_memory(random, config, photo)
        elif which < 0.75:
            with_format = random.choice(((MjpegFormat(size), jpeg), (PackedFormat("YUY2", size, 2 * size[0]), yuyv)))
            try:
                image = with_format[0].decode(mutated_bytes(random, with_format[1]))
            except CorruptImageError as error:
                assert_readable(str(error))
            else:
                assert image.shape == photo.shape
        else:
            try:
                decoded_image(mutated_bytes(random, recorded))
            except (ValueError, RecordingError) as error:
                assert_readable(str(error))

    return check


def _shared_memory(random: Random, config: Any, photo: Any) -> None:
    """A few frames from a program that has gone mad, then good ones, which have to come through."""
    now_s = [1000.0]
    sizes = {camera.name: camera.size_px for camera in config.rig.cameras}
    source = SharedMemorySource(sizes, SourceParameters(kind="shared_memory"), lambda: now_s[0])
    good = photo.tobytes()
    for number in range(random.randrange(1, 8)):
        now_s[0] += 0.05
        header = struct.pack("<4sHHQd", b"rgb8", *photo.shape[1::-1], number, now_s[0])
        match random.randrange(4):
            case 0:
                header = mutated_bytes(random, header)
            case 1:
                time_s = float(random.choice([one for one in ABSURD_NUMBERS if not 1e300 < abs(one) < math.inf]))
                header = struct.pack("<4sHHQd", b"rgb8", *photo.shape[1::-1], number, time_s)
            case 2:
                header = struct.pack("<4sHHQd", b"rgb8", *photo.shape[1::-1], number, now_s[0] + any_float(random))
        payload = mutated_bytes(random, good) if random.random() < 0.3 else good
        source._receive("front", _sample("frames", payload, random.choice((header, header, None))))
        found = source.newest(0.0)
        assert found is None or found.time_s <= now_s[0] + 0.03, "a frame of the future"
        source.status()
    for number in range(2):
        now_s[0] += 6.0  # past whatever stamp the clock's tolerance let in
        fresh = np.roll(photo, number + 1, axis=0)
        header = struct.pack("<4sHHQd", b"rgb8", *photo.shape[1::-1], 1000 + number, now_s[0])
        source._receive("front", _sample("frames", fresh.tobytes(), header))
        found = source.newest(0.0)
        assert found is not None, "good frames do not come through any more"
        assert found.frames["front"].image.shape == photo.shape


def _ros(folder: Path) -> Check:
    """Images and lenses of ROS 2's topics, as they travel, and orders from there."""
    head = b"\0\1\0\0" + struct.pack("<iII2s2x", 1_700_000_000, 5, 2, b"f")
    pixels = bytes(range(64)) * 3
    samples = (
        head + struct.pack("<III5sB2xII", 8, 8, 5, b"rgb8", 0, 24, len(pixels)) + pixels,
        head + struct.pack("<I5s3xI", 5, b"jpeg", len(pixels)) + pixels,
        head + struct.pack("<III10s2xI", 8, 8, 10, b"plumb_bob", 0) + struct.pack("<4x9d", *range(9)),
    )
    drone = Whereabouts(Names("drone1"), np.zeros(2), np.zeros(2), np.eye(3))

    def check(random: Random) -> None:
        data = random.choice(samples)
        if random.random() < 0.9:
            data = mutated_bytes(random, data)
        for read in (read_image, read_compressed_image, read_camera_info):
            with suppress(ValueError):
                found = read(data)
                if isinstance(found, RosImage) and found.size == (8, 8) and found.encoding in ENCODINGS:
                    PackedFormat(ENCODINGS[found.encoding], (8, 8), found.bytes_per_line).decode(found.data)
        x, y, z = (any_float(random) for _ in range(3))
        frame = random.choice(("map", "drone1/odom", "drone1/base_link", "", "\0"))
        place = {"header": {"frame_id": frame}, "pose": {"position": {"x": x, "y": y, "z": z}}}
        motion = {"linear": {"x": x, "y": y, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": random.choice((0.0, z))}}
        for make, message in ((goal_of, place), (velocity_of, {"header": {"frame_id": frame}, "twist": motion})):
            try:
                parse_order("goto" if make is goal_of else "velocity", {**make(message, drone)})
            except ValueError as error:
                assert_readable(str(error))

    return check


TARGETS = (
    Target("mavlink", 600, _mavlink),
    Target("status", 40, _status),
    Target("commands", 200, _commands),
    Target("simulation", 200, _simulation),
    Target("frames", 400, _frames),
    Target("ros", 400, _ros),
)
