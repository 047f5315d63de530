"""Checks of flockd's own capture on virtual cameras: what `flockd.onboard.sources` makes of all that a camera can
do."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from statistics import median

from flockd.core.choices import PixelFormat
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.onboard.sources.device_source import DeviceSource
from flockd.onboard.sources.frames import CameraError, CameraStatus, CapturedBuffer, Count
from flockd.onboard.sources.v4l2_device import V4l2Device
from tools.checks.device_check import camera_images
from tools.checks.device_check.cameras import CABLE, LOOPBACK, WEBCAM, cable, control, feeding, loopback
from tools.checks.device_check.findings import Finding
from tools.checks.device_check.waiting import until

SIZE, SMALL = (640, 480), (320, 180)
RATE_HZ, CABLE_HZ = 25.0, 60.0
FRAMES = 100
SILENCE_S = 0.5
NOTICED_S = max(3.0 / RATE_HZ, 0.5)
DROPPED_PERCENT = 20
FLAGS = 5
LOOK_S = 0.002
_DROPPING = "percentage_of_dropped_buffers"
_FAILURES = {
    "a fatal streaming error": "inject_fatal_streaming_error",
    "a queue that refuses": "inject_vidioc_qbuf_error",
    "unplugged": "disconnect",
}
"""What goes wrong, and which of vivid's buttons makes it."""


def streams() -> Iterator[Finding]:
    """A USB camera's stream as the kernel hands it over."""
    with _opened(WEBCAM, "yuyv", RATE_HZ) as device:
        got = _read(device)
    frames = [frame for frame, _ in got]
    periods = [after.time_s - before.time_s for before, after in pairwise(frames)]
    ages = [came_s - frame.time_s for frame, came_s in got]
    hz, worst_ms = 1.0 / median(periods), 1e3 * max(abs(period - 1.0 / RATE_HZ) for period in periods)
    yield Finding(
        "rate", abs(hz - RATE_HZ) < 0.05 * RATE_HZ, f"{hz:.2f} Hz over {FRAMES} frames", f"{RATE_HZ:g} Hz within 5 %"
    )
    yield Finding("sequence", _gaps(frames) == 0, f"{_gaps(frames)} missing of {FRAMES}", "none missing")
    yield Finding(
        "kernel time stamps",
        min(periods) > 0.0 and min(ages) >= 0.0 and max(ages) < SILENCE_S,
        f"{min(ages) * 1e3:.1f} to {max(ages) * 1e3:.1f} ms old, off the beat by {worst_ms:.1f} ms",
        "monotonic, rising, never ahead",
    )


def carries_yuyv() -> Iterator[Finding]:
    """Images of ours, through a driver that copies each as a camera's DMA would."""
    known = {camera_images.yuyv(SIZE, number): number for number in range(camera_images.COUNT)}
    with feeding(cable(list(known))), _opened(CABLE, "yuyv", CABLE_HZ) as device:
        until(lambda: _next(device)[0].data in known, "the cable to carry images")
        frames = [frame for frame, _ in _read(device)]
    yield _exact("bytes of YUYV", frames, known)


def carries_mjpeg() -> Iterator[Finding]:
    """The same compressed, through a driver that hands over each image once, in its turn."""
    known = {camera_images.mjpeg(SIZE, number): number for number in range(camera_images.COUNT)}
    with feeding(loopback(SIZE, RATE_HZ)), _opened(LOOPBACK, "mjpeg", RATE_HZ) as device:
        _next(device)  # to whoever comes the driver gives the last image, with all that follows it in the buffer
        frames = [frame for frame, _ in _read(device)]
    yield _exact("bytes of MJPEG", frames, known)
    turns = [(known.get(b.data, -1) - known.get(a.data, -1)) % camera_images.COUNT for a, b in pairwise(frames)]
    wrong = sum(turn != 1 for turn in turns)
    yield Finding(
        "order of MJPEG",
        wrong == 0 and _gaps(frames) == 0,
        f"{wrong} out of turn, {_gaps(frames)} missing",
        "in turn, none missing",
    )


def loses_frames() -> Iterator[Finding]:
    """The driver drops some; flockd counts the gaps in the numbers, and the rest flows on."""
    with _running(WEBCAM, "yuyv") as source:
        before, begun_s = _counts(source), control(WEBCAM, _DROPPING, DROPPED_PERCENT)
        time.sleep(6.0)
        control(WEBCAM, _DROPPING, 0)
        time.sleep(0.2)
        after, span_s = _counts(source), time.monotonic() - begun_s
        time.sleep(2.0)
        later = _counts(source)
    lost, received = _grown(before, after, "lost"), _grown(before, after, "received")
    more, taken = _grown(after, later, "lost"), RATE_HZ * span_s
    yield Finding(
        "dropped buffers",
        lost > 0 and abs(lost + received - taken) <= 3 and more == 0,
        f"{lost} lost and {received} received, of {taken:.0f} that were taken; {more} lost afterwards",
        f"about {DROPPED_PERCENT} % lost and counted, then none",
    )


def flags_damage() -> Iterator[Finding]:
    """The driver says of single frames that they are damaged."""
    with _running(WEBCAM, "yuyv") as source:
        before = _counts(source)
        for _ in range(FLAGS):
            control(WEBCAM, "inject_v4l2_buf_flag_error")
            time.sleep(0.2)
        after = _counts(source)
        goes_on = source.newest(1.0) is not None
    flagged, opened = _grown(before, after, "flagged"), _grown(before, after, "opened")
    yield Finding(
        "buffer error flags",
        (flagged, opened) == (FLAGS, 0) and goes_on,
        f"{flagged} of {FLAGS} refused and counted, opened again {opened} times",
        "all refused, and the stream goes on",
    )


