"""Cameras of ROS 2: what topics carry becomes frames with the checks of every camera. Messages are of `rosbags`."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from flockd.core.config.rig import IntrinsicsConfig
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.core.messages import FrameSet
from flockd.onboard.ros.ros_input import read_camera_info, read_compressed_image, read_image
from flockd.onboard.sources import CameraStatus, ros_child
from flockd.onboard.sources.device_source import Devices, DeviceSource
from flockd.onboard.sources.ros_device import info_topic_of
from tests.onboard.sources.fake_topics import __file__ as fake

STORE = get_typestore(Stores.ROS2_JAZZY)
SIZE = (64, 48)
LENS = IntrinsicsConfig(fx=50.0, fy=50.0, cx=32.0, cy=24.0)
RGB = np.random.default_rng(1).integers(0, 256, (48, 64, 3), dtype=np.uint8)
STAMP_NS = 1_700_000_000_123_456_789


def kind(name: str) -> Any:
    return STORE.types[name]


def header() -> Any:
    stamp = kind("builtin_interfaces/msg/Time")(sec=1_700_000_000, nanosec=123_456_789)
    return kind("std_msgs/msg/Header")(stamp=stamp, frame_id="front_optical")


def image(encoding: str = "rgb8", pixels: Any = RGB, *, width: int = 64, step: int | None = None) -> bytes:
    message = kind("sensor_msgs/msg/Image")(
        header=header(), height=48, width=width, encoding=encoding, is_bigendian=0,
        step=step or pixels.nbytes // 48, data=np.frombuffer(pixels.tobytes(), np.uint8),
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/Image"))


def compressed(form: str, data: bytes) -> bytes:
    message = kind("sensor_msgs/msg/CompressedImage")(header=header(), format=form, data=np.frombuffer(data, np.uint8))
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/CompressedImage"))


def info(fx: float = 50.0, cx: float = 31.5, size: tuple[int, int] = SIZE) -> bytes:
    region = kind("sensor_msgs/msg/RegionOfInterest")(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    matrix = np.array([fx, 0, cx, 0, fx, 23.5, 0, 0, 1], np.float64)
    message = kind("sensor_msgs/msg/CameraInfo")(
        header=header(), height=size[1], width=size[0], distortion_model="plumb_bob", d=np.array([0.1, 0.2]),
        k=matrix, r=np.eye(3).ravel(), p=np.zeros(12), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/CameraInfo"))


def test_messages_are_read_as_the_library_writes_them() -> None:
    found = read_image(image("bgr8", RGB))
    assert (found.stamp_ns, found.encoding, found.size, found.bytes_per_line) == (STAMP_NS, "bgr8", SIZE, 192)
    assert found.data == RGB.tobytes()
    small = read_compressed_image(compressed("jpeg", b"abc"))
    assert (small.stamp_ns, small.encoding, small.data) == (STAMP_NS, "jpeg", b"abc")
    lens = read_camera_info(info())
    assert (lens.size, lens.model, lens.distortion) == (SIZE, "plumb_bob", (0.1, 0.2))
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (50.0, 50.0, 31.5, 23.5)
    assert ros_child._stamp_ns(image()) == STAMP_NS


@pytest.mark.parametrize(
    ("read", "whole"),
    [(read_image, image()), (read_compressed_image, compressed("jpeg", b"abc" * 99)), (read_camera_info, info())],
)
def test_messages_that_are_cut_anywhere_are_refused(read: Callable[[bytes], object], whole: bytes) -> None:
    for length in range(0, 120, 7):
        with pytest.raises(ValueError, match=r"too early|no message"):
            read(whole[:length])


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/front/image_raw", "/front/camera_info"),
        ("/front/image_raw/compressed", "/front/camera_info"),
        ("/image", "/camera_info"),
    ],
)
def test_camera_info_stands_beside_the_images(topic: str, expected: str) -> None:
    assert info_topic_of(topic) == expected


Start = Callable[..., DeviceSource]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """A source of one camera whose topics bring these messages: kind, data, and how many ms ago it was taken."""
    started: list[DeviceSource] = []

    def begin(*messages: tuple[str, bytes] | tuple[str, bytes, int], silence_s: float = 30.0) -> DeviceSource:
        file = tmp_path / "messages"
        named = [dict(zip(("kind", "data", "ms"), (one[0], one[1].hex(), *one[2:]), strict=False)) for one in messages]
        file.write_text("\n".join(json.dumps(one) for one in named), encoding="ascii")
        camera = CameraDeviceParameters(name="front", topic="/front/image_raw", rate_hz=50.0)
        parameters = SourceParameters(kind="ros", cameras=(camera,), silence_s=silence_s, set_tolerance_s=5.0)
        devices = Devices(ros_command=(sys.executable, "-IS", fake, str(file)), lenses={"front": LENS})
        source = DeviceSource({"front": SIZE}, parameters, devices)
        started.append(source)
        source.start()
        return source

    yield begin
    for source in started:
        source.stop()


def until(source: DeviceSource, holds: Callable[[CameraStatus], object]) -> CameraStatus:
    end_s = time.monotonic() + 30.0
    while not holds(status := source.status()["front"]):
        assert time.monotonic() < end_s, status
        time.sleep(0.005)
    return status


def next_of(source: DeviceSource) -> FrameSet:
    frames = source.newest(30.0)
    assert frames is not None
    return frames


PADDED = np.pad(RGB.reshape(48, 192), ((0, 0), (0, 8)))


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("rgba8", np.dstack([RGB, RGB[..., 0]]), RGB),
        ("mono8", RGB[..., 0], RGB[..., [0, 0, 0]]),
        ("rgb8", PADDED, RGB),
    ],
)
def test_an_image_becomes_rgb_bit_by_bit(start: Start, encoding: str, pixels: Any, expected: Any) -> None:
    source = start(("info", info()), ("imag", image(encoding, pixels)))
    begun_s = time.monotonic()
    frames = next_of(source)
    assert np.array_equal(frames.frames["front"].image, expected)
    assert begun_s - 5.0 < frames.time_s <= time.monotonic()
    assert source.status()["front"].fault is None


def test_a_jpeg_is_decoded_as_that_of_any_camera(start: Start) -> None:
    smooth = cv2.GaussianBlur(RGB, (0, 0), 4)
    data = bytes(cv2.imencode(".jpg", smooth)[1])
    source = start(("jpeg", compressed("bgr8; jpeg compressed bgr8", data)))
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert expected is not None
    assert np.array_equal(next_of(source).frames["front"].image, expected)


def test_numbers_count_periods_so_that_what_is_missing_shows(start: Start) -> None:
    """At 50 Hz, taken 200, 180 and 100 ms ago: 1 and 4 periods on."""
    images = [image("rgb8", np.roll(RGB, shift)) for shift in range(3)]
    source = start(("imag", images[0], 200), ("imag", images[1], 180), ("imag", images[2], 100))
    status = until(source, lambda status: status.counts.get("received", 0) >= 3)
    assert status.counts["lost"] == 3


@pytest.mark.fault("damaged-images")
@pytest.mark.parametrize(
    ("message", "count"),
    [
        (("imag", image(), 60_000), "time_stamp"),
        (("imag", image("rgb8", RGB[:40], step=192)), "corrupt"),
        (("imag", image("rgb8", RGB[:24], step=96)), "corrupt"),
        (("jpeg", compressed("jpeg", b"\xff\xd8 nothing")), "corrupt"),
    ],
)
def test_what_is_worth_nothing_is_counted_and_the_next_is_fine(start: Start, message: Any, count: str) -> None:
    source = start(message, ("imag", image("rgb8", np.roll(RGB, 5))))
    next_of(source)
    assert source.status()["front"].counts.get(count) == 1  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (
            ("imag", image(width=32)),
            "/front/image_raw gives 32x48, but the rig has 64x48; correct size_px, or the driver",
        ),
        (("imag", image("bayer_rggb8")), "/front/image_raw has the encoding 'bayer_rggb8', and not one of rgb8, "),
        (("jpeg", compressed("png", b"x")), "/front/image_raw sends 'png'; let its transport send JPEG"),
        (("imag", b"\0\1\0\0abc"), "/front/image_raw sent what is no image (it ends too early)"),
        (("info", info(fx=80.0)), "/front/camera_info has fx 80.0, but the rig 50.0; correct one"),
        (("info", info(cx=10.0)), "/front/camera_info has cx 10.5, but the rig 32.0; correct one"),
        (("info", info(size=(32, 48))), "/front/camera_info is of 32x48, but the rig has 64x48; correct one"),
        (("fail", b"is of std_msgs/msg/String"), "is of std_msgs/msg/String; name a topic of Image or CompressedImage"),
        (("fail", b"there is no rclpy"), "front: there is no rclpy; source a ROS 2, or, with Python 3.11 on x86-64"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(start: Start, message: Any, sentence: str) -> None:
    source = start(message)
    assert sentence in str(until(source, lambda status: status.fault).fault)


def test_a_lens_that_nobody_calibrated_contradicts_nothing(start: Start) -> None:
    source = start(("info", info(fx=0.0, cx=0.0)), ("imag", image()))
    next_of(source)
    assert source.status()["front"].fault is None


@pytest.mark.fault("camera-unplugged")
def test_a_silent_topic_is_opened_again(start: Start) -> None:
    source = start(("imag", image()), silence_s=0.2)
    assert "/front/image_raw gave no usable image for 0.2 s" in str(until(source, lambda status: status.fault).fault)
    assert until(source, lambda status: status.counts.get("opened", 0) >= 2)


def test_a_simulators_clock_is_carried_over() -> None:
    """The least delay of the last half second counts; before the first reading there is no time."""
    clock = ros_child._Clock()
    assert clock.monotonic_ns(image(), simulated=True) == ros_child.NO_TIME
    now_ns = time.monotonic_ns()
    clock.take(b"\0\1\0\0" + ros_child._STAMP[1].pack(50, 0))
    time.sleep(0.02)
    clock.take(b"\0\1\0\0" + ros_child._STAMP[1].pack(50, 0))  # late by 20 ms
    stamp = b"\0\1\0\0" + ros_child._STAMP[1].pack(50, 5_000_000)
    taken_ns = clock.monotonic_ns(stamp, simulated=True)
    assert now_ns + 5_000_000 <= taken_ns < now_ns + 20_000_000
