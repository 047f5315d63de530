"""Whether calibrations can be true, and where the cameras together see nothing. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from flockd.core.config.rig import CameraConfig, RigConfig
from flockd.flight.geometry import build_rig
from flockd.ground.doctor.finding import Finding, failed, passed, warned

# A calibration made at another size of image has its principal point far from the middle: half the width off for twice
# the size. Real lenses sit within some percent of it.
ODD_CENTRE, WRONG_CENTRE = 0.08, 0.2
"""Shares of the width or height, between the principal point and the middle."""
ODD_PIXELS, WRONG_PIXELS = 0.03, 0.15
"""How much fx and fy differ: pixels are square, unless images were squeezed from another aspect."""
NARROW_DEG, MOST_PINHOLE_DEG, MOST_WIDE_DEG = 40.0, 130.0, 220.0
_STEP_DEG = 1


def width_deg(camera: CameraConfig) -> float:
    """The horizontal field of view through the image's middle row; NaN where the calibration images nothing there.

    Raises ValueError where the intrinsics make no camera.
    """
    lens = build_rig(RigConfig(cameras=(camera,))).cameras[camera.name].camera
    width, _ = camera.size_px
    cy = camera.intrinsics.cy
    left, right = lens.rays(np.array([[0.0, cy], [float(width), cy]]))
    return math.degrees(sum(math.atan2(abs(ray[0]), ray[2]) for ray in (left, right)))


def lens_problems(camera: CameraConfig) -> Iterator[Finding]:
    """What makes a calibration unlikely or impossible for images of the camera's size."""
    about, lens = f"camera {camera.name}", camera.intrinsics
    again = "calibrate this camera at the size of its images"
    try:
        angle = width_deg(camera)
    except ValueError as error:
        yield failed(about, f"its calibration is unusable ({error})", again)
        return
    off = max(abs(lens.cx / camera.size_px[0] - 0.5), abs(lens.cy / camera.size_px[1] - 0.5))
    if off > ODD_CENTRE:
        size = "x".join(map(str, camera.size_px))
        measured = f"principal point {lens.cx:g}, {lens.cy:g} is {off:.0%} of the image off the middle of {size}"
        yield (failed if off > WRONG_CENTRE else warned)(about, measured, again)
    odd = abs(lens.fx / lens.fy - 1.0)
    if odd > ODD_PIXELS:
        measured = f"fx {lens.fx:g} and fy {lens.fy:g} differ by {odd:.0%}, and pixels are square"
        yield (failed if odd > WRONG_PIXELS else warned)(about, measured, again)
    most = MOST_PINHOLE_DEG if lens.model == "pinhole" else MOST_WIDE_DEG
    if not angle <= most:
        shown = "no direction at its border" if math.isnan(angle) else f"{angle:.0f} degrees from left to right"
        yield failed(about, f"the {lens.model} calibration sees {shown}; up to {most:.0f} can be", again)
    elif angle < NARROW_DEG:
        yield warned(about, f"{angle:.0f} degrees from left to right see few neighbours", f"{again}, or widen the lens")


def coverage(rig: RigConfig) -> Finding:
    """How much of the horizon the cameras see together."""
    angles = np.radians(np.arange(0, 360, _STEP_DEG))
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)
    seen = build_rig(rig).covers(directions)
    if seen.all():
        return passed(
            "rig",
            f"{len(rig.cameras)} cameras see all of the horizon, and all around to {_reach_deg(rig)} degrees off it",
        )
    if not seen.any():
        return failed("rig", "no camera sees the horizon", "fix the cameras' extrinsics")
    gaps = " and ".join(_gaps(~seen))
    return warned(
        "rig",
        f"blind at the horizon {gaps}, clockwise from forward: neighbours there are not seen",
        "turn, widen or add cameras, or fix their extrinsics",
    )


def _reach_deg(rig: RigConfig) -> int:
    """Up to how many degrees above and below the horizon the cameras see all around."""
    built, angles = build_rig(rig), np.radians(np.arange(0, 360, _STEP_DEG))
    around = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)
    for reach_deg in range(_STEP_DEG, 90, _STEP_DEG):
        reach = math.radians(reach_deg)
        for side in (math.sin(reach), -math.sin(reach)):
            if not built.covers(math.cos(reach) * around + [0.0, 0.0, side]).all():
                return reach_deg - _STEP_DEG
    return 90


def _gaps(blind: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> list[str]:
    """From where to where, in whole degrees, around the circle."""
    begins = np.flatnonzero(blind & ~np.roll(blind, 1))
    ends = np.flatnonzero(blind & ~np.roll(blind, -1))
    if ends[0] < begins[0]:
        ends = np.roll(ends, -1)
    return [f"from {begin * _STEP_DEG} to {end * _STEP_DEG} degrees" for begin, end in zip(begins, ends, strict=True)]
