"""Cameras that are plugged in, unplugged, disturbed and in use elsewhere; the kernel is a fake."""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import termios
import time
from typing import Any

import numpy as np
import pytest

from flockd.core.config.source import CameraDeviceParameters, ControlParameters
from flockd.onboard.sources import v4l2_kernel
from flockd.onboard.sources.device_source import Devices
from flockd.onboard.sources.v4l2_kernel import Kernel
from tests.calm import until
from tests.onboard.sources.camera_images import SIZE, jpeg, scene, yuyv
from tests.onboard.sources.fake_kernel import (
    FLAG_CLOCK_UNKNOWN,
    FLAG_ERROR,
    FLAG_MONOTONIC,
    GAIN,
    METADATA_CAPTURE,
    STREAMING,
    FakeCamera,
    FakeControl,
    FakeKernel,
    Request,
)
from tests.onboard.sources.watched import WAIT_S, Watch

JPEGS = [jpeg(scene(number)) for number in range(8)]


def _controls(**values: int) -> tuple[ControlParameters, ...]:
    return tuple(ControlParameters(name=name, value=value) for name, value in values.items())


BY_HAND = _controls(auto_exposure=1, exposure_time_absolute=50, gain=32)


@pytest.fixture
def start(watch: Watch) -> Watch:
    """Starts a source of the given cameras; each camera's device is /dev/ and its name."""

    def begin(kernel: Kernel, *cameras: CameraDeviceParameters, size: tuple[int, int] = SIZE, **more: Any) -> Any:
        return watch({camera.name: size for camera in cameras}, cameras, Devices(kernel), **more)

    return begin


def _camera(name: str = "front", **changes: object) -> CameraDeviceParameters:
    return CameraDeviceParameters.model_validate({"name": name, "device": f"/dev/{name}", **changes})


def test_the_structures_are_those_of_the_header() -> None:
    """Sizes and numbers as a C compiler gives them for linux/videodev2.h on 64-bit machines."""
    sizes = {
        v4l2_kernel.Capability: 104,
        v4l2_kernel.Format: 208,
        v4l2_kernel.StreamParameters: 204,
        v4l2_kernel.RequestBuffers: 20,
        v4l2_kernel.Buffer: 88,
        v4l2_kernel.QueryControl: 68,
        v4l2_kernel.Control: 8,
        v4l2_kernel.FormatDescription: 64,
        v4l2_kernel.FrameSize: 44,
        v4l2_kernel.FrameInterval: 52,
    }
    for structure, size in sizes.items():
        assert ctypes.sizeof(structure) == size, structure
    for request in Request:
        assert getattr(v4l2_kernel, f"VIDIOC_{request.name}") == request
    offsets = {
        "seconds": 24,
        "timecode": 40,
        "sequence": 56,
        "memory": 60,
        "offset": 64,
        "length": 72,
        "request_fd": 80,
    }
    assert {name: getattr(v4l2_kernel.Buffer, name).offset for name in offsets} == offsets


def test_two_cameras_become_one_set_with_the_kernels_times_and_numbers(start: Watch) -> None:
    kernel = FakeKernel(front=FakeCamera(), back=FakeCamera())
    source = start(kernel, _camera("front"), _camera("back"))
    stamps = {"front": kernel.send("front", JPEGS[0]), "back": kernel.send("back", JPEGS[1])}
    source.received(front=1, back=1)
    frames = source.next()

    assert frames.frames.keys() == {"front", "back"}
    assert frames.time_s == pytest.approx(stamps["back"], abs=2e-6)
    for number, (name, stamp) in enumerate(stamps.items()):
        frame = frames.frames[name]
        assert (frame.camera, frame.sequence) == (name, 0)
        assert frame.time_s == pytest.approx(stamp, abs=2e-6), "microseconds, as the kernel gives them"
        assert np.abs(frame.image.astype(int) - scene(number)).mean() < 3.0
        status = source.status()[name]
        assert status.fault is None
        assert 0.0 < status.age_s < WAIT_S
        assert status.counts == {"received": 1, "used": 1, "opened": 1}
    assert source.newest() is None, "no frame is handed out twice"


def test_the_driver_is_asked_for_what_the_configuration_says_in_its_order(start: Watch) -> None:
    kernel = FakeKernel(front=FakeCamera())
    source = start(kernel, _camera(pixel_format="mjpeg", rate_hz=15.0, controls=BY_HAND))
    kernel.send("front", JPEGS[0])
    source.next()
    assert kernel.cameras["/dev/front"].settings == [
        ("format", (640, 480, b"MJPG")),
        ("rate", 15.0),
        ("Auto Exposure", 1),
        ("Exposure Time, Absolute", 50),
        ("Gain", 32),
    ]


