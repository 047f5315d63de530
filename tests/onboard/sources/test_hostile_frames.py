"""Frames from other programs, cameras and ROS 2 that are not what they should be."""

from __future__ import annotations

import math
import struct
from random import Random
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from flockd.core.config import load_drone
from flockd.core.config.source import SourceParameters
from flockd.fleet.ros.message_trees import Names
from flockd.fleet.ros.ros_orders import goal_of, velocity_of
from flockd.onboard.recording import foxglove
from flockd.onboard.recording.mcap_file import RecordingError
from flockd.onboard.recording.reader import decoded_image
from flockd.onboard.sources.image_formats import CorruptImageError, MjpegFormat, PackedFormat
from flockd.onboard.sources.shared_memory import SharedMemorySource
from flockd.onboard.telemetry.order_messages import parse_order
from flockd.onboard.telemetry.topics import AboutMessage
from tests.hostile import ABSURD_NUMBERS, CORPUS, any_float, assert_readable, hostile, mutated_bytes

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers near the largest overflow


def _sample(key: str, payload: bytes, attachment: bytes | None = None) -> Any:
    """What zenoh hands over, as far as flockd looks."""
    return SimpleNamespace(
        key_expr=key,
        payload=SimpleNamespace(to_bytes=lambda: payload, as_shm=lambda: payload),
        attachment=None if attachment is None else SimpleNamespace(to_bytes=lambda: attachment),
    )


def test_good_frames_come_through_after_whatever_was_sent() -> None:
    config = load_drone(CORPUS / "drone.yaml")
    size = config.rig.cameras[0].size_px
    photo = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
    jpeg, png = (cv2.imencode(kind, photo)[1].tobytes() for kind in (".jpg", ".png"))
    yuyv = photo[..., :2].tobytes()
    recorded = foxglove.image(0, "front", png, "png")

    @hostile(300)
    def check(random: Random) -> None:
        which = random.random()
        if which < 0.5:
            _shared_memory(random, config, photo)
        elif which < 0.75:
            with_format = random.choice(((MjpegFormat(size), jpeg), (PackedFormat("YUY2", size, 2 * size[0]), yuyv)))
            try:
                image = with_format[0].pixels(mutated_bytes(random, with_format[1]))
            except CorruptImageError as error:
                assert_readable(str(error))
            else:
                assert image.shape == photo.shape
        else:
            try:
                decoded_image(mutated_bytes(random, recorded))
            except (ValueError, RecordingError) as error:
                assert_readable(str(error))

    check()


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


def test_an_order_of_ros_is_taken_or_refused() -> None:
    names, row = Names("drone1"), {"home_ne": [0.0, 0.0], "yaw_deg": 30.0}
    about = AboutMessage(version="1", configuration={"mission": {"origin_m": [0.0, 0.0]}}, commands=[])

    @hostile(150)
    def check(random: Random) -> None:
        x, y, z = (any_float(random) for _ in range(3))
        frame = random.choice(("map", "drone1/odom", "drone1/base_link", "", "\0"))
        message = SimpleNamespace(
            header=SimpleNamespace(frame_id=frame),
            pose=SimpleNamespace(position=SimpleNamespace(x=x, y=y, z=z)),
            twist=SimpleNamespace(
                linear=SimpleNamespace(x=x, y=y, z=0.0),
                angular=SimpleNamespace(x=0.0, y=0.0, z=random.choice((0.0, z))),
            ),
        )
        for command, make in (("goto", goal_of), ("velocity", velocity_of)):
            try:
                parse_order(command, {**make(message, names, row, about)})
            except ValueError as error:
                assert_readable(str(error))

    check()
