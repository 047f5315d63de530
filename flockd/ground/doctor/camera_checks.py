"""Checks cameras: all run at once for some seconds; their calibrations; the rig, also by the last flight."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flockd.core.config import DroneConfig
from flockd.core.config.rig import CameraConfig, RigConfig, field_of_view_deg
from flockd.core.secrets import masked
from flockd.flight.geometry import Rig, build_rig
from flockd.ground.calibration.from_flight import found_rig
from flockd.ground.calibration.rig_calibration import PRIOR_TURN_RAD, described, rig_faults
from flockd.ground.cameras.watching import START_S, Watched, watch
from flockd.ground.doctor import Finding, Level, failed, failed_from_error, graded, passed, warned
from flockd.ground.doctor.computer_checks import STATE_FOLDER
from flockd.onboard.recording.mcap_file import RecordingError
from flockd.onboard.recording.reader import Recording, flight_number, head_of
from flockd.onboard.sources.device_source import Devices

SLOW, TOO_SLOW = 0.95, 0.8
"""Shares of the configured rate. Cheap cameras halve theirs by themselves in dim light."""
UNEVEN, TOO_UNEVEN = 0.2, 0.5
"""Limits of the jitter (95th percentile) as shares of a frame period; at half a period sets become incomplete."""
FIX_RATE = "try another cable and port, fewer cameras on one USB bus, or a shorter exposure that is set by hand"
FIX_PIPELINE = "try the pipeline with `gst-launch-1.0`, and ask it for a rate and size that it can keep"
DARK, BRIGHT = 12.0, 243.0
"""Mean grey levels, 0 to 255, below and above which an image is too dark or too bright."""

ODD_CENTRE = 0.08
"""Share of the width or height between principal point and middle. Real lenses sit within some percent of it."""
ODD_PIXELS = 0.03
"""How much fx and fy differ: pixels are square, unless images were squeezed from another aspect."""
SEEN_DEG, UNSEEN = 63, 0.12
"""Largest angle from the optical axis in the networks' training (docs/networks.md), and the share of an image that may
lie beyond it; in the shipped rig it is a tenth."""
LAST_S = 30.0
"""Seconds of the last flight that are computed again and compared with the rig."""
NARROW_DEG = 40.0


def check_cameras(
    config: DroneConfig, seconds: float, devices: Devices | None = None, start_s: float = START_S
) -> Iterator[Finding]:
    """Checks every camera of the rig, and their common view."""
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
    yield from uncalibrated(config)
    yield coverage(config.rig)


def _judged(camera: CameraConfig, config: DroneConfig, watched: Watched | None) -> Iterator[Finding]:
    problems, measured = list(lens_problems(camera)), []
    if watched is not None and config.source is not None:
        device = next((entry for entry in config.source.cameras if entry.name == camera.name), None)
        rate_hz, fix_rate = config.source.shared_memory.rate_hz, "check why the program that publishes them is late"
        if device is not None:
            rate_hz, fix_rate = device.rate_hz, FIX_PIPELINE if device.pipeline else FIX_RATE
        found = _stream(camera.name, watched, rate_hz, config.safety.max_dropped_share, fix_rate)
        problems += [finding for finding in found if finding.level is not Level.PASS]
        # The driver refuses controls that it does not accept; here is what was not even asked.
        if device and not device.pipeline and not any("exposure" in control.name for control in device.controls):
            told = "its exposure is not configured: automatic exposure blurs, which looks like motion"
            fix = "set it in source.cameras[].controls, as in config/quadrotor.yaml"
            problems.append(warned(f"camera {camera.name}", told, fix))
        jitter_ms = 1e3 * watched.jitter_s()
        measured.append(f"{watched.rate_hz:.1f} of {rate_hz:g} images a second, jitter {jitter_ms:.1f} ms, no gaps")
        measured += [f"{len(device.controls)} controls accepted"] if device and device.device else []
        if device and device.crop:
            measured.append(f"cut at {device.crop[0]}, {device.crop[1]} from images of {masked(device.place)}")
    if problems:
        yield from problems
    else:
        size = "x".join(map(str, camera.size_px))
        measured.append(f"calibration fits {size}, {field_of_view_deg(camera.intrinsics, camera.size_px):.0f} degrees")
        yield passed(f"camera {camera.name}", ", ".join(measured))


def uncalibrated(config: DroneConfig) -> Iterator[Finding]:
    """Whether lenses of devices are as they came with a file, not as somebody measured them."""
    names = [camera.name for camera in config.rig.cameras if camera.intrinsics.measured is None]
    if names and config.source is not None and config.source.cameras:
        about, fix = f"cameras {', '.join(names)}", "run `flockd calibrate camera`, and copy all of its `intrinsics`"
        yield warned(about, "their lenses are not calibrated (no `intrinsics.measured`): ranges err as they do", fix)


def _stream(name: str, watched: Watched, rate_hz: float, max_dropped_share: float, fix_rate: str) -> Iterator[Finding]:
    """Checks a camera's images; ``fix_rate``: the remedy for too few, uneven or damaged ones."""
    about = f"camera {name}"
    if watched.fault is not None:
        yield failed_from_error(about, watched.fault.removeprefix(f"{name}: "))
        return
    came, bad = len(watched.stamps_s), sum(watched.refused.values())
    share = (watched.lost + bad) / max(came + watched.lost + bad, 1)
    what = [f"{count} {reason}" for reason, count in (("lost", watched.lost), *watched.refused.items()) if count]
    measured = f"of {came + watched.lost + bad} images {', '.join(what)} ({share:.0%})"
    yield graded(about, measured, fix_rate, failure=share > max_dropped_share, warning=bool(what))
    pace = watched.rate_hz / rate_hz
    measured = f"{watched.rate_hz:.1f} images a second instead of {rate_hz:g}"
    fix = f"{fix_rate}, or write rate_hz: {max(watched.rate_hz, 0.1):.2g}"
    yield graded(about, measured, fix, failure=pace < TOO_SLOW, warning=pace < SLOW or pace > 2.0 - SLOW)
    uneven = watched.jitter_s() * rate_hz
    measured = f"images come unevenly: {1e3 * watched.jitter_s():.1f} ms off their period of {1e3 / rate_hz:.1f} ms"
    yield graded(about, measured, fix_rate, failure=uneven > TOO_UNEVEN, warning=uneven > UNEVEN)
    if watched.image is not None and not DARK <= (grey := float(watched.image.mean())) <= BRIGHT:
        how = "dark" if grey < DARK else "bright"
        fix = "remove the lens cap, or set exposure and gain for the light where it flies"
        yield warned(about, f"the image is too {how} (mean {grey:.0f} of 255)", fix)