@pytest.mark.parametrize(("turn_deg", "red"), [(90, np.s_[:320]), (270, np.s_[320:]), (180, np.s_[:, 320:])])
def test_a_camera_on_its_side_gives_images_in_which_up_is_up(
    start: Watch, turn_deg: int, red: tuple[slice, ...]
) -> None:
    """A clockwise quarter of a turn brings the left, which is red, to the top."""
    kernel = FakeKernel(front=FakeCamera())
    source = start(kernel, _camera(turn_deg=turn_deg), size=SIZE if turn_deg == 180 else SIZE[::-1])
    kernel.send("front", JPEGS[0])
    image = source.next().frames["front"].image
    assert kernel.cameras["/dev/front"].settings[0] == ("format", (*SIZE, b"MJPG")), "as the sensor has it"
    assert image.shape == ((480, 640, 3) if turn_deg == 180 else (640, 480, 3))
    is_red = image[..., 0].astype(int) > image[..., 2]
    assert is_red[red].mean() > 0.98
    assert is_red.mean() == pytest.approx(0.5, abs=0.02)


def test_a_larger_image_is_reduced_to_the_rigs_size(start: Watch) -> None:
    """The camera is asked for 640 x 480, the rig has a quarter of the pixels: the mean of four, with half the noise."""
    kernel = FakeKernel(front=FakeCamera())
    source = start(kernel, _camera(reduce=2), size=(320, 240))
    noise = np.random.default_rng(5).normal(0.0, 8.0, (*SIZE[::-1], 1))
    grey = np.repeat(np.clip(128.0 + noise, 0, 255), 3, axis=2).astype(np.uint8)
    kernel.send("front", jpeg(grey))
    image = source.next().frames["front"].image
    assert kernel.cameras["/dev/front"].settings[0] == ("format", (*SIZE, b"MJPG"))
    assert image.shape == (240, 320, 3)
    assert image[..., 1].std() == pytest.approx(grey[..., 1].std() / 2, rel=0.15)


def test_uncompressed_images_may_have_padded_rows(start: Watch) -> None:
    kernel = FakeKernel(front=FakeCamera(padding=64))
    source = start(kernel, _camera(pixel_format="yuyv"))
    kernel.send("front", yuyv([(81, 90, 240), (41, 240, 110)], SIZE, padding=64))
    image = source.next().frames["front"].image
    np.testing.assert_allclose(image[:, 10:300].mean((0, 1)), (255, 0, 0), atol=2)
    np.testing.assert_allclose(image[:, 340:630].mean((0, 1)), (0, 0, 255), atol=2)


@pytest.mark.fault("damaged-images")
@pytest.mark.parametrize(
    ("data", "flags", "offset_s", "count"),
    [
        (JPEGS[1], FLAG_MONOTONIC | FLAG_ERROR, 0.0, "flagged"),
        (JPEGS[1][:20_000], FLAG_MONOTONIC, 0.0, "corrupt"),
        (b"", FLAG_MONOTONIC, 0.0, "corrupt"),
        (jpeg(scene()[::2, ::2]), FLAG_MONOTONIC, 0.0, "corrupt"),
        (JPEGS[1], FLAG_CLOCK_UNKNOWN, 1.7e9, "time_stamp"),
        (JPEGS[1], FLAG_MONOTONIC, 5.0, "time_stamp"),
        (JPEGS[1], FLAG_MONOTONIC, 1.7e9, "time_stamp"),
        (JPEGS[1], FLAG_MONOTONIC, -100.0, "time_stamp"),
    ],
    ids=["error flag", "truncated", "empty", "other size", "unknown clock", "ahead", "wall clock", "long ago"],
)
def test_what_is_worth_nothing_is_dropped_and_counted_and_the_next_is_fine(
    start: Watch, data: bytes, flags: int, offset_s: float, count: str
) -> None:
    kernel = FakeKernel(front=FakeCamera())
    source = start(kernel, _camera())
    kernel.send("front", JPEGS[0])
    assert source.next().frames["front"].sequence == 0
    kernel.send("front", data, flags=flags, time_s=time.monotonic() + offset_s)
    source.received(front=2)
    assert source.newest(0.05) is None
    kernel.send("front", JPEGS[2])
    assert source.next().frames["front"].sequence == 2
    counts = dict(source.status()["front"].counts)
    assert counts.pop("lost", 0) in {0, 1}
    assert counts == {"received": 3, "used": 2, "opened": 1, count: 1}


