"""Checks of flockd's own capture on virtual cameras, and of GStreamer's in its place: what `flockd.onboard.sources`
makes of all that a camera can do."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from itertools import pairwise
from statistics import median

from flockd.core.choices import PixelFormat
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.onboard.sources.device_source import DeviceSource
from flockd.onboard.sources.frames import CameraError, CameraStatus, CapturedBuffer, Count
from flockd.onboard.sources.gstreamer_device import GstreamerDevice
from flockd.onboard.sources.v4l2_device import V4l2Device
from tools.checks.device_check.cameras import COUNT, LOOPBACK, WEBCAM, Feeder, control, image
from tools.checks.device_check.findings import Check, Finding, run, until

SIZE, SMALL = (640, 480), (320, 180)
RATE_HZ, FRAMES = 25.0, 100
SILENCE_S, NOTICED_S = 0.5, 0.5
LOOK_S = 0.002
_FAILURES = {
    "a fatal streaming error": "inject_fatal_streaming_error",
    "a queue that refuses": "inject_vidioc_qbuf_error",
    "unplugged": "disconnect",
}
"""What goes wrong, and which of vivid's buttons makes it."""
_TEST_IMAGES = f"videotestsrc is-live=true ! video/x-raw,framerate={RATE_HZ:g}/1"


def streams() -> Iterator[Finding]:
    """A USB camera's stream as the kernel hands it over, and as GStreamer does."""
    camera = _camera(WEBCAM, "yuyv")
    piped = CameraDeviceParameters(name="check", pipeline=f"v4l2src device={WEBCAM}", rate_hz=RATE_HZ)
    for name, ahead_s, opened in (
        ("V4L2", 0.0, lambda: V4l2Device(camera, SIZE)),
        ("GStreamer", 0.02, lambda: GstreamerDevice(piped, SIZE)),
    ):
        with opened() as device:
            _read(device, 10)  # these waited for the start
            got = _read(device)
        frames = [frame for frame, _ in got]
        periods = [after.time_s - before.time_s for before, after in pairwise(frames)]
        ages = [came_s - frame.time_s for frame, came_s in got]
        hz, worst_ms = 1.0 / median(periods), 1e3 * max(abs(period - 1.0 / RATE_HZ) for period in periods)
        yield Finding(
            f"rate of {name}", abs(hz - RATE_HZ) < 0.05 * RATE_HZ and _gaps(frames) == 0,
            f"{hz:.2f} Hz over {FRAMES} frames, {_gaps(frames)} missing", f"{RATE_HZ:g} Hz within 5 %, none missing",
        )  # fmt: skip
        yield Finding(
            f"time stamps of {name}", min(periods) > 0.0 and min(ages) >= -ahead_s and max(ages) < SILENCE_S,
            f"{min(ages) * 1e3:.1f} to {max(ages) * 1e3:.1f} ms old, off the beat by {worst_ms:.1f} ms",
            f"monotonic, rising, ahead by {ahead_s:g} s at most",
        )  # fmt: skip


def carries_bytes() -> Iterator[Finding]:
    """Images of ours through a driver that hands over each once, in its turn."""
    formats: tuple[PixelFormat, ...] = ("yuyv", "mjpeg")
    for pixel_format in formats:
        known = {image(pixel_format, SIZE, number): number for number in range(COUNT)}
        camera = _camera(LOOPBACK, pixel_format)
        with closing(Feeder(pixel_format, SIZE, RATE_HZ)), V4l2Device(camera, SIZE) as device:
            _read(device, 1)  # to whoever comes the driver gives the last image, with all that follows in the buffer
            frames = [frame for frame, _ in _read(device)]
        numbers = [known.get(frame.data) for frame in frames]
        exact = sum(number is not None for number in numbers)
        wrong = sum(a is None or b != (a + 1) % COUNT for a, b in pairwise(numbers))
        yield Finding(
            f"bytes of {pixel_format}", exact == len(frames) and wrong == _gaps(frames) == 0,
            f"{exact} of {len(frames)} frames equal in every byte, {wrong} out of turn, {_gaps(frames)} missing",
            "all equal, in turn, none missing",
        )  # fmt: skip


