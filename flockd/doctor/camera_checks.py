"""Cameras: all of them run at once, as in flight, and are watched for some seconds."""

from __future__ import annotations

import contextlib
import statistics
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from flockd.config import DroneConfig
from flockd.config.rig import CameraConfig
from flockd.config.source import CameraDeviceParameters, SourceParameters
from flockd.doctor.finding import Finding, failed, failed_from_error, passed, warned
from flockd.doctor.lens_checks import coverage, lens_problems, width_deg
from flockd.messages import UInt8Array
from flockd.sources.frame_receiver import MAX_AHEAD_S
from flockd.sources.image_formats import CorruptImageError, ImageFormat, MjpegFormat, YuyvFormat
from flockd.sources.shared_memory import SharedMemorySource
from flockd.sources.v4l2_device import CameraError, CapturedBuffer, V4l2Device
from flockd.sources.v4l2_kernel import Kernel, LinuxKernel

START_S = 5.0
"""To open a camera and get its first image."""
STOP_S = 2.0
_LOOK_S = 0.05
SLOW, TOO_SLOW = 0.95, 0.8
"""Of the configured rate. Cheap cameras halve theirs by themselves in dim light."""
UNEVEN, TOO_UNEVEN = 0.2, 0.5
"""Of a frame period, the 95th percentile of how far a frame is from its beat. By half a period sets fall apart."""
FIX_RATE = "try another cable and port, fewer cameras on one USB bus, or a shorter exposure that is set by hand"
DARK, BRIGHT = 12.0, 243.0
"""Of 0-255, the mean grey of an image in which little can be seen."""


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


def check_cameras(config: DroneConfig, seconds: float, kernel: Kernel | None = None) -> Iterator[Finding]:
    """Every camera of the rig, and what they see together."""
    source = config.source
    if source is None:
        measured = "the configuration has no `source`: this drone can be simulated but not flown"
        yield warned("cameras", measured, "add a `source`, as in config/quadrotor.yaml")
        watched = {}
    elif source.kind == "v4l2":
        watched = watch_devices(config, source, seconds, kernel or LinuxKernel())
    else:
        watched = watch_shared_memory(config, source, seconds)
    for camera in config.rig.cameras:
        yield from _judged(camera, config, watched.get(camera.name))
    with contextlib.suppress(ValueError):  # a calibration that makes no camera, which was reported above
        yield coverage(config.rig)


def _judged(camera: CameraConfig, config: DroneConfig, watched: Watched | None) -> Iterator[Finding]:
    problems = list(lens_problems(camera))
    measured = []
    if watched is not None and config.source is not None:
        device = next((entry for entry in config.source.cameras if entry.name == camera.name), None)
        rate_hz = device.rate_hz if device else config.source.shared_memory.rate_hz
        fix_rate = FIX_RATE if device else "check why the program that publishes them is late"
        problems += stream_problems(camera.name, watched, rate_hz, config.safety.max_dropped_share, fix_rate)
        problems += [] if device is None else _exposure_problems(device)
        measured = [
            f"{watched.rate_hz:.1f} of {rate_hz:g} images a second, jitter {1e3 * watched.jitter_s():.1f} ms, no gaps",
            f"{len(device.controls)} controls accepted" if device else "",
        ]
    size = "x".join(map(str, camera.size_px))
    if problems:
        yield from problems
    else:
        calibration = f"calibration fits {size}, {width_deg(camera):.0f} degrees wide"
        yield passed(f"camera {camera.name}", ", ".join(part for part in [*measured, calibration] if part))