def breaks() -> Iterator[Finding]:
    """The driver gives up; only opening it again helps."""
    with _running(WEBCAM, "yuyv") as source:
        for what, button in _FAILURES.items():
            yield _fails_and_returns(source, what, functools.partial(control, WEBCAM, button))


def falls_silent() -> Iterator[Finding]:
    """No error, but no frame either; an old one is there for whoever opens it again."""
    with feeding(loopback(SMALL, RATE_HZ)) as feeder, _running(LOOPBACK, "mjpeg") as source:
        silent_s = feeder.fall_silent()
        noticed_s = until(lambda: _status(source).fault is not None, "the silence to be noticed", look_s=LOOK_S)
        before = _counts(source)
        time.sleep(2.0)
        after = _counts(source)
        spoke_s = feeder.go_on()
        back_s = until(lambda: _status(source).fault is None, "the camera to be back", look_s=LOOK_S)
    refused, stale = _grown(before, after, "late"), _grown(before, after, "received")
    yield Finding(
        "a silent camera",
        noticed_s - silent_s <= SILENCE_S + 0.1 and 0 < refused == stale,
        f"noticed after {noticed_s - silent_s:.2f} s, {refused} of {stale} old frames refused, "
        f"back {back_s - spoke_s:.2f} s after it spoke again",
        f"noticed within {SILENCE_S + 0.1:g} s, no old frame taken",
    )


def is_taken() -> Iterator[Finding]:
    """Two programs want one camera."""
    with _running(WEBCAM, "yuyv") as first:
        before = _counts(first)
        with _running(WEBCAM, "yuyv", wait=False) as second:
            until(lambda: _status(second).fault is not None, "the second to be refused")
            reported = str(_status(second).fault)
            time.sleep(1.0)
            lost = _grown(before, _counts(first), "lost")
            first.stop()
            freed_s = time.monotonic()
            back_s = until(lambda: _status(second).fault is None, "the second to get the camera", look_s=LOOK_S)
    yield Finding(
        "a second opener",
        "in use by another program" in reported and lost == 0,
        f"{reported!r}; the first lost {lost}; it is the second's {back_s - freed_s:.2f} s after the first let go",
        "refused, the first undisturbed",
    )


def _fails_and_returns(source: DeviceSource, what: str, fail: Callable[[], float]) -> Finding:
    before = _counts(source)
    failed_s = fail()
    noticed_s = until(lambda: _status(source).fault is not None, f"{what} to be noticed", look_s=LOOK_S)
    reported = _status(source).fault
    back_s = until(lambda: _status(source).fault is None, f"frames after {what}", look_s=LOOK_S)
    opened, took_s = _grown(before, _counts(source), "opened"), noticed_s - failed_s
    return Finding(
        what,
        took_s <= NOTICED_S and opened >= 1,
        f"noticed after {took_s:.3f} s ({reported}), frames again {back_s - noticed_s:.2f} s later",
        f"noticed within {NOTICED_S:g} s, opened again",
    )


@contextmanager
def _opened(device: str, pixel_format: PixelFormat, rate_hz: float) -> Iterator[V4l2Device]:
    camera = CameraDeviceParameters(name="check", device=device, pixel_format=pixel_format, rate_hz=rate_hz)
    with V4l2Device(camera, SIZE) as opened:
        yield opened


@contextmanager
def _running(device: str, pixel_format: PixelFormat, *, wait: bool = True) -> Iterator[DeviceSource]:
    """A source of this one camera; begins when frames come, unless asked not to wait."""
    camera = CameraDeviceParameters(name="check", device=device, pixel_format=pixel_format, rate_hz=RATE_HZ)
    parameters = SourceParameters(kind="v4l2", cameras=(camera,), set_tolerance_s=0.03, silence_s=SILENCE_S)
    source = DeviceSource({"check": SMALL}, parameters)
    source.start()
    try:
        if wait:
            until(lambda: source.newest() is not None, "the first frame")
        yield source
    finally:
        source.stop()


def _next(device: V4l2Device) -> tuple[CapturedBuffer, float]:
    """The next frame, and when it was handed over."""
    frame = device.read(5.0)
    if frame is None:
        raise CameraError("no frame came within 5 s")
    return frame, time.monotonic()


def _read(device: V4l2Device) -> list[tuple[CapturedBuffer, float]]:
    return [_next(device) for _ in range(FRAMES)]


def _gaps(frames: list[CapturedBuffer]) -> int:
    return sum(after.sequence - before.sequence - 1 for before, after in pairwise(frames))


def _exact(check: str, frames: list[CapturedBuffer], known: Mapping[bytes, int]) -> Finding:
    exact = [frame.data for frame in frames if frame.data in known]
    return Finding(
        check,
        len(exact) == len(frames) and len(set(exact)) > 1,
        f"{len(exact)} of {len(frames)} frames equal in every byte, of {len(set(exact))} different images",
        "all equal",
    )


def _status(source: DeviceSource) -> CameraStatus:
    return source.status()["check"]


def _counts(source: DeviceSource) -> Mapping[Count, int]:
    return _status(source).counts


def _grown(before: Mapping[Count, int], after: Mapping[Count, int], what: Count) -> int:
    return after.get(what, 0) - before.get(what, 0)