def breaks() -> Iterator[Finding]:
    """The driver gives up, or the process of a pipeline crashes as a driver in it does; only opening it again helps."""
    with _running(_camera(WEBCAM, "yuyv")) as source:
        for what, button in _FAILURES.items():
            yield _fails_and_returns(source, what, lambda button=button: control(button))  # type: ignore[misc]
    with _running(_pipeline(_TEST_IMAGES)) as source:
        yield _fails_and_returns(source, "a crash of GStreamer", _crash)


def falls_silent() -> Iterator[Finding]:
    """No error, but no frame either; an old one is there for whoever opens it again."""
    with closing(Feeder("mjpeg", SMALL, RATE_HZ)) as feeder, _running(_camera(LOOPBACK, "mjpeg")) as source:
        silent_s = feeder.fall_silent()
        noticed_s = until(lambda: _fault(source) is not None, "the silence to be noticed", look_s=LOOK_S)
        before = _counts(source)
        time.sleep(2.0)
        refused, stale = _grown(before, source, "late"), _grown(before, source, "received")
        spoke_s = feeder.go_on()
        back_s = until(lambda: _fault(source) is None, "the camera to be back", look_s=LOOK_S)
    yield Finding(
        "a silent camera", noticed_s - silent_s <= SILENCE_S + 0.1 and 0 < refused == stale,
        f"noticed after {noticed_s - silent_s:.2f} s, {refused} of {stale} old frames refused, back "
        f"{back_s - spoke_s:.2f} s after it spoke again",
        f"noticed within {SILENCE_S + 0.1:g} s, no old frame taken",
    )  # fmt: skip


CHECKS: tuple[Check, ...] = streams, carries_bytes, breaks, falls_silent


def _fails_and_returns(source: DeviceSource, what: str, fail: Callable[[], float]) -> Finding:
    before = _counts(source)
    failed_s = fail()
    noticed_s = until(lambda: _fault(source) is not None, f"{what} to be noticed", look_s=LOOK_S)
    reported = _fault(source)
    back_s = until(lambda: _fault(source) is None, f"frames after {what}", look_s=LOOK_S)
    opened, took_s = _grown(before, source, "opened"), noticed_s - failed_s
    return Finding(
        what, took_s <= NOTICED_S and opened >= 1,
        f"noticed after {took_s:.3f} s ({reported}), frames again {back_s - noticed_s:.2f} s later",
        f"noticed within {NOTICED_S:g} s, opened again",
    )  # fmt: skip


def _crash() -> float:
    """Of the only pipeline there is; when."""
    (pid,) = run("pgrep", "-f", "camera_child").split()
    now_s = time.monotonic()
    os.kill(int(pid), signal.SIGSEGV)
    return now_s


def _camera(device: str, pixel_format: PixelFormat) -> CameraDeviceParameters:
    return CameraDeviceParameters(name="check", device=device, pixel_format=pixel_format, rate_hz=RATE_HZ)


def _pipeline(pipeline: str) -> CameraDeviceParameters:
    return CameraDeviceParameters(name="check", pipeline=pipeline, rate_hz=RATE_HZ)


@contextmanager
def _running(camera: CameraDeviceParameters) -> Iterator[DeviceSource]:
    """A source of this one camera; begins when frames come."""
    parameters = SourceParameters(
        kind="gstreamer" if camera.pipeline else "v4l2", cameras=(camera,), set_tolerance_s=0.03, silence_s=SILENCE_S
    )
    source = DeviceSource({"check": SMALL}, parameters)
    source.start()
    try:
        until(lambda: source.newest() is not None, "the first frame")
        yield source
    finally:
        source.stop()


def _read(device: V4l2Device | GstreamerDevice, count: int = FRAMES) -> list[tuple[CapturedBuffer, float]]:
    """The next frames, and when each was handed over."""
    got = []
    for _ in range(count):
        frame = device.read(20.0)
        if frame is None:
            raise CameraError("no frame came within 20 s")
        got.append((frame, time.monotonic()))
    return got


def _gaps(frames: list[CapturedBuffer]) -> int:
    return sum(after.sequence - before.sequence - 1 for before, after in pairwise(frames))


def _status(source: DeviceSource) -> CameraStatus:
    return source.status()["check"]


def _fault(source: DeviceSource) -> object:
    return _status(source).fault


def _counts(source: DeviceSource) -> Mapping[Count, int]:
    return _status(source).counts


def _grown(before: Mapping[Count, int], source: DeviceSource, what: Count) -> int:
    return _counts(source).get(what, 0) - before.get(what, 0)