def test_a_camera_whose_images_show_nothing_has_a_fault_until_one_shows_something(start: Watch) -> None:
    kernel = FakeKernel(front=FakeCamera(), back=FakeCamera())
    source = start(kernel, _camera("front"), _camera("back"))
    plain = [jpeg(np.full_like(scene(), level)) for level in (60, 61, 62)]
    for number, data in enumerate([*plain, JPEGS[0]]):
        kernel.send("front", data)
        kernel.send("back", JPEGS[number + 1])
        source.received(front=number + 1, back=number + 1)
        fault = source.status()["front"].fault
        assert fault == (None if number < 3 else "front: its images show nothing; check its lens and cable")
        assert source.next().frames.keys() == ({"back"} if number < 3 else {"front", "back"})
    assert source.status()["front"].fault is None
    assert source.status()["front"].counts["undecodable"] == 3


@pytest.mark.fault("camera-unplugged")
def test_an_unplugged_camera_is_reported_at_once_and_comes_back_when_plugged_in(start: Watch) -> None:
    kernel = FakeKernel(front=FakeCamera(), back=FakeCamera())
    source = start(kernel, _camera("front", controls=BY_HAND), _camera("back"))
    kernel.send("front", JPEGS[0])
    kernel.send("back", JPEGS[1])
    source.received(front=1, back=1)
    assert source.next().frames.keys() == {"front", "back"}

    kernel.unplug("front")
    fault = source.why()
    assert fault.startswith("front: /dev/front is not there; ")

    kernel.send("back", JPEGS[2])
    assert source.next().frames.keys() == {"back"}, "the others go on"
    assert source.status()["front"].counts["missing"] == 1

    kernel.plug("front")
    kernel.send("front", JPEGS[0])
    kernel.send("front", JPEGS[3])
    kernel.send("back", JPEGS[4])
    source.received(front=3, back=3)
    assert source.next().frames.keys() == {"front", "back"}
    status = source.status()["front"]
    assert status.fault is None
    assert status.counts["opened"] == 2
    assert status.counts.get("lost", 0) == 0, "a camera that begins anew has lost nothing"
    assert kernel.cameras["/dev/front"].settings.count(("Gain", 32)) == 2, "it is set up again"


def test_a_silent_camera_is_noticed_and_opened_again(start: Watch) -> None:
    kernel = FakeKernel(front=FakeCamera())
    source = start(kernel, _camera(), silence_s=0.2)
    kernel.send("front", JPEGS[0])
    source.next()
    status = source.until(lambda status: status.fault is not None)
    assert str(status.fault).startswith("front: /dev/front gave no usable image for 0.2 s")
    kernel.send("front", JPEGS[0])  # as v4l2loopback does: the last picture of before, stamped as of now
    source.received(front=2)
    assert source.newest(0.05) is None
    assert source.status()["front"].fault is not None
    kernel.send("front", JPEGS[1])
    assert source.next().frames["front"].sequence == 1
    assert source.status()["front"].counts["opened"] == 2


@pytest.mark.fault("frozen-frames")
def test_a_frozen_camera_counts_as_silent(start: Watch) -> None:
    kernel = FakeKernel(front=FakeCamera())
    source = start(kernel, _camera(), silence_s=0.2)
    used = 0
    for _ in range(5 + 4):
        kernel.send("front", JPEGS[0])
        used += source.newest(0.05) is not None
    assert used == 5, "the picture and four repetitions; the fifth is one too many"
    counts = source.status()["front"].counts
    assert counts["frozen"] == 4
    source.until(lambda status: "0.2 s (the last was refused: frozen)" in str(status.fault))
    kernel.send("front", JPEGS[0])
    kernel.send("front", JPEGS[1])
    source.next()
    assert source.status()["front"].fault is None


def test_a_camera_that_another_program_uses_is_reported_and_taken_when_it_is_free(start: Watch) -> None:
    kernel = FakeKernel(front=FakeCamera(owner=1))
    source = start(kernel, _camera())
    status = source.until(lambda status: status.fault is not None)
    assert "/dev/front is in use" in str(status.fault)
    assert status.age_s == float("inf")
    kernel.cameras["/dev/front"].owner = None
    kernel.send("front", JPEGS[0])
    source.next()
    assert source.status()["front"].fault is None


