"""The cameras of a drone: their projections, where they sit, and their time."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from flockd.core.choices import LensModel
from flockd.core.config.base import NonNegative, PlainName, Positive, Section, Vector3, refuse, text


class MeasurementConfig(Section):
    """Where calibrated numbers come from: for people, nothing flies by it. `flockd calibrate` writes it."""

    date: Annotated[str, text(r"^\d{4}-\d{2}-\d{2}$", "a date, as in `2026-11-24`")]
    camera: str
    """Its path, or what else identifies it."""
    source: str
    """What it was measured from."""
    views: Annotated[int, Field(ge=1)]
    """Number of views of a board, or of pairs of images of what lay about."""
    residual_px: NonNegative | None = None
    """Root mean square of what the fit left over."""
    residual_deg: NonNegative | None = None
    """The same, of a fit to attitudes."""


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


class ExtrinsicsConfig(Section):
    """Where a camera sits: body FRD metres, and its turn from looking forward: yaw right, pitch up, roll clockwise."""

    position_m: Vector3 = (0.0, 0.0, 0.0)
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    measured: MeasurementConfig | None = None


class CameraConfig(Section):
    """One camera of the rig."""

    name: PlainName
    size_px: tuple[Annotated[int, Field(ge=32, le=8192)], Annotated[int, Field(ge=32, le=8192)]]
    """Width, height."""
    intrinsics: IntrinsicsConfig
    extrinsics: ExtrinsicsConfig = ExtrinsicsConfig()

    @model_validator(mode="after")
    def _the_principal_point_is_in_the_image(self) -> Self:
        points = {"cx": self.intrinsics.cx, "cy": self.intrinsics.cy}
        refuse(
            self,
            {
                ("intrinsics", key): f"{value:g} is outside the image, which is {size} pixels {side}; "
                f"check {key} and size_px"
                for (key, value), size, side in zip(points.items(), self.size_px, ("wide", "high"), strict=True)
                if value >= size
            },
        )
        return self


class RigConfig(Section):
    """All cameras of the drone."""

    cameras: Annotated[tuple[CameraConfig, ...], Field(min_length=1)]
    time_offset_s: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Added to the time stamp of a frame, the time at which the autopilot had the attitude it was taken in."""

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
