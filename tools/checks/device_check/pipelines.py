"""Checks of cameras behind GStreamer, with its own elements: rate, time stamps, and all that can go wrong."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np

from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.onboard.sources.device_source import DeviceSource
from flockd.onboard.sources.frames import CameraError, CameraStatus, CapturedBuffer
from flockd.onboard.sources.gstreamer_device import GstreamerDevice
from tools.checks.device_check import datagrams
from tools.checks.device_check.datagrams import DatagramCamera
from tools.checks.device_check.findings import Check, Finding
from tools.checks.device_check.waiting import until

SIZE = (640, 480)
RATE_HZ = 25.0
FRAMES = 100
SILENCE_S = 0.5
STAMP_ERROR_S = 1e-3
"""What half of the stamps may at most be after the time at which their datagrams were sent, which travel."""
LOOK_S = 0.002


def streams_test_images() -> Iterator[Finding]:
    """GStreamer's own source of test images."""
    yield from _streams("rate", f"videotestsrc is-live=true ! video/x-raw,framerate={RATE_HZ:g}/1")


def streams_a_camera(device: str) -> Iterator[Finding]:
    """The same camera that flockd reads by itself."""
    yield from _streams("rate of v4l2src", f"v4l2src device={device}")


def stamps() -> Iterator[Finding]:
    """What a stamp says, against the time at which the image was sent, which it carries in its pixels."""
    with DatagramCamera(RATE_HZ) as camera, _opened(camera.pipeline, datagrams.SIZE) as device:
        frames = [frame for frame, _ in _read(device)]
    errors_ms = [1e3 * (frame.time_s - datagrams.sent_s(frame.data)) for frame in frames]
    low, usual, high = np.percentile(errors_ms, [0, 50, 95]).tolist()
    yield Finding(
        "pipeline's time stamps",
        low >= 0.0 and usual < 1e3 * STAMP_ERROR_S,
        f"p50 {usual:.3f} ms, p95 {high:.3f} ms after the image was sent, never less than {low:.3f} ms",
        f"never before, p50 under {1e3 * STAMP_ERROR_S:g} ms",
    )


def falls_silent() -> Iterator[Finding]:
    """No error, but no image either."""
    with DatagramCamera(RATE_HZ) as camera, _running(camera.pipeline) as source:
        camera.silent, silent_s = True, time.monotonic()
        noticed_s = until(lambda: _status(source).fault is not None, "the silence to be noticed", look_s=LOOK_S)
        camera.silent, spoke_s = False, time.monotonic()
        back_s = until(lambda: _status(source).fault is None, "the camera to be back", look_s=LOOK_S)
    yield Finding(
        "a silent pipeline",
        noticed_s - silent_s <= SILENCE_S + 0.2,
        f"noticed after {noticed_s - silent_s:.2f} s, back {back_s - spoke_s:.2f} s after it spoke again",
        f"noticed within {SILENCE_S + 0.2:g} s",
    )


def freezes() -> Iterator[Finding]:
    """The same image again and again."""
    with DatagramCamera(RATE_HZ) as camera, _running(camera.pipeline) as source:
        camera.frozen, frozen_s = True, time.monotonic()
        noticed_s = until(lambda: "frozen" in str(_status(source).fault), "frozen images to be noticed", look_s=LOOK_S)
        camera.frozen = False
        until(lambda: _status(source).fault is None, "the camera to be back", look_s=LOOK_S)
    yield Finding(
        "a frozen pipeline",
        noticed_s - frozen_s <= 0.5,
        f"noticed after {noticed_s - frozen_s:.2f} s ({SourceParameters(kind='gstreamer').frozen_after} repeats)",
        "noticed within 0.5 s",
    )


def is_cut() -> Iterator[Finding]:
    """Images that lack their second half."""
    with DatagramCamera(RATE_HZ) as camera, _running(camera.pipeline) as source:
        camera.cut = True
        time.sleep(0.2)
        camera.cut = False
        newest = source.newest(5.0)
        counts = _status(source).counts
    corrupt, opened = counts.get("corrupt", 0), counts.get("opened", 0)
    yield Finding(
        "cut images",
        corrupt > 0 and opened == 1 and newest is not None,
        f"{corrupt} refused and counted, started again {opened - 1} times",
        "refused and counted, and the stream goes on",
    )


def crashes() -> Iterator[Finding]:
    """The process of the pipeline ends by a signal, as it does when a driver crashes."""
    with DatagramCamera(RATE_HZ) as camera, _running(camera.pipeline) as source:
        killed_s = time.monotonic()
        os.kill(_child(), signal.SIGSEGV)
        noticed_s = until(lambda: _status(source).fault is not None, "the crash to be noticed", look_s=LOOK_S)
        told = _status(source).fault
        back_s = until(lambda: _status(source).fault is None, "the camera to be back", look_s=LOOK_S)
    yield Finding(
        "a crash",
        "SIGSEGV" in str(told) and noticed_s - killed_s <= 0.5,
        f"noticed after {noticed_s - killed_s:.3f} s ({told}), images again {back_s - noticed_s:.2f} s later",
        "noticed within 0.5 s, started again",
    )