def test_an_error_of_the_stream_closes_the_camera_and_opens_it_again(start: Watch) -> None:
    kernel = FakeKernel(front=FakeCamera())
    source = start(kernel, _camera())
    kernel.send("front", JPEGS[0])
    source.next()
    kernel.fail("front", errno.EIO)
    status = source.until(lambda status: status.fault is not None)
    assert "/dev/front has failed (Input/output error)" in str(status.fault)
    kernel.fail("front", 0)
    kernel.send("front", JPEGS[0])
    kernel.send("front", JPEGS[1])
    source.next()


ONE_GAIN = {GAIN: FakeControl(b"Gain", 0, 255, 64, step=16)}


@pytest.mark.parametrize(
    ("camera", "asked", "told"),
    [
        (FakeCamera(formats=((1280, 720, b"MJPG"),)), {}, "offers 1280x720 MJPG instead of 640x480 mjpeg; choose from"),
        (FakeCamera(formats=((640, 480, b"MJPG"),)), {"reduce": 2}, "or write a smaller reduce than 2"),
        (FakeCamera(), {"rate_hz": 60.0}, "runs at 30 instead of 60 images a second; write rate_hz: 30"),
        (FakeCamera(capabilities=METADATA_CAPTURE | STREAMING), {}, "does not capture images; many cameras have a"),
        (FakeCamera(), {"controls": _controls(iris=1)}, "has no control 'iris'; it has auto_exposure, exposure_time_"),
        (FakeCamera(), {"controls": _controls(gain=300)}, "takes gain from 0 to 255, not 300"),
        (FakeCamera(), {"controls": BY_HAND[1:]}, "cannot set exposure_time_absolute to 50 (Permission denied)"),
        (FakeCamera(controls=ONE_GAIN), {"controls": _controls(gain=40)}, "sets gain to 32 instead of 40; write"),
    ],
    ids=["size", "size to reduce", "rate", "metadata", "no such control", "range", "automatic on", "step"],
)
def test_what_the_camera_cannot_do_is_said_in_one_sentence(
    start: Watch, camera: FakeCamera, asked: dict[str, Any], told: str
) -> None:
    fault = start(FakeKernel(front=camera), _camera("front", **asked)).why()
    assert fault.startswith("front: /dev/front ")
    assert told in fault


def test_openings_become_rarer_while_nothing_is_there(start: Watch) -> None:
    kernel = FakeKernel()
    attempts: list[float] = []
    missing = kernel.open

    def counted(path: str) -> int:
        attempts.append(time.monotonic())
        return missing(path)

    kernel.open = counted  # type: ignore[method-assign]
    start(kernel, _camera())
    until(lambda: len(attempts) >= 4, WAIT_S)
    pauses_s = np.diff(attempts[:4])
    assert (pauses_s >= [0.1, 0.2, 0.4]).all(), "at 0, 0.1, 0.3 and 0.7 s, or later"


def test_stopping_gives_the_devices_back_and_waits_for_nothing(start: Watch) -> None:
    kernel = FakeKernel(front=FakeCamera(), back=FakeCamera(), left=FakeCamera(plugged=False))
    source = start(kernel, _camera("front"), _camera("back"), _camera("left"))
    kernel.send("front", JPEGS[0])
    kernel.send("back", JPEGS[0])
    source.stop()
    assert not kernel.open_files
    assert kernel.cameras["/dev/front"].owner is None
    assert source.newest(3600.0) is None, "who waits for frames is let go"


def test_the_real_system_calls_write_into_the_structures_they_are_given() -> None:
    """Without a camera: a pipe tells how many bytes wait in it (FIONREAD), and when; a file is mapped."""
    kernel = Kernel()
    reading, writing = os.pipe()
    try:
        assert not kernel.wait(reading, 0.0)
        os.write(writing, b"12345")
        assert kernel.wait(reading, 0.0)
        waiting = ctypes.c_int(0)
        kernel.ioctl(reading, termios.FIONREAD, waiting)
        assert waiting.value == 5
    finally:
        kernel.close(reading)
        kernel.close(writing)
    file = os.memfd_create("buffer")
    os.write(file, bytes(mmap.PAGESIZE) + b"the second page")
    os.ftruncate(file, 2 * mmap.PAGESIZE)
    memory = kernel.map(file, mmap.PAGESIZE, mmap.PAGESIZE)
    kernel.close(file)
    assert memory[slice(0, 15)] == b"the second page"
    memory.close()


def test_what_is_no_camera_is_reported_by_the_real_kernel(start: Watch) -> None:
    camera = CameraDeviceParameters(name="front", device="/dev/null")
    source = start(Kernel(), camera)
    sentence = "front: /dev/null is not a V4L2 camera (Inappropriate ioctl for device)"
    assert source.why() == sentence
