"""Watches cameras: runs them side by side for some seconds, and writes down what came."""

from __future__ import annotations

import statistics
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.config.source import CameraDeviceParameters, SourceParameters
from flockd.core.messages import UInt8Array
from flockd.onboard.sources.device_source import OpenDevice
from flockd.onboard.sources.devices import CameraDevice, CameraError, CapturedBuffer
from flockd.onboard.sources.frame_receiver import MAX_AHEAD_S
from flockd.onboard.sources.gstreamer import open_pipeline
from flockd.onboard.sources.image_formats import CorruptImageError, ImageFormat
from flockd.onboard.sources.shared_memory import SharedMemorySource
from flockd.onboard.sources.v4l2 import open_v4l2
from flockd.onboard.sources.v4l2_kernel import Kernel

START_S = 5.0
"""To get another program's first image."""
LONGEST_START_S = 10.0
"""To open any device and get its first image."""
STOP_S = 2.0
_LOOK_S = 0.05


@dataclass
class Watched:
    """What one camera did."""

    fault: str | None = None
    """Why it gives nothing, in one sentence that ends in its fix."""
    stamps_s: list[float] = field(default_factory=list)
    """When each image was taken, as its time stamp says."""
    arrivals_s: list[float] = field(default_factory=list)
    """When each was here, where its time stamp may be of another clock."""
    lost: int = 0
    """Gaps in the sequence numbers."""
    refused: Counter[str] = field(default_factory=Counter)
    """Images that are worth nothing, by reason."""
    image: UInt8Array | None = None

    @property
    def rate_hz(self) -> float:
        """As they came; 0 for less than two images."""
        times_s = self.arrivals_s or self.stamps_s
        if len(times_s) < 2:
            return 0.0
        return (len(times_s) - 1) / max(times_s[-1] - times_s[0], 1e-9)

    def jitter_s(self) -> float:
        """95th percentile of how far an interval is from the nearest multiple of the usual one."""
        intervals = np.diff(self.stamps_s)
        if len(intervals) < 2:
            return 0.0
        usual = statistics.median(intervals.tolist())
        beats = np.maximum(np.round(intervals / usual), 1.0) if usual > 0 else np.ones(len(intervals))
        return float(np.percentile(np.abs(intervals - beats * usual), 95))


def opener(kernel: Kernel) -> OpenDevice:
    """What opens cameras, by their pipeline where they have one."""

    def opened(camera: CameraDeviceParameters, size: tuple[int, int]) -> CameraDevice:
        return open_pipeline(camera, size) if camera.pipeline else open_v4l2(camera, size, kernel)

    return opened


def watch_devices(
    sizes: Mapping[str, tuple[int, int]], source: SourceParameters, seconds: float, open_device: OpenDevice
) -> dict[str, Watched]:
    """Runs all devices of a source side by side, as a USB bus has to carry them in flight; ``sizes`` by camera."""
    stopping = threading.Event()
    watched, threads = {}, {}
    for device in source.cameras:
        record = watched[device.name] = Watched()
        arguments = (device, sizes[device.name], seconds, source, open_device, record, stopping)
        threads[device.name] = threading.Thread(target=_watch_device, args=arguments, daemon=True)
        threads[device.name].start()
    until_s = time.monotonic() + LONGEST_START_S + seconds + STOP_S
    for name, thread in threads.items():
        thread.join(max(until_s - time.monotonic(), 0.0))
        if thread.is_alive():
            hangs = Watched(fault="its driver does not respond; unplug the camera and plug it in again")
            watched[name] = hangs
    stopping.set()
    return watched


def _watch_device(
    parameters: CameraDeviceParameters,
    size: tuple[int, int],
    seconds: float,
    source: SourceParameters,
    open_device: OpenDevice,
    record: Watched,
    stopping: threading.Event,
) -> None:
    try:
        with open_device(parameters, size) as camera:
            _record(camera, seconds, source, record, stopping)
    except CameraError as error:
        record.fault = str(error)


def _record(
    camera: CameraDevice, seconds: float, source: SourceParameters, record: Watched, stopping: threading.Event
) -> None:
    """Everything from the first usable image on; the last one is decoded."""
    until_s, last = time.monotonic() + camera.start_s, None
    sequence: int | None = None
    repeats = 0
    while time.monotonic() < until_s and not stopping.is_set():
        captured = camera.read(_LOOK_S)
        if captured is None:
            continue
        if sequence is not None:
            record.lost += max(captured.sequence - sequence - 1, 0)
        sequence = captured.sequence
        repeats = repeats + 1 if last is not None and captured.data == last.data else 0
        reason = _refusal(captured, camera.image_format(), source.silence_s)
        if reason is None and 0 < source.frozen_after <= repeats:
            reason = "frozen"
        if reason is not None:
            record.refused[reason] += 1
            continue
        if not record.stamps_s:
            until_s = time.monotonic() + seconds
        record.stamps_s.append(captured.time_s)
        last = captured
    if last is None:
        seen = ", ".join(f"{count} {reason}" for reason, count in record.refused.items())
        came = f"no {'usable ' if seen else ''}image came within {camera.start_s:g} s{f' ({seen})' if seen else ''}"
        record.fault = f"{came}; try another cable, port and pixel_format"
        return
    try:
        record.image = camera.image_format().decode(last.data)
    except CorruptImageError as error:
        record.refused[f"not to be decoded ({error})"] += 1


def _refusal(captured: CapturedBuffer, image_format: ImageFormat, silence_s: float) -> str | None:
    """As the source in flight would refuse it."""
    if captured.flagged:
        return "damaged, as the driver reports"
    if not -MAX_AHEAD_S <= time.monotonic() - captured.time_s <= silence_s:
        return "with a time stamp far from now"
    try:
        image_format.check(captured.data)
    except CorruptImageError as error:
        return f"corrupt ({error})"
    return None


def watch_shared_memory(config: DroneConfig, source: SourceParameters, seconds: float) -> dict[str, Watched]:
    """Receives what another program publishes. Raises UnavailableError for an endpoint that cannot be one."""
    frames = SharedMemorySource(config, source)
    watched = {camera.name: Watched() for camera in config.rig.cameras}
    frames.start()
    try:
        until_s, first = time.monotonic() + START_S, True
        while time.monotonic() < until_s:
            newest = frames.newest(_LOOK_S)
            if newest is None:
                continue
            if first:
                until_s, first = time.monotonic() + seconds, False
            for name, frame in newest.frames.items():
                watched[name].stamps_s.append(frame.time_s)
                watched[name].arrivals_s.append(time.monotonic())
                watched[name].image = frame.image
        status = frames.status()
    finally:
        frames.stop()
    for name, record in watched.items():
        counts = status[name].counts
        record.lost = counts.get("lost", 0)
        record.refused.update(
            {
                reason.replace("_", " "): counts[reason]
                for reason in ("time_stamp", "frozen", "corrupt", "malformed")
                if counts.get(reason)
            }
        )
        if not record.stamps_s:
            where = source.shared_memory
            nothing = (
                f"no frame of {where.drone}/{name} came from {', '.join(where.connect)} within {START_S:g} s; "
                "start the program that publishes them, or fix source.shared_memory"
            )
            record.fault = status[name].fault or nothing
    return watched
