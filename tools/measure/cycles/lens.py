"""A camera of flockd as Blender describes one. Pure, numpy alone: Blender's Python reads it too."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

SENSOR_MM = 36.0
"""Width of the sensor; any other would do, as only shares of it count."""
MOST_OFF_PX = 0.1
"""A lens that Blender's polynomial cannot follow so closely is refused."""


@dataclass(frozen=True)
class Lens:
    """A camera that both renderers draw: its name in the rig, size, intrinsics as in a configuration, and mounting."""

    name: str
    model: str
    """``pinhole`` or ``wide_angle``."""
    size_px: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]
    R_body_camera: tuple[tuple[float, float, float], ...]
    position_m: tuple[float, float, float]


def blender_camera(lens: Lens) -> dict[str, Any]:
    """Properties of ``bpy.types.Camera``. Raises ValueError for a lens that Blender does not have."""
    width, height = lens.size_px
    if lens.fx != lens.fy:
        raise ValueError(f"camera {lens.name}: fx and fy differ, and Blender's pixels are square")
    placed: dict[str, Any] = {
        "sensor_fit": "HORIZONTAL",
        "sensor_width": SENSOR_MM,
        "sensor_height": SENSOR_MM * height / width,
        # Shares of the image's width, as the sensor fits its width.
        "shift_x": (width / 2.0 - lens.cx) / width,
        "shift_y": (lens.cy - height / 2.0) / width,
    }
    if lens.model == "pinhole":
        if any(lens.distortion):
            raise ValueError(f"camera {lens.name}: Blender's pinhole has no distortion")
        return {"type": "PERSP", "lens": lens.fx * SENSOR_MM / width, **placed}
    if (lens.cx, lens.cy) != (width / 2.0, height / 2.0):
        raise ValueError(f"camera {lens.name}: Blender's fisheye looks along the middle of its image")
    coefficients = theta_polynomial(lens.fx * SENSOR_MM / width, lens.distortion, _corner_mm(lens))
    return {
        "type": "PANO",
        "panorama_type": "FISHEYE_LENS_POLYNOMIAL",
        # Blender counts angles the other way round.
        **{f"fisheye_polynomial_k{power}": -k for power, k in enumerate(coefficients)},
        "fisheye_fov": 2.0 * math.pi,
        **placed,
    }


def known_places(lens: Lens) -> NDArray[np.float64]:
    """(25, 3) places, metres RDF, 5 m away, in a spiral out to where the image ends at its narrower side."""
    reach_px = 0.46 * min(lens.size_px)
    radius_px = reach_px * np.sqrt((np.arange(25) + 0.5) / 25)
    theta = np.arctan(radius_px / lens.fx) if lens.model == "pinhole" else radius_px / lens.fx
    turn = np.arange(25) * math.pi * (3.0 - math.sqrt(5.0))
    return 5.0 * np.stack([np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.cos(theta)], axis=1)


def theta_polynomial(focal_mm: float, distortion: tuple[float, ...], most_mm: float) -> tuple[float, ...]:
    """(5,) coefficients of the angle off the axis, radians, by radius in the image, mm, as far as ``most_mm``.

    The inverse of Kannala and Brandt's radius ``f theta (1 + k1 theta^2 + ...)``. Raises ValueError where it errs by
    more than a share of `MOST_OFF_PX` pixels in an image of 640 pixels' width.
    """
    theta = np.linspace(0.0, math.pi, 20_000)
    radius = focal_mm * theta * (1.0 + sum(k * theta ** (2 * power) for power, k in enumerate(distortion, start=1)))
    grows = np.flatnonzero(np.diff(radius) <= 0.0)
    last = int(grows[0]) if len(grows) else len(theta) - 1
    reach = radius[: last + 1] <= most_mm
    r, angle = radius[: last + 1][reach], theta[: last + 1][reach]
    powers = np.stack([r**power for power in range(1, 5)], axis=1)
    solved, *_ = np.linalg.lstsq(powers / most_mm ** np.arange(1, 5), angle, rcond=None)
    solved = solved / most_mm ** np.arange(1, 5)
    off_px = float(np.abs(powers @ solved - angle).max()) * focal_mm * 640.0 / SENSOR_MM
    if off_px > MOST_OFF_PX:
        raise ValueError(f"Blender's polynomial follows this lens to {off_px:.2f} pixels only")
    return (0.0, *(float(k) for k in solved))


def _corner_mm(lens: Lens) -> float:
    width, height = lens.size_px
    return math.hypot(width, height) / 2.0 * SENSOR_MM / width
