"""Pipelines deliver, stall, freeze, end and crash; the process that runs them is a fake that speaks the same stream."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flockd.core.config.source import CameraDeviceParameters
from flockd.core.messages import UInt8Array
from flockd.onboard.sources.camera_child import HEADER, Buffer
from flockd.onboard.sources.child_device import CHILD
from flockd.onboard.sources.device_source import Devices
from flockd.onboard.sources.frames import CameraDevice, CameraError
from flockd.onboard.sources.gstreamer_device import GstreamerDevice, caps, format_of
from flockd.onboard.sources.image_formats import PACKED, CorruptImageError, MjpegFormat
from tests.onboard.sources.watched import Watch

FAKE = (sys.executable, "-IS", str(Path(__file__).with_name("fake_child.py")))
SIZE = (64, 48)
RATE_HZ = 50.0
CAMERA = CameraDeviceParameters(name="front", pipeline="any", rate_hz=RATE_HZ)


@pytest.fixture
def start(watch: Watch) -> Watch:
    """Starts a source of the given pipelines, called camera0 and so on."""

    def begin(*pipelines: str, devices: type[Devices] = Devices, **more: Any) -> Any:
        cameras = tuple(
            CameraDeviceParameters(name=f"camera{number}", pipeline=pipeline, rate_hz=RATE_HZ)
            for number, pipeline in enumerate(pipelines)
        )
        return watch({camera.name: SIZE for camera in cameras}, cameras, devices(command=FAKE), **more)

    return begin


def test_a_camera_whose_opening_fails_for_a_reason_nobody_expects_is_seen_to_fail(start: Watch) -> None:
    """Its thread ended with a traceback, and its status said nothing."""

    class Breaking(Devices):
        def open(self, camera: CameraDeviceParameters, size: tuple[int, int]) -> CameraDevice:
            if camera.name == "camera0":
                raise ValueError("embedded null byte")
            return super().open(camera, size)

    source = start("words", "caps:64x48 1000", devices=Breaking)
    failed = source.until(lambda status: status.fault is not None, "camera0")
    assert "camera0: cannot be run (ValueError: embedded null byte)" in str(failed.fault)
    source.until(lambda status: status.counts.get("received", 0) > 2, "camera1")


def test_images_come_with_the_times_of_their_buffers(start: Watch) -> None:
    begun_s = time.monotonic()
    source = start("caps:64x48 500 stall")
    first, second = source.next(), source.next()
    for frames in (first, second):
        assert begun_s < frames.time_s <= time.monotonic()
        image = frames.frames["camera0"].image
        assert image.shape == (48, 64, 3)
        assert tuple(image[1, 10]) == (30, 10, 245), "the gradient of the fake, in RGB"
    assert second.time_s > first.time_s
    assert second.frames["camera0"].sequence > first.frames["camera0"].sequence
    assert source.status()["camera0"].fault is None


def test_numbers_count_periods_so_that_what_is_missing_shows() -> None:
    """Three images 20 ms apart by their stamps, then one 100 ms after: four are missing. At 50 a second."""
    script = (
        "import os, struct\n"
        "def send(kind, data=b'', t=0): os.write(1, struct.pack('<4sIqI', kind, 0, t, len(data)) + bytes(4) + data)\n"
        "send(b'caps', b'video/x-raw, format=(string)GRAY8, width=(int)64, height=(int)48')\n"
        "for ms in (1000, 1020, 1040, 1140, 1159): send(b'imag', bytes(64 * 48), ms * 10**6)\n"
        "os.read(0, 1)\n"
    )
    command = (sys.executable, "-ISc", script)
    with GstreamerDevice(CAMERA, SIZE, command) as device:
        read = [device.read(30.0) for _ in range(5)]
    assert [one.sequence for one in read if one is not None] == [0, 1, 2, 7, 8]
    assert [one.time_s for one in read if one is not None] == pytest.approx([1.0, 1.02, 1.04, 1.14, 1.159])


@pytest.mark.fault("damaged-images")
@pytest.mark.parametrize(
    ("pipeline", "count"),
    [("short", "corrupt"), ("flagged", "flagged"), ("untimed", "time_stamp")],
)
def test_what_is_worth_nothing_is_dropped_and_counted_and_the_next_is_fine(
    start: Watch, pipeline: str, count: str
) -> None:
    source = start(f"caps:64x48 {pipeline} 500 stall")
    source.next()
    assert source.status()["camera0"].counts.get(count) == 1  # type: ignore[call-overload]
    assert source.status()["camera0"].fault is None


@pytest.mark.parametrize(
    ("pipeline", "told"),
    [
        ("caps:64x48 2 end", "its pipeline has ended; use one that does not end"),
        ("fail:has_failed_(Device_is_gone)", "its pipeline has failed (Device is gone); try it with `gst-launch-1.0 "),
        ("fail:GStreamer_is_not_installed", "GStreamer is not installed; install libgstreamer1.0-0, gstreamer1.0-"),
        ("caps:32x24", "its pipeline gives 32x24, but the rig has 64x48; end it with `videoscale ! video/x-raw,width="),
        ("caps:video/x-h264,_width=(int)64,_height=(int)48", "its pipeline gives video/x-h264, width=(int)64, heigh"),
        ("crash", "the process of its pipeline was ended by SIGSEGV; a driver may have crashed"),
        ("print", "the process of its pipeline sent no image but other data; stop the element or driver that prints"),
        ("2", "the process of its pipeline sent no image but other data; stop the element or driver that prints"),
    ],
)
def test_each_way_to_fail_is_one_sentence_and_is_tried_again(start: Watch, pipeline: str, told: str) -> None:
    source = start(pipeline)
    assert source.why().startswith(f"camera0: {told}")
    source.until(lambda status: status.counts.get("opened", 0) >= 2)


@pytest.mark.fault("camera-unplugged")
def test_a_crash_is_followed_by_images_when_the_driver_is_back(start: Watch, tmp_path: Path) -> None:
    source = start(f"caps:64x48 once:{tmp_path / 'has_crashed'} crash 500 stall")
    assert source.next().frames
    assert source.status()["camera0"].counts["opened"] == 2


def test_a_process_that_hangs_is_ended_when_its_camera_is_closed() -> None:
    script = "import time\ntime.sleep(3600)"  # reads nothing, not even that the other side has gone
    device = GstreamerDevice(CAMERA, SIZE, (sys.executable, "-ISc", script))
    assert device.read(0.0) is None
    process = device._process
    device.close()
    assert process.poll() == -9


def test_a_password_of_a_camera_is_in_no_process_list_and_in_no_message() -> None:
    """Every user of a computer may read the arguments of every process."""
    pipeline = "caps:64x48 fail:cannot_open_rtsp://anna:hunter2@10.0.0.7/stream_with_user-pw=hunter2_! stall"
    device = GstreamerDevice(CAMERA.model_copy(update={"pipeline": pipeline}), SIZE, FAKE)
    arguments = " ".join(map(str, device._process.args)).encode()  # type: ignore[arg-type]
    with pytest.raises(CameraError, match=r"cannot open rtsp://\*\*\*@10\.0\.0\.7") as caught:
        device.read(60.0)
    device.close()
    assert b"64" in arguments, "the size is among them"
    for told in (arguments, str(caught.value).encode()):
        assert b"anna" not in told
        assert b"hunter2" not in told


def test_a_program_that_is_not_there_is_one_sentence() -> None:
    with pytest.raises(CameraError, match=r"^front: the process of its pipeline cannot be started \(No such file"):
        GstreamerDevice(CAMERA, SIZE, ("/nowhere/python",))


def test_the_real_process_says_so_where_gstreamer_is_not_installed(tmp_path: Path) -> None:
    text = Path(CHILD[-1]).read_text(encoding="utf-8").replace("libgstreamer-1.0.so.0", "libnowhere-1.0.so.0")
    (tmp_path / "child.py").write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-I", tmp_path / "child.py", "gstreamer", "ANY"],
        input=b"\x0c\0\0\0videotestsrc",
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.stdout == HEADER.pack(b"fail", 0, 0, 26) + b"GStreamer is not installed"


def test_the_stream_and_the_buffer_are_laid_out_as_their_definitions_say() -> None:
    """The buffer as a C compiler lays out gstbuffer.h of 1.x on 64-bit machines."""
    assert HEADER.size == 24
    assert (Buffer.pts.offset, Buffer.dts.offset) == (72, 80)


def test_a_pipeline_is_asked_for_the_rigs_size_and_rate_first() -> None:
    asked = caps((640, 480), 29.97).split(";")
    assert asked[0] == "image/jpeg,width=640,height=480,framerate=29970/1000"
    assert asked[1].endswith(",width=640,height=480,framerate=29970/1000")
    assert asked[-2:] == ["image/jpeg", f"video/x-raw,format=(string){{{','.join(('NV12', 'I420', *PACKED))}}}"]
    assert "NV12" not in caps((66, 50), 30.0), "of sizes that GStreamer pads only what is packed"
    assert format_of("video/x-raw, format=(string)NV12, width=(int)66, height=(int)50") is None


@pytest.mark.parametrize(
    ("name", "size"),
    [("NV12", (64, 48)), ("I420", (64, 48)), *((name, size) for name in PACKED for size in ((66, 50), (61, 47)))],
)
def test_every_format_becomes_the_same_picture(name: str, size: tuple[int, int]) -> None:
    """Encoded by hand, row by row with GStreamer's padding; two thirds grey values, one third colour."""
    width, height = size
    image = _picture(width, height)
    found = format_of(f"video/x-raw, format=(string){name}, width=(int){width}, height=(int){height}")
    assert found is not None
    image_format, of_size = found
    data = _encoded(name, image)
    image_format.check(data)
    decoded = image_format.pixels(data)
    assert of_size == size
    assert decoded.shape == (height, width, 3)
    wanted = image if name != "GRAY8" else cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    assert np.abs(decoded.astype(int) - wanted).mean() < 3.0
    for wrong in (data[:-1], data + b"\0"):
        with pytest.raises(CorruptImageError):
            image_format.check(wrong)


