"""The sections `rig` and `source` of a drone's configuration for the cameras that are plugged in."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence

from flockd.core.errors import UsageError
from flockd.ground.cameras.found import FoundCamera, Mode

FIELD_OF_VIEW_DEG = 130.0
"""Written down until the lenses are calibrated."""
_BY_HAND = {"auto_exposure": 1, "exposure_auto": 1, "exposure_time_absolute": 50, "exposure_absolute": 50}
"""What cameras of the USB video class take for an exposure of 5 ms that is set by hand."""


def sections_text(cameras: Mapping[str, tuple[FoundCamera, Mode]], turn_deg: int = 0) -> str:
    """A commented file that `flockd config check` passes; cameras by their names in the rig.

    ``turn_deg``: as of `CameraDeviceParameters`. Raises UsageError where it is not 0 and one needs a pipeline.
    """
    as_pipelines = any(camera.element for camera, _ in cameras.values())
    if as_pipelines and turn_deg:
        raise UsageError(
            "--turn-deg is for USB cameras, and one of these needs a pipeline; add `videoflip` to each there"
        )
    sizes = {name: mode.size if turn_deg % 180 == 0 else mode.size[::-1] for name, (_, mode) in cameras.items()}
    lines = [
        "# Written by `flockd cameras`: the cameras of this computer, as sections of a drone's configuration.",
        "# Fill in which camera looks where: exchange the names. `flockd cameras --picture FOLDER` shows what each",
        "# sees.",
        "rig:",
        "  # Fill in: intrinsics and extrinsics, by `flockd calibrate camera` and `flockd calibrate rig`.",
        "  cameras:",
        _rig_cameras(sizes, FIELD_OF_VIEW_DEG),
        "source:",
        f"  kind: {'gstreamer' if as_pipelines else 'v4l2'}",
        "  cameras:",
    ]
    slowest_hz = min(mode.rates_hz[0] for _, mode in cameras.values())
    for name, (camera, mode) in cameras.items():
        parameters = camera.parameters(name, mode, as_pipeline=as_pipelines)
        where = f", {camera.node} now" if camera.node else ""
        lines.append(f"    - name: {name}    # {' '.join(camera.name.split())}{where}")
        if parameters.pipeline:
            lines.append(f"      pipeline: {json.dumps(parameters.pipeline, ensure_ascii=False)}")
        else:
            lines.append(f"      device: {json.dumps(parameters.device)}")
            lines.append(f"      pixel_format: {parameters.pixel_format}")
        lines.append(f"      rate_hz: {parameters.rate_hz:g}")
        if turn_deg:
            lines.append(f"      turn_deg: {turn_deg}")
        if not as_pipelines:
            lines += _controls(camera)
    tolerance_s = max(0.02, 0.6 / slowest_hz)
    silence_s = max(0.5, 3.0 / slowest_hz)
    lines += [
        f"  set_tolerance_s: {tolerance_s:.3g}    # half a frame period or more",
        f"  silence_s: {silence_s:.3g}",
    ]
    return "\n".join(lines) + "\n"


def _controls(camera: FoundCamera) -> list[str]:
    """A fixed, short exposure where the camera has the usual controls; the others as comments."""
    offered = {control.name: control for control in camera.controls}
    set_by_hand = [name for name in _BY_HAND if name in offered]
    lines = ["      controls:"] if set_by_hand else []
    for name in set_by_hand:
        low, high = offered[name].low, offered[name].high
        value = min(max(_BY_HAND[name], low), high)
        lines.append(f"        - {{name: {name}, value: {value}}}    # {low} to {high}")
    others = [f"{one.name} {one.low} to {one.high}" for one in camera.controls if one.name not in set_by_hand]
    return [*lines, *(f"      # also: {other}" for other in others)]


def camera_names(count: int) -> Sequence[str]:
    """Clockwise from the one that looks forward."""
    named = {1: ("front",), 2: ("front", "back"), 4: ("front", "right", "back", "left")}
    return named.get(count, tuple(f"camera{number + 1}" for number in range(count)))


def _rig_cameras(sizes: Mapping[str, tuple[int, int]], field_of_view_deg: float) -> str:
    """The list `rig.cameras`: they look evenly around, with perfect wide-angle lenses. ``sizes`` by name, in pixels.

    The field of view is that of the longer side.
    """
    lines = []
    for number, (name, (width, height)) in enumerate(sizes.items()):
        yaw_deg = 360.0 * number / len(sizes)
        forward_m, right_m = 0.1 * math.cos(math.radians(yaw_deg)), 0.1 * math.sin(math.radians(yaw_deg))
        focal_px = max(width, height) / 2 / math.radians(field_of_view_deg / 2)
        lines += [
            f"    - name: {name}",
            f"      size_px: [{width}, {height}]",
            f"      intrinsics: {{model: wide_angle, fx: {focal_px:.1f}, fy: {focal_px:.1f}, cx: {width / 2}, "
            f"cy: {height / 2}}}",
            f"      extrinsics: {{position_m: [{_plain(forward_m)}, {_plain(right_m)}, 0.0], yaw_deg: {yaw_deg:g}}}",
        ]
    return "\n".join((*lines, ""))


def _plain(metres: float) -> str:
    """To the centimetre, and never -0.0."""
    return f"{round(metres, 2) + 0.0:g}"
