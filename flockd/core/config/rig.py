"""The cameras of a drone: projections, mounting and time offset."""

from __future__ import annotations

import math
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from flockd.core.choices import LensModel
from flockd.core.config.base import NonNegative, PlainName, Positive, Section, refuse, text
from flockd.core.messages import FloatArray


class MeasurementConfig(Section):
    """The source of calibrated numbers, for people; flights do not use it. `flockd calibrate` writes it."""

    date: Annotated[str, text(r"^\d{4}-\d{2}-\d{2}$", "a date, as in `2026-11-24`")]
    camera: str
    """Its path, or another name that identifies it."""
    source: str
    """The images or recordings it was measured from."""
    views: Annotated[int, Field(ge=1)]
    """Number of views of a board, or of pairs of images of a scene."""
    residual_px: NonNegative | None = None
    """Root mean square of the fit's residuals."""


class IntrinsicsConfig(Section):
    """A camera's projection, in pixels; pixel centres at +0.5."""

    model: LensModel = "pinhole"
    fx: Positive
    fy: Positive
    cx: Positive
    cy: Positive
    distortion: tuple[float, ...] = ()
    """Pinhole: k1 k2 p1 p2 [k3] (OpenCV). Wide angle: k1 k2 k3 k4 of the equidistant model. Empty: none."""
    measured: MeasurementConfig | None = None


_OnBoard = Annotated[float, Field(ge=-5, le=5)]
"""Metres; the largest offset of a camera on such vehicles."""


_Turn = Annotated[float, Field(ge=-360, le=360)]


class ExtrinsicsConfig(Section):
    """Mounting of a camera: position in body FRD, and angles from looking forward: yaw right, pitch up, roll
    clockwise."""

    position_m: tuple[_OnBoard, _OnBoard, _OnBoard] = (0.0, 0.0, 0.0)
    yaw_deg: _Turn = 0.0
    pitch_deg: _Turn = 0.0
    roll_deg: _Turn = 0.0
    measured: MeasurementConfig | None = None


class CameraConfig(Section):
    """One camera of the rig."""

    name: PlainName
    size_px: tuple[Annotated[int, Field(ge=32, le=8192)], Annotated[int, Field(ge=32, le=8192)]]
    """Width, height."""
    intrinsics: IntrinsicsConfig
    extrinsics: ExtrinsicsConfig = ExtrinsicsConfig()

    @model_validator(mode="after")
    def _can_be_true(self) -> Self:
        refuse(self, {("intrinsics", key): text for key, text in _lens_faults(self.intrinsics, self.size_px).items()})
        return self


_COEFFICIENTS = {"pinhole": (0, 4, 5), "wide_angle": (0, 4)}
_OFF_CENTRE = 0.16
"""Largest distance of the principal point from the image's middle, as a share of width or height. It is larger if a
lens was calibrated for another size or for an image on its side; of real lenses it is some percent."""
_SQUARE = 0.15
"""Largest difference of fx and fy: pixels are square unless images were squeezed from another aspect ratio."""
_ROUNDED_RAD = 0.005
"""Rounding of a written angle: 1.57 is a quarter turn."""
NARROWEST_DEG = 5.0
WIDEST_DEG = {"pinhole": 130.0, "wide_angle": 220.0}


_STRETCHED = {"pinhole": (0.4, 1.5), "wide_angle": (0.6, 1.5)}
"""Distance from the middle in the image, relative to a lens without distortion. An orthographic fisheye has 0.42 at 65
degrees as a pinhole, and 0.64 at 90 degrees as an equidistant lens, a stereographic one 1.49 at 110; telephoto lenses
have less than 1.1."""
_OFF_AXIS = 0.1
"""The same for displacements by p1 and p2, of lenses that stand askew; of real ones it is a hundredth."""