def test_jpegs_are_those_of_v4l2() -> None:
    found = format_of("image/jpeg, parsed=(boolean)true, width=(int)640, height=(int)480, framerate=(fraction)30/1")
    assert found == (MjpegFormat((640, 480)), (640, 480))
    assert format_of("image/jpeg, framerate=(fraction)30/1") is None


def _picture(width: int, height: int) -> UInt8Array:
    """Smooth, because half of the formats have one colour for four pixels."""
    across, down = np.meshgrid(np.linspace(30, 220, width), np.linspace(40, 200, height))
    return np.stack([across, down, 250.0 - across], axis=-1).round().astype(np.uint8)


def _padded(rows: UInt8Array) -> bytes:
    flat = rows.reshape(rows.shape[0], -1)
    return np.pad(flat, ((0, 0), (0, -flat.shape[1] % 4))).tobytes()


def _encoded(name: str, image: UInt8Array) -> bytes:
    if name in ("RGB", "BGR"):
        return _padded(image if name == "RGB" else image[..., ::-1])
    if name in ("RGBx", "RGBA", "BGRx", "BGRA"):
        colours = image if name.startswith("R") else image[..., ::-1]
        return _padded(np.dstack([colours, np.full(image.shape[:2], 255, np.uint8)]))
    if name == "GRAY8":
        return _padded(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8))
    even = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
    # BT.601, luma from 16 to 235.
    weights = np.array([[65.481, 128.553, 24.966], [-37.797, -74.203, 112.0], [112.0, -93.786, -18.214]])
    luma, blue, red = np.moveaxis((even / 255.0) @ weights.T + (16.0, 128.0, 128.0), -1, 0).round().astype(np.uint8)
    if name in ("YUY2", "UYVY"):
        chroma = np.where(np.arange(even.shape[1]) % 2, red, blue)
        pairs = (luma, chroma) if name == "YUY2" else (chroma, luma)
        return _padded(np.dstack(pairs)[: image.shape[0]])
    few = [np.ascontiguousarray(one[::2, ::2]) for one in (blue, red)]
    return _padded(luma) + (_padded(np.dstack(few)) if name == "NV12" else b"".join(map(_padded, few)))
