"""Cameras of ROS 2: what topics carry becomes frames with the checks of every camera."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from flockd.core.config.rig import IntrinsicsConfig
from flockd.core.config.source import CameraDeviceParameters
from flockd.onboard.sources import camera_child
from flockd.onboard.sources.camera_child import body_of, packed
from flockd.onboard.sources.device_source import Devices
from flockd.onboard.sources.ros_device import info_topic_of
from tests.onboard.sources.test_gstreamer import FAKE
from tests.onboard.sources.watched import Watch

SIZE = (64, 48)
LENS = IntrinsicsConfig(fx=50.0, fy=50.0, cx=32.0, cy=24.0)
RGB = np.random.default_rng(1).integers(0, 256, (48, 64, 3), dtype=np.uint8)


def image(encoding: str = "rgb8", pixels: Any = RGB, *, width: int = 64, step: int | None = None) -> bytes:
    """An Image as the child writes it."""
    step = step or pixels.nbytes // 48
    return packed(SimpleNamespace(encoding=encoding, width=width, height=48, step=step, data=pixels.tobytes()))


def compressed(form: str, data: bytes) -> bytes:
    return packed(SimpleNamespace(format=form, data=data))


def info(fx: float = 50.0, cx: float = 31.5, size: tuple[int, int] = SIZE, d: tuple[float, ...] = ()) -> bytes:
    k = [fx, 0.0, cx, 0.0, fx, 23.5, 0.0, 0.0, 1.0]
    return body_of(SimpleNamespace(width=size[0], height=size[1], k=k, d=d, distortion_model="plumb_bob"))


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


@pytest.fixture
def start(watch: Watch, tmp_path: Path) -> Watch:
    """A source of one camera whose topics bring these messages: kind, data, and how many ms ago it was taken."""

    def begin(*messages: tuple[str, bytes] | tuple[str, bytes, int], **more: Any) -> Any:
        file = tmp_path / "messages"
        named = [dict(zip(("kind", "data", "ms"), (one[0], one[1].hex(), *one[2:]), strict=False)) for one in messages]
        file.write_text("\n".join(json.dumps(one) for one in named), encoding="ascii")
        camera = CameraDeviceParameters(name="front", topic="/front/image_raw", rate_hz=50.0)
        devices = Devices(ros_command=(*FAKE, str(file)), lenses={"front": LENS})
        return watch({"front": SIZE}, (camera,), devices, **more)

    return begin


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
def test_an_image_becomes_rgb_bit_by_bit(start: Watch, encoding: str, pixels: Any, expected: Any) -> None:
    source = start(("info", info()), ("imag", image(encoding, pixels)))
    begun_s = time.monotonic()
    frames = source.next()
    assert np.array_equal(frames.frames["front"].image, expected)
    assert begun_s - 5.0 < frames.time_s <= time.monotonic()
    assert source.status()["front"].fault is None


def test_a_jpeg_is_decoded_as_that_of_any_camera(start: Watch) -> None:
    smooth = cv2.GaussianBlur(RGB, (0, 0), 4)
    data = bytes(cv2.imencode(".jpg", smooth)[1])
    source = start(("jpeg", compressed("bgr8; jpeg compressed bgr8", data)))
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert expected is not None
    assert np.array_equal(source.next().frames["front"].image, expected)


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
def test_what_is_worth_nothing_is_counted_and_the_next_is_fine(start: Watch, message: Any, count: str) -> None:
    source = start(message, ("imag", image("rgb8", np.roll(RGB, 5))))
    source.next()
    assert source.status()["front"].counts.get(count) == 1  # type: ignore[call-overload]


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (("imag", image(width=32)), "/front/image_raw gives 32x48, but the rig has 64x48; correct size_px, or the"),
        (("imag", image("bayer_rggb8")), "/front/image_raw has the encoding 'bayer_rggb8', and not one of rgb8, "),
        (("jpeg", compressed("png", b"x")), "/front/image_raw sends 'png'; let its transport send JPEG"),
        (("info", info(fx=80.0)), "/front/camera_info has fx 80.0, but the rig 50.0; correct one"),
        (("info", info(cx=10.0)), "/front/camera_info has cx 10.5, but the rig 32.0; correct one"),
        (
            ("info", info(d=(-0.3, 0.1, 0.0, 0.0))),
            "/front/camera_info shows 73 degrees by its D, but the rig 65; correct",
        ),
        (("info", info(size=(32, 48))), "/front/camera_info is of 32x48, but the rig has 64x48; correct one"),
        (("fail", b"is of std_msgs/msg/String"), "is of std_msgs/msg/String; name a topic of Image or CompressedImage"),
        (("fail", b"there is no rclpy"), "front: there is no rclpy; source a ROS 2, or, with Python 3.11 on x86-64"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(start: Watch, message: Any, sentence: str) -> None:
    assert sentence in start(message).why()


def test_a_lens_that_nobody_calibrated_contradicts_nothing(start: Watch) -> None:
    source = start(("info", info(fx=0.0, cx=0.0)), ("imag", image()))
    source.next()
    assert source.status()["front"].fault is None


@pytest.mark.fault("camera-unplugged")
def test_a_silent_topic_is_opened_again(start: Watch) -> None:
    source = start(("imag", image()), silence_s=0.2)
    assert "/front/image_raw gave no usable image for 0.2 s" in source.why()
    assert source.until(lambda status: status.counts.get("opened", 0) >= 2)


def test_a_simulators_clock_is_carried_over() -> None:
    """The least delay of the last half second counts; before the first reading there is no time."""
    clock = camera_child._Clock()
    assert clock.monotonic_ns(0, simulated=True) == camera_child.NO_TIME
    now_ns = time.monotonic_ns()
    clock.take(50_000_000_000)
    time.sleep(0.02)
    clock.take(50_000_000_000)  # late by 20 ms
    taken_ns = clock.monotonic_ns(50_005_000_000, simulated=True)
    assert now_ns + 5_000_000 <= taken_ns < now_ns + 20_000_000