def _lens_faults(lens: IntrinsicsConfig, size: tuple[int, int]) -> dict[str, str]:
    """Reasons why a calibration is impossible for images of this size, by key."""
    words = f"{size[0]} x {size[1]} images"
    again = "correct it, or calibrate the camera at the size of its images"
    if len(lens.distortion) not in _COEFFICIENTS[lens.model]:
        known = "k1 k2 k3 k4" if lens.model == "wide_angle" else "k1 k2 p1 p2, and k3 or not"
        told = f"has {len(lens.distortion)} coefficients; {lens.model} takes none, or {known}"
        return {"distortion": f"{told}; give these, as `flockd calibrate import` fits them"}
    faults = {
        key: f"{value:g} is {abs(value / length - 0.5):.0%} of the image off the middle of {words}; {again}"
        for key, value, length in (("cx", lens.cx, size[0]), ("cy", lens.cy, size[1]))
        if not abs(value / length - 0.5) <= _OFF_CENTRE
    }
    if abs(lens.fx / lens.fy - 1.0) > _SQUARE:
        faults["fy"] = (
            f"{lens.fy:g} and fx {lens.fx:g} differ by more than {_SQUARE:.0%}, and pixels are square; {again}"
        )
    if not NARROWEST_DEG <= (angle := field_of_view_deg(lens, size)) <= WIDEST_DEG[lens.model]:
        seen = "shows no direction at the border" if math.isnan(angle) else f"gives {angle:.0f} degrees"
        bounds = f"between {NARROWEST_DEG:g} and {WIDEST_DEG[lens.model]:g} can be of a {lens.model}"
        faults["fx"] = f"{lens.fx:g}, in pixels, {seen} of {words}, and {bounds}; {again}"
    elif (fault := _distortion_fault(lens, angle)) is not None:
        faults["distortion"] = f"{fault}, up to the border of {words}; {again}"
    return faults


def _distortion_fault(lens: IntrinsicsConfig, angle_deg: float) -> str | None:
    """Why no lens that sees ``angle_deg`` distorts like this."""
    border = math.radians(angle_deg / 2) if lens.model == "wide_angle" else math.tan(math.radians(angle_deg / 2))
    ideal, (least, most) = np.linspace(0.0, border, 100)[1:], _STRETCHED[lens.model]
    stretched = _imaged(lens, ideal) / ideal
    if stretched.min() < least or stretched.max() > most:
        off = stretched.min() if stretched.min() < least else stretched.max()
        known = f"real lenses to {least:.0%} to {most:.0%}"
        return f"moves points to {off:.0%} of their distance from the middle, and {known}"
    askew = 3.0 * border * max(map(abs, lens.distortion[2:4]), default=0.0) if lens.model == "pinhole" else 0.0
    if askew > _OFF_AXIS:
        return f"moves points by p1 and p2 by {askew:.0%} of their distance from the middle"
    return None


def field_of_view_deg(lens: IntrinsicsConfig, size: tuple[int, int]) -> float:
    """Field of view across the longer side, the principal point in its middle; NaN if the lens does not image the
    border."""
    ideal = np.linspace(0.0, 10.0 if lens.model == "pinhole" else math.pi, 2000)  # tangents to 84 degrees, or angles
    imaged = _imaged(lens, ideal)
    folds = np.flatnonzero(np.diff(imaged) <= 0.0)
    last = int(folds[0]) if len(folds) else len(ideal) - 1
    border = max(size) / 2 / (lens.fx if size[0] >= size[1] else lens.fy)
    at = float(np.interp(border, imaged[: last + 1], ideal[: last + 1], right=math.nan))
    return math.degrees(2.0 * (math.atan(at) if lens.model == "pinhole" else at))


def _imaged(lens: IntrinsicsConfig, ideal: FloatArray) -> FloatArray:
    """Distances from the middle (n,), in focal lengths, of points that a lens without distortion images at ``ideal``
    (n,): tangents, or the angles off the axis."""
    radial = (*lens.distortion[:2], *lens.distortion[4:5]) if lens.model == "pinhole" else lens.distortion
    return ideal * (1.0 + sum(k * ideal ** (2 * power) for power, k in enumerate(radial, start=1)))


class RigConfig(Section):
    """All cameras of the drone."""

    cameras: Annotated[tuple[CameraConfig, ...], Field(min_length=1)]
    time_offset_s: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Added to a frame's time stamp, it gives the time of the autopilot's attitude at which the frame was taken."""

    @model_validator(mode="after")
    def _turns_are_degrees(self) -> Self:
        """All turns about the vertical, two or more, that are multiples of pi/4 are radians."""
        yaws = {n: camera.extrinsics.yaw_deg for n, camera in enumerate(self.cameras)}
        turned = {n: yaw for n, yaw in yaws.items() if abs(yaw) > _ROUNDED_RAD}
        off = [math.remainder(abs(yaw), math.pi / 4) for yaw in turned.values() if abs(yaw) < 2.0 * math.pi]
        if len(off) == len(turned) > 1 and max(map(abs, off)) < _ROUNDED_RAD:
            told = "is in radians, as all the others are; write degrees"
            refuse(self, {("cameras", n, "extrinsics", "yaw_deg"): f"{yaw:g} {told}" for n, yaw in turned.items()})
        return self

    @model_validator(mode="after")
    def _names_are_unique(self) -> Self:
        names = [camera.name for camera in self.cameras]
        refuse(
            self,
            {
                ("cameras", number, "name"): f"two cameras share the name {name!r}; give each its own"
                for number, name in enumerate(names)
                if name in names[:number]
            },
        )
        return self
