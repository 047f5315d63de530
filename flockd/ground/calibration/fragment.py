"""Calibrated numbers as configuration: a `rig` section that checks, and that a drone's file can take as it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import yaml

from flockd.core.config.rig import CameraConfig, ExtrinsicsConfig, IntrinsicsConfig, MeasurementConfig, RigConfig
from flockd.core.messages import FloatArray
from flockd.flight.geometry import RigidTransform, build_rig, euler_from_rotation
from flockd.ground.calibration.intrinsics import Lens


def measured_today(**facts: Any) -> MeasurementConfig:
    """What is known about numbers that were measured today; ``facts``: fields of MeasurementConfig but the date."""
    return MeasurementConfig(date=datetime.now(UTC).date().isoformat(), **facts)


def intrinsics_of(lens: Lens, measured: MeasurementConfig) -> IntrinsicsConfig:
    """A lens as configuration: ten thousandths of a pixel, and what of the distortion makes as much."""
    m = lens.camera.matrix
    fx, fy, cx, cy = (round(float(m[place]), 4) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    distortion = tuple(round(k, 8) for k in lens.camera.distortion)
    return IntrinsicsConfig(model=lens.model, fx=fx, fy=fy, cx=cx, cy=cy, distortion=distortion, measured=measured)


def extrinsics_of(T_body_camera: RigidTransform, measured: MeasurementConfig) -> ExtrinsicsConfig:
    """A mounting as configuration: ten thousandths of a degree, hundredths of a millimetre."""
    roll, pitch, yaw = euler_from_rotation(T_body_camera.rotation @ _looking_forward().T)
    x, y, z = (round(float(value), 5) + 0.0 for value in T_body_camera.translation)
    return ExtrinsicsConfig(
        position_m=(x, y, z),
        yaw_deg=round(math.degrees(yaw), 4) + 0.0,
        pitch_deg=round(math.degrees(pitch), 4) + 0.0,
        roll_deg=round(math.degrees(roll), 4) + 0.0,
        measured=measured,
    )


def rig_text(cameras: Sequence[CameraConfig], comment: Sequence[str], time_offset_s: float = 0.0) -> str:
    """A YAML file with a `rig` section and nothing else; ``comment``: lines to stand above it."""
    lines = [*(f"# {line}".rstrip() for line in comment), "rig:"]
    if time_offset_s:
        lines.append(f"  time_offset_s: {time_offset_s:.4f}")
    lines.append("  cameras:")
    for camera in cameras:
        values = camera.model_dump(mode="json", exclude_defaults=True)
        model = {"model": camera.intrinsics.model}  # worth saying, although it may be the default
        values["intrinsics"] = {**model, **values["intrinsics"]}
        for number, (key, value) in enumerate(values.items()):
            lines.append(f"    {'-' if number == 0 else ' '} {key}:{_value(value)}")
    return "\n".join(lines) + "\n"


def _value(value: object) -> str:
    if not isinstance(value, dict):
        return " " + yaml.safe_dump(value, default_flow_style=True, width=math.inf).removesuffix("...\n").strip()
    lines = []
    for key, inner in value.items():
        text = yaml.safe_dump(inner, default_flow_style=True, sort_keys=False, width=math.inf, allow_unicode=True)
        lines.append(f"        {key}: {text.removesuffix('...' + chr(10)).strip()}")
    return "\n" + "\n".join(lines)


def _looking_forward() -> FloatArray:
    """(3, 3) ``R_body_camera`` of a camera that is mounted without any turn."""
    plain = CameraConfig(name="any", size_px=(64, 64), intrinsics=IntrinsicsConfig(fx=1.0, fy=1.0, cx=1.0, cy=1.0))
    return build_rig(RigConfig(cameras=(plain,))).cameras["any"].T_body_camera.rotation