def lens_problems(camera: CameraConfig) -> Iterator[Finding]:
    """Why a calibration is unlikely for images of the camera's size, and which part of these the networks do not
    see."""
    about, lens = f"camera {camera.name}", camera.intrinsics
    again = "calibrate this camera at the size of its images"
    off = max(abs(lens.cx / camera.size_px[0] - 0.5), abs(lens.cy / camera.size_px[1] - 0.5))
    if off > ODD_CENTRE:
        size = "x".join(map(str, camera.size_px))
        measured = f"principal point {lens.cx:g}, {lens.cy:g} is {off:.0%} of the image off the middle of {size}"
        yield warned(about, measured, again)
    odd = abs(lens.fx / lens.fy - 1.0)
    if odd > ODD_PIXELS:
        yield warned(about, f"fx {lens.fx:g} and fy {lens.fy:g} differ by {odd:.0%}, and pixels are square", again)
    if (angle := field_of_view_deg(lens, camera.size_px)) < NARROW_DEG:
        yield warned(about, f"{angle:.0f} degrees of view show few neighbours", f"{again}, or widen the lens")
    if (blind := _unseen_share(camera)) > UNSEEN:
        yield warned(
            about,
            f"{blind:.0%} of the image shows what is more than {SEEN_DEG} degrees right, left, above or below of the "
            "axis, where no network was trained: neighbours there are missed or misplaced",
            f"narrow the lens to {2 * SEEN_DEG} degrees, and add cameras",
        )


def _unseen_share(camera: CameraConfig) -> float:
    """Of the image, beyond `SEEN_DEG`."""
    lens = build_rig(RigConfig(cameras=(camera,))).cameras[camera.name].camera
    grid = np.meshgrid(*((np.arange(50) + 0.5) / 50 * side for side in camera.size_px))
    x, y, z = lens.rays(np.stack(grid, axis=-1).reshape(-1, 2)).T
    return 1.0 - float(np.mean(np.maximum(abs(x), abs(y)) <= z * math.tan(math.radians(SEEN_DEG))))