def ends() -> Iterator[Finding]:
    """Streams that end, as those of a network camera that restarts."""
    pipeline = f"videotestsrc is-live=true num-buffers=50 ! video/x-raw,framerate={RATE_HZ:g}/1"
    with _running(pipeline, SIZE) as source:
        until(lambda: _status(source).fault is not None, "the end to be noticed", look_s=LOOK_S)
        told = _status(source).fault
        until(lambda: _status(source).fault is None, "the next stream", look_s=LOOK_S)
        opened = _status(source).counts["opened"]
    yield Finding("end of stream", "has ended" in str(told) and opened == 2, f"{told}", "reported, started again")


def cannot_be_built() -> Iterator[Finding]:
    """What people write wrong."""
    for what, pipeline, wanted in (
        ("an unknown element", "nosuchcamerasrc", 'no element "nosuchcamerasrc"'),
        ("a device that is not there", "v4l2src device=/dev/video63", "/dev/video63"),
        ("another size", "videotestsrc is-live=true ! video/x-raw,width=320,height=240", "gives 320x240"),
    ):
        with _running(pipeline, SIZE, wait=False) as source:
            until(lambda source=source: _status(source).fault is not None, what)  # type: ignore[misc]
            told = str(_status(source).fault)
        yield Finding(what, wanted in told, told, f"a sentence with {wanted!r}")


CHECKS: tuple[Check, ...] = (
    *(streams_test_images, stamps, falls_silent, freezes, is_cut, crashes, ends, cannot_be_built),
)


def _streams(name: str, pipeline: str) -> Iterator[Finding]:
    with _opened(pipeline, SIZE) as device:
        got = _read(device)
    periods = np.array([after.time_s - before.time_s for (before, _), (after, _) in pairwise(got)])
    ages_ms = np.percentile([1e3 * (came_s - frame.time_s) for frame, came_s in got], [0, 50, 95]).tolist()
    gaps = sum(after.sequence - before.sequence - 1 for (before, _), (after, _) in pairwise(got))
    hz, off_ms = 1.0 / float(np.median(periods)), 1e3 * float(np.percentile(np.abs(periods - 1.0 / RATE_HZ), 95))
    yield Finding(
        name,
        abs(hz - RATE_HZ) < 0.05 * RATE_HZ and gaps == 0 and ages_ms[0] > -20.0,
        f"{hz:.2f} Hz over {FRAMES} frames, {gaps} missing, off the beat by {off_ms:.2f} ms (p95); "
        f"{ages_ms[1]:.1f} ms old when here (p50), {ages_ms[2]:.1f} (p95)",
        f"{RATE_HZ:g} Hz within 5 %, none missing",
    )


@contextmanager
def _opened(pipeline: str, size: tuple[int, int]) -> Iterator[GstreamerDevice]:
    with GstreamerDevice(CameraDeviceParameters(name="check", pipeline=pipeline, rate_hz=RATE_HZ), size) as device:
        yield device


@contextmanager
def _running(pipeline: str, size: tuple[int, int] = datagrams.SIZE, *, wait: bool = True) -> Iterator[DeviceSource]:
    """A source of this one camera; begins when images come, unless asked not to wait."""
    camera = CameraDeviceParameters(name="check", pipeline=pipeline, rate_hz=RATE_HZ)
    parameters = SourceParameters(kind="gstreamer", cameras=(camera,), set_tolerance_s=0.03, silence_s=SILENCE_S)
    source = DeviceSource({"check": size}, parameters)
    source.start()
    try:
        if wait:
            until(lambda: source.newest() is not None, "the first image")
        yield source
    finally:
        source.stop()


def _read(device: GstreamerDevice) -> list[tuple[CapturedBuffer, float]]:
    """Frames, and when each was handed over; the first ones, which waited for the start, are left out."""
    got = []
    for _ in range(FRAMES + 10):
        frame = device.read(20.0)
        if frame is None:
            raise CameraError("no image came within 20 s")
        got.append((frame, time.monotonic()))
    return got[10:]


def _status(source: DeviceSource) -> CameraStatus:
    return source.status()["check"]


def _child() -> int:
    """The process of the only pipeline there is."""
    children = [
        int(pid)
        for task in Path("/proc/self/task").iterdir()
        for pid in (task / "children").read_text(encoding="ascii").split()
        if "gstreamer_child" in Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8")
    ]
    (pid,) = children
    return pid
