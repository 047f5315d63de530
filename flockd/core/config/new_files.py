"""Commented configuration files to begin with, for `flockd config new`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from flockd.core.config.mission import MissionKind
from flockd.core.config.obstacle_field import ObstacleKind

SPACING_M = 3.5
"""Between neighbours on the ring of start positions, as the law wants them; `flocking.desired_distance_m`."""
LEAST_RADIUS_M = 3.0
LAYERS_M = (4.5, 3.5, 5.0, 3.0, 4.0)
"""Heights in turn, so that no two neighbours on the ring are at one."""


_SETS = ("  set_tolerance_s: 0.02", "  set_wait_s: 0.1")


@dataclass(frozen=True)
class NewDrone:
    """What is asked of somebody who configures a drone."""

    name: str = "drone1"
    cameras: int = 4
    size_px: tuple[int, int] = (640, 480)
    field_of_view_deg: float = 120.0
    """Of an image's width."""
    source: Literal["v4l2", "gstreamer", "shared_memory"] = "v4l2"
    autopilot: str = "serial:///dev/ttyAMA0:921600"
    fleet: str = "fleet"
    mission: MissionKind = "hover"


@dataclass(frozen=True)
class NewScenario:
    """What is asked of somebody who wants a simulated flight."""

    name: str = "my_flight"
    drones: int = 5
    duration_s: float = 60.0
    mission: MissionKind = "circle_then_tangent"
    obstacles: ObstacleKind | Literal["none"] = "none"
    drone_file: str = "simulator.yaml"


def drone_text(new: NewDrone) -> str:
    """A drone's file: its cameras look evenly around, and have perfect wide-angle lenses until they are calibrated."""
    names = camera_names(new.cameras)
    lines = [
        "# A drone for `flockd run`. Fill in what is marked `fill in`. Then run `flockd config check` on it, and",
        "# `flockd doctor` on the drone. `flockd config schema drone` lists every key there is.",
        f"name: {new.name}    # different for each drone of a fleet",
        "step_s: 0.5",
        "",
        *rig_lines(dict.fromkeys(names, new.size_px), new.field_of_view_deg),
    ]
    lines += ["", *_source(new, names), "", "perception:", "  threads: 2", "  scale: height"]
    lines += ["  height: best    # a range finder that faces down, else the barometer", "own_velocity: vision"]
    lines += ["yaw: course", "", *_mission(new.mission), ""]
    lines += [
        "autopilot:",
        f"  address: {new.autopilot}",
        "  arm_and_take_off: false    # you arm, take off and select offboard, and can take over at any time",
        "",
        "safety:",
        "  gate:",
        "    fence_radius_m: 50.0     # around home",
        "    min_height_m: 1.5",
        "    max_height_m: 10.0",
        "",
        "telemetry:",
        f"  fleet: {new.fleet}",
        "  listen: [tcp/0.0.0.0:7447]    # anyone who reaches this computer may watch",
        "  commands: []                  # of hold, land, resume, goto and velocity, what watchers may ask for",
    ]
    return "\n".join(lines) + "\n"


def scenario_text(new: NewScenario) -> str:
    """A scenario's file: the drones begin on a ring, in layers."""
    radius_m = 0.0 if new.drones == 1 else max(new.drones * SPACING_M / (2 * math.pi), LEAST_RADIUS_M)
    lines = [
        "# A simulated flight for `flockd sim`; `--perception truth` flies it in seconds, on exact states.",
        "# `flockd config schema scenario` lists every key there is.",
        f"scenario: {new.name}",
        f"duration_s: {new.duration_s:g}",
        "seed: 0                  # of the world and of all noise",
        f"drone: {new.drone_file}    # the drones' own configuration; the path counts from this file's folder",
        "",
        *_mission(new.mission),
        "",
        *_obstacles(new.obstacles),
        "vehicle:",
        "  wind_m_s: [0.0, 0.0]   # north, east",
        "  gust_m_s: 0.0          # standard deviation of the velocity that gusts add",
        "",
        "# north, east, down in metres: a height of 4.5 m is -4.5. A vehicle may have a `mission` of its own.",
        "vehicles:",
    ]
    for number in range(new.drones):
        angle = 2 * math.pi * number / new.drones
        north_m, east_m = radius_m * math.cos(angle), radius_m * math.sin(angle)
        down_m = -LAYERS_M[number % len(LAYERS_M)]
        lines.append(f"  - {{position_m: [{_plain(north_m)}, {_plain(east_m)}, {down_m}]}}")
    return "\n".join(lines) + "\n"


