"""Commented configuration files to begin with, from `config/templates`."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from string import Template
from typing import Literal

from flockd.core.data import data_path

SPACING_M = 3.5
"""Between neighbours on the ring of start positions, as the law wants them; `flocking.desired_distance_m`."""
LEAST_RADIUS_M = 3.0
LAYERS_M = (4.5, 3.5, 5.0, 3.0, 4.0)
"""Heights in turn, so that no two neighbours on the ring are at one."""

CHANGE_ME = "CHANGE-ME"
"""Stands for what only its owner knows."""
_SOURCE_CAMERA = {
    "v4l2": """\
    - name: {name}
      device: /dev/v4l/by-path/{change_me}-{number}-video-index0
      pixel_format: mjpeg
      rate_hz: 30{turned}""",
    "gstreamer": (
        "    - {{name: {name}, pipeline: nvarguscamerasrc sensor-id={number} ! nvvidconv{turned}, rate_hz: 30}}"
    ),
    "ros": "    - {{name: {name}, topic: /{name}/image_raw, rate_hz: 30}}",
    "shared_memory": "",
}
_TURNED = {"v4l2": "\n      turn_deg: 90", "gstreamer": " flip-method=3"}
"""By a quarter, clockwise."""


def new_file(kind: Literal["drone", "scenario"], values: Mapping[str, str], chosen: Collection[str]) -> str:
    """The template with its `$names` filled in. A line that begins with `#[a|b]` is for the choices `a` and `b`."""
    template = (data_path("config") / "templates" / f"{kind}.yaml").read_text(encoding="utf-8")
    text = re.sub(
        r"^#\[([\w|]+)\] ?(.*\n)",
        lambda line: line[2] if set(line[1].split("|")) & set(chosen) else "",
        template,
        flags=re.MULTILINE,
    )
    return Template(text).substitute(values)


def rig_cameras(sizes: Mapping[str, tuple[int, int]], field_of_view_deg: float) -> str:
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


def source_cameras(kind: str, names: Sequence[str], *, upright: bool) -> str:
    """The list `source.cameras` for cameras that are yet to be named by their sockets; upright: on their sides."""
    turned = _TURNED.get(kind, "") if upright else ""
    return "\n".join(
        _SOURCE_CAMERA[kind].format(name=name, number=number, change_me=CHANGE_ME, turned=turned)
        for number, name in enumerate(names)
    )


def start_positions(drones: int) -> str:
    """The list `vehicles`: on a ring, in layers."""
    radius_m = 0.0 if drones == 1 else max(drones * SPACING_M / (2 * math.pi), LEAST_RADIUS_M)
    lines = []
    for number in range(drones):
        angle = 2 * math.pi * number / drones
        north_m, east_m = radius_m * math.cos(angle), radius_m * math.sin(angle)
        down_m = -LAYERS_M[number % len(LAYERS_M)]
        lines.append(f"  - {{position_m: [{_plain(north_m)}, {_plain(east_m)}, {down_m}]}}")
    return "\n".join(lines)


def camera_names(count: int) -> Sequence[str]:
    """Clockwise from the one that looks forward."""
    named = {1: ("front",), 2: ("front", "back"), 4: ("front", "right", "back", "left")}
    return named.get(count, tuple(f"camera{number + 1}" for number in range(count)))


def _plain(metres: float) -> str:
    """To the centimetre, and never -0.0."""
    return f"{round(metres, 2) + 0.0:g}"
