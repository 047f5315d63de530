"""Cameras: all of them run at once, as in flight, and are watched for some seconds."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from flockd.core.config import DroneConfig
from flockd.core.config.rig import CameraConfig
from flockd.core.config.source import CameraDeviceParameters
from flockd.ground.cameras.watching import START_S, Watched, watch
from flockd.ground.doctor.finding import Finding, failed, failed_from_error, passed, warned
from flockd.ground.doctor.lens_checks import coverage, lens_problems, width_deg
from flockd.onboard.sources.device_source import Devices

SLOW, TOO_SLOW = 0.95, 0.8
"""Shares of the configured rate. Cheap cameras halve theirs by themselves in dim light."""
UNEVEN, TOO_UNEVEN = 0.2, 0.5
"""Shares of a frame period: 95th percentile of how far a frame is from its beat. By half a period sets fall apart."""
FIX_RATE = "try another cable and port, fewer cameras on one USB bus, or a shorter exposure that is set by hand"
FIX_PIPELINE = "try the pipeline with `gst-launch-1.0`, and ask it for a rate and size that it can keep"
DARK, BRIGHT = 12.0, 243.0
"""Mean grey, 0 to 255, of an image in which little can be seen."""


def check_cameras(
    config: DroneConfig, seconds: float, devices: Devices | None = None, start_s: float = START_S
) -> Iterator[Finding]:
    """Every camera of the rig, and what they see together."""
    source = config.source
    if source is None:
        measured = "the configuration has no `source`: this drone can be simulated but not flown"
        yield warned("cameras", measured, "add a `source`, as in config/quadrotor.yaml")
        watched = {}
    else:
        sizes = {camera.name: camera.size_px for camera in config.rig.cameras}
        watched = watch(sizes, source, seconds, devices or Devices(), start_s)
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
        fix_rate = _fix_rate(device)
        problems += stream_problems(camera.name, watched, rate_hz, config.safety.max_dropped_share, fix_rate)
        problems += [] if device is None or device.pipeline else _exposure_problems(device)
        measured = [
            f"{watched.rate_hz:.1f} of {rate_hz:g} images a second, jitter {1e3 * watched.jitter_s():.1f} ms, no gaps",
            f"{len(device.controls)} controls accepted" if device and device.device else "",
        ]
    size = "x".join(map(str, camera.size_px))
    if problems:
        yield from problems
    else:
        calibration = f"calibration fits {size}, {width_deg(camera):.0f} degrees wide"
        yield passed(f"camera {camera.name}", ", ".join(part for part in [*measured, calibration] if part))


def _fix_rate(device: CameraDeviceParameters | None) -> str:
    """What to do about frames that are too few, uneven or damaged."""
    if device is None:
        return "check why the program that publishes them is late"
    return FIX_PIPELINE if device.pipeline else FIX_RATE


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