def coverage(rig: RigConfig) -> Finding:
    """The share of the horizon in view of the cameras."""
    built = build_rig(rig)
    seen = _seen_around(built, 0)
    if not seen.any():
        return failed("coverage", "no camera sees the horizon", "fix the cameras' extrinsics")
    if not seen.all():
        measured = f"blind at the horizon {' and '.join(_gaps(~seen))}, clockwise from forward: neighbours there are"
        return warned("coverage", f"{measured} not seen", "turn, widen or add cameras, or fix their extrinsics")
    blind = (deg for deg in range(1, 90) if not (_seen_around(built, deg).all() and _seen_around(built, -deg).all()))
    reach_deg = next(blind, 91) - 1
    measured = f"{len(rig.cameras)} cameras see all of the horizon, and all around to {reach_deg} degrees off it"
    return passed("coverage", measured)


def _seen_around(rig: Rig, down_deg: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Mask of the 360 whole degrees clockwise from forward that are in view, at an angle below the horizon."""
    angles, down = np.radians(np.arange(360)), math.radians(down_deg)
    level = np.stack([np.cos(angles), np.sin(angles), np.zeros(360)], axis=1)
    return rig.covers(math.cos(down) * level + [0.0, 0.0, math.sin(down)])


def _gaps(blind: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> list[str]:
    """Intervals of whole degrees around the circle."""
    begins = np.flatnonzero(blind & ~np.roll(blind, 1))
    ends = np.flatnonzero(blind & ~np.roll(blind, -1))
    if ends[0] < begins[0]:
        ends = np.roll(ends, -1)
    return [f"from {begin} to {end} degrees" for begin, end in zip(begins, ends, strict=True)]


def _flown(file: Path) -> tuple[int, float]:
    """Sort key, larger for later flights: the flight's number, because a drone's clock may be wrong."""
    number = 0
    with contextlib.suppress(RecordingError, OSError):
        number = flight_number(head_of(file)[0].facts)
    return number, file.stat().st_mtime


_VAGUE_TURN_RAD = 0.9 * PRIOR_TURN_RAD
"""About each axis: the flight shows nothing of a mounting."""


def check_rig(config: DroneConfig, folder: Path | None, state_folder: Path = STATE_FOLDER) -> Iterator[Finding]:
    """Checks the rig by this drone's newest recording in the folder, which is named as for `check_disk`."""
    files = [path for path in (folder or state_folder).glob(f"{config.name}-*.mcap") if not path.is_symlink()]
    newest = max(filter(Path.is_file, files), key=_flown, default=None)
    if newest is None:
        yield passed("rig", "no flight of this drone is recorded yet that its cameras could be compared with")
        return
    try:
        recording = Recording(newest)
        if recording.config.rig != config.rig:
            yield passed("rig", f"differs from that of the last flight, {newest.name}, which cannot be compared")
            return
        found = found_rig(recording, LAST_S)
    except (RecordingError, OSError) as error:
        yield warned("rig", f"its last flight could not be read: {error}", "delete it")
        return
    if not found:
        yield passed("rig", f"the last flight, {newest.name}, was too short for a comparison")
        return
    off = [one for one in found if rig_faults(one)]
    for one in off:
        texts = "; ".join(fault.partition(": ")[2] for fault in rig_faults(one))
        about = f"camera {one.camera}"
        if one.elsewhere:
            fix = "look at `flockd cameras --picture`: then correct the rig, or how it is mounted or plugged in"
            yield failed(about, f"in the last flight {texts}", fix)
        else:
            fix = f"flockd calibrate rig --from-flight {newest} writes the corrected rig; see that the camera is fixed"
            yield warned(about, f"in the last flight {texts}: {described(one)}", fix)
    unclear = (one for one in found if float(np.diag(one.covariance)[:3].min()) > _VAGUE_TURN_RAD**2)
    vague = [one.camera for one in unclear if one not in off]
    for camera in vague if len(vague) < len(found) else ():
        told = f"the last flight, {newest.name}, does not show its mounting, but others'"
        yield warned(f"camera {camera}", told, "look at `flockd cameras --picture`, and fly again")
    if not off:
        seen = len(found) - len(vague)
        yield passed("rig", f"in the last flight, {newest.name}, {seen} cameras were as configured")