def stream_problems(
    name: str, watched: Watched, rate_hz: float, max_dropped_share: float, fix_rate: str
) -> Iterator[Finding]:
    """What is wrong with the images that came; ``fix_rate``: what to do about too few, uneven or damaged ones."""
    about = f"camera {name}"
    if watched.fault is not None:
        yield failed_from_error(about, watched.fault.removeprefix(f"{name}: "))
        return
    came, bad = len(watched.stamps_s), sum(watched.refused.values())
    share = (watched.lost + bad) / max(came + watched.lost + bad, 1)
    if watched.lost or bad:
        what = [f"{count} {reason}" for reason, count in (("lost", watched.lost), *watched.refused.items()) if count]
        measured = f"of {came + watched.lost + bad} images {', '.join(what)} ({share:.0%})"
        yield (failed if share > max_dropped_share else warned)(about, measured, fix_rate)
    pace = watched.rate_hz / rate_hz
    if pace < SLOW or pace > 2.0 - SLOW:
        measured = f"{watched.rate_hz:.1f} images a second instead of {rate_hz:g}"
        fix = f"{fix_rate}, or write rate_hz: {max(watched.rate_hz, 0.1):.2g}"
        yield (failed if pace < TOO_SLOW else warned)(about, measured, fix)
    jitter_s = watched.jitter_s()
    if jitter_s * rate_hz > UNEVEN:
        measured = f"images come unevenly: {1e3 * jitter_s:.1f} ms off their period of {1e3 / rate_hz:.1f} ms"
        yield (failed if jitter_s * rate_hz > TOO_UNEVEN else warned)(about, measured, fix_rate)
    if watched.image is not None:
        grey = float(watched.image.mean())
        if not DARK <= grey <= BRIGHT:
            how = "dark" if grey < DARK else "bright"
            fix = "remove the lens cap, or set exposure and gain for the light where it flies"
            yield warned(about, f"the image is too {how} (mean {grey:.0f} of 255)", fix)


def _exposure_problems(device: CameraDeviceParameters) -> Iterator[Finding]:
    """The driver refuses controls that it does not accept; here is what was not even asked."""
    if not any("exposure" in control.name for control in device.controls):
        measured = "its exposure is not configured: an automatic one blurs, which is taken for motion"
        fix = "set it in source.cameras[].controls, as in config/quadrotor.yaml"
        yield warned(f"camera {device.name}", measured, fix)


def watch_devices(config: DroneConfig, source: SourceParameters, seconds: float, kernel: Kernel) -> dict[str, Watched]:
    """Runs all devices side by side, as a USB bus has to carry them in flight."""
    sizes = {camera.name: camera.size_px for camera in config.rig.cameras}
    stopping = threading.Event()
    watched, threads = {}, {}
    for device in source.cameras:
        record = watched[device.name] = Watched()
        arguments = (device, sizes[device.name], seconds, source, kernel, record, stopping)
        threads[device.name] = threading.Thread(target=_watch_device, args=arguments, daemon=True)
        threads[device.name].start()
    until_s = time.monotonic() + START_S + seconds + STOP_S
    for name, thread in threads.items():
        thread.join(max(until_s - time.monotonic(), 0.0))
        if thread.is_alive():
            hangs = Watched(fault="its driver does not respond; unplug the camera and plug it in again")
            watched[name] = hangs
    stopping.set()
    return watched


def _watch_device(
    device: CameraDeviceParameters,
    size: tuple[int, int],
    seconds: float,
    source: SourceParameters,
    kernel: Kernel,
    record: Watched,
    stopping: threading.Event,
) -> None:
    try:
        with V4l2Device(
            device.name,
            device.device,
            size=size,
            pixel_format=device.pixel_format,
            rate_hz=device.rate_hz,
            controls=device.controls,
            kernel=kernel,
        ) as camera:
            image_format: ImageFormat
            if device.pixel_format == "mjpeg":
                image_format = MjpegFormat(size)
            else:
                image_format = YuyvFormat(size, camera.bytes_per_line)
            _record(camera.read, image_format, seconds, source, record, stopping)
    except CameraError as error:
        record.fault = str(error)


def _record(
    read: Callable[[float], CapturedBuffer | None],
    image_format: ImageFormat,
    seconds: float,
    source: SourceParameters,
    record: Watched,
    stopping: threading.Event,
) -> None:
    """Everything from the first usable image on; the last one is decoded."""
    until_s, last = time.monotonic() + START_S, None
    sequence: int | None = None
    repeats = 0
    while time.monotonic() < until_s and not stopping.is_set():
        captured = read(_LOOK_S)
        if captured is None:
            continue
        if sequence is not None:
            record.lost += max(captured.sequence - sequence - 1, 0)
        sequence = captured.sequence
        repeats = repeats + 1 if last is not None and captured.data == last.data else 0
        reason = _refusal(captured, image_format, source.silence_s)
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
        came = f"no usable image came within {START_S:g} s ({seen})" if seen else f"no image came within {START_S:g} s"
        record.fault = f"{came}; try another cable, port and pixel_format"
        return
    try:
        record.image = image_format.decode(last.data)
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