def rig_lines(sizes: Mapping[str, tuple[int, int]], field_of_view_deg: float) -> list[str]:
    """The section `rig`: cameras that look evenly around, with perfect wide-angle lenses. ``sizes`` by name."""
    lines = [
        "rig:",
        "  # Fill in: intrinsics and extrinsics, by `flockd calibrate camera` and `flockd calibrate rig`. A",
        "  # lens that is 2 % off puts every neighbour 2 % off. position_m: forward, right, down from the middle.",
        "  cameras:",
    ]
    for number, (name, (width, height)) in enumerate(sizes.items()):
        yaw_deg = 360.0 * number / len(sizes)
        forward_m, right_m = 0.1 * math.cos(math.radians(yaw_deg)), 0.1 * math.sin(math.radians(yaw_deg))
        focal_px = width / 2 / math.radians(field_of_view_deg / 2)
        lines += [
            f"    - name: {name}",
            f"      size_px: [{width}, {height}]",
            f"      intrinsics: {{model: wide_angle, fx: {focal_px:.1f}, fy: {focal_px:.1f}, cx: {width / 2}, "
            f"cy: {height / 2}}}",
            f"      extrinsics: {{position_m: [{_plain(forward_m)}, {_plain(right_m)}, 0.0], yaw_deg: {yaw_deg:g}}}",
        ]
    return lines


def camera_names(count: int) -> Sequence[str]:
    """Clockwise from the one that looks forward."""
    named = {1: ("front",), 2: ("front", "back"), 4: ("front", "right", "back", "left")}
    return named.get(count, tuple(f"camera{number + 1}" for number in range(count)))


def _source(new: NewDrone, names: Sequence[str]) -> list[str]:
    if new.source == "shared_memory":
        return [
            "source:    # another program publishes the frames; see the documentation of `flockd.onboard.sources`",
            "  kind: shared_memory",
            "  set_tolerance_s: 0.01",
            "  shared_memory:",
            f"    drone: {new.name}",
            "    connect: [tcp/127.0.0.1:7448]    # fill in: where that program listens",
            "    rate_hz: 10.0",
        ]
    if new.source == "gstreamer":
        return [
            "source:",
            "  kind: gstreamer",
            "  # Fill in: what `gst-launch-1.0` takes, without a sink. `flockd cameras --write FILE` writes this",
            "  # section for what is plugged in.",
            "  cameras:",
            *(
                f"    - {{name: {name}, pipeline: nvarguscamerasrc sensor-id={number} ! nvvidconv, rate_hz: 30}}"
                for number, name in enumerate(names)
            ),
            *_SETS,
        ]
    lines = [
        "source:",
        "  kind: v4l2",
        "  # Fill in: the socket of each camera and its own controls, for a short, fixed exposure: `flockd cameras",
        "  # --write FILE` writes this section for what is plugged in.",
        "  cameras:",
    ]
    for number, name in enumerate(names):
        lines += [
            f"    - name: {name}",
            f"      device: /dev/v4l/by-path/CHANGE-ME-{number}-video-index0",
            "      pixel_format: mjpeg",
            "      rate_hz: 30",
        ]
    return [*lines, *_SETS]


def _mission(kind: MissionKind) -> list[str]:
    of_kind = {
        "circle_then_tangent": ["  speed_m_s: 1.0", "  radius_m: 10.0", "  circle_until_s: 66.0"],
        "hover": [],
        "velocity": ["  velocity_m_s: [0.5, 0.0]    # north, east"],
        "waypoints": [
            "  speed_m_s: 1.0",
            "  waypoints:    # metres north and east of home; or latitude_deg and longitude_deg; and height_m",
            "    - {north_m: 15.0, east_m: 0.0}",
            "    - {north_m: 15.0, east_m: 15.0}",
            "  at_end: hold    # or land, or return",
        ],
        "follow": [],
        "operator": [
            "  speed_m_s: 0.5    # to an operator's goal; `telemetry.commands` has to allow goto and velocity"
        ],
    }
    return ["mission:    # where it wants to go", f"  kind: {kind}", *of_kind[kind]]


def _obstacles(kind: ObstacleKind | Literal["none"]) -> list[str]:
    of_kind = {
        "forest": ["    trees_per_hectare: 100.0    # 50 to 400"],
        "village": ["    houses_per_hectare: 8.0     # 2 to 16"],
    }
    if kind == "none":
        return []
    return [
        "obstacles:",
        "  enabled: true          # the drones fly around what they see",
        "world:",
        "  obstacles:             # drawn from the seed; the places where drones begin stay free",
        f"    kind: {kind}",
        *of_kind[kind],
        "",
    ]


def _plain(metres: float) -> str:
    """To the centimetre, and never -0.0."""
    return f"{round(metres, 2) + 0.0:g}"
