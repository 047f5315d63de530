"""Calibrated numbers as configuration: a valid `rig` section that can be copied into a drone's file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import yaml

from flockd.core.config.rig import CameraConfig, ExtrinsicsConfig, MeasurementConfig
from flockd.flight.geometry import R_FRD_RDF, RigidTransform, euler_from_rotation


def measured_today(**facts: Any) -> MeasurementConfig:
    """What is known about numbers that were measured today; ``facts``: fields of MeasurementConfig but the date."""
    return MeasurementConfig(date=datetime.now(UTC).date().isoformat(), **facts)


def extrinsics_of(T_body_camera: RigidTransform, measured: MeasurementConfig) -> ExtrinsicsConfig:
    """A mounting as configuration: ten thousandths of a degree, hundredths of a millimetre."""
    roll, pitch, yaw = euler_from_rotation(T_body_camera.rotation @ R_FRD_RDF.T)
    x, y, z = (round(float(value), 5) + 0.0 for value in T_body_camera.translation)
    roll, pitch, yaw = (round(math.degrees(angle), 4) + 0.0 for angle in (roll, pitch, yaw))
    return ExtrinsicsConfig(position_m=(x, y, z), yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll, measured=measured)


def rig_text(cameras: Sequence[CameraConfig], comment: Sequence[str], time_offset_s: float = 0.0) -> str:
    """A YAML file with a `rig` section and nothing else; ``comment``: lines to stand above it."""
    rig: dict[str, Any] = {"time_offset_s": round(time_offset_s, 4)} if time_offset_s else {}
    rig["cameras"] = []
    for camera in cameras:
        values = camera.model_dump(mode="json", exclude_defaults=True)
        values["intrinsics"] = {"model": camera.intrinsics.model} | values["intrinsics"]  # said even if the default
        rig["cameras"].append(values)
    text: str = yaml.safe_dump(
        {"rig": rig}, default_flow_style=None, sort_keys=False, width=math.inf, allow_unicode=True
    )
    return "".join(f"# {line}".rstrip() + "\n" for line in comment) + text
