"""The 3D scene: for each drone one entity on each topic, in the place of the one before."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove.messages import (
    ArrowPrimitive,
    Color,
    CylinderPrimitive,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneEntityDeletionType,
    SceneUpdate,
    SpherePrimitive,
    TextPrimitive,
    Timestamp,
    Vector3,
)

from flockd.core.messages import FloatArray
from flockd.fleet.fleet_status import GONE, QUIET
from flockd.fleet.foxglove.map_places import MAP, Message, enu, vector
from flockd.fleet.page.drone_rows import Row

COURSE_S = 2.0
"""A course leads to where the drone is then."""
PATH_POINTS = 240
"""A minute of updates."""
_BODY_M = 0.5
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#a39400", "#808890")
"""Of drones, in the order in which they appear: the page's."""
_FENCE = Color(r=0.8, g=0.2, b=0.2, a=0.8)
_OBSTACLE = Color(r=0.45, g=0.45, b=0.45, a=1.0)
_LABEL = Color(r=1.0, g=1.0, b=1.0, a=1.0)
_LEVEL = Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)


@dataclass(frozen=True)
class SceneDrone:
    """What is drawn of one drone."""

    name: str
    row: Row
    place: FloatArray
    """(3,) metres in `map`."""
    colour: str
    """#rrggbb."""
    path: tuple[FloatArray, ...]
    messages: Mapping[str, Message]
    """The newest by topic, of those that say anything of now."""

    @property
    def lost(self) -> bool:
        """It is drawn where it was last."""
        return self.row["state"] in {GONE, QUIET}


class Scene:
    """Remembers paths, and gives the messages of `SCENE_TOPICS`."""

    def __init__(self) -> None:
        self._paths: dict[str, deque[FloatArray]] = {}
        self._colours: dict[str, str] = {}

    def drone(self, name: str, row: Row, place: FloatArray, messages: Mapping[str, Message]) -> SceneDrone:
        """One to draw now; its place joins its path."""
        path = self._paths.setdefault(name, deque(maxlen=PATH_POINTS))
        if not path or not np.array_equal(path[-1], place):
            path.append(place)
        colour = self._colours.setdefault(name, COLOURS[len(self._colours) % len(COLOURS)])
        return SceneDrone(name, row, place, colour, tuple(path), messages)


def scene_update(topic: str, drones: Iterable[SceneDrone], stamp: Timestamp) -> SceneUpdate:
    """One entity a drone, without primitives where there is nothing to draw."""
    draw = SCENE_TOPICS[topic]
    return SceneUpdate(entities=[SceneEntity(timestamp=stamp, id=drone.name, **draw(drone)) for drone in drones])


def empty_scene() -> SceneUpdate:
    """Deletes all that was drawn."""
    return SceneUpdate(deletions=[SceneEntityDeletion(type=SceneEntityDeletionType.All)])


def _body(drone: SceneDrone) -> dict[str, Any]:
    """In the drone's own frame, so that it turns with it."""
    colour = _colour(drone.colour, 0.4 if drone.lost else 1.0)
    tilt = Pose(position=Vector3(x=0.0, y=0.0, z=0.0), orientation=_LEVEL)
    disc = CylinderPrimitive(
        pose=tilt, size=Vector3(x=_BODY_M, y=_BODY_M, z=0.12), bottom_scale=1.0, top_scale=1.0, color=colour
    )
    nose = ArrowPrimitive(
        pose=tilt, shaft_length=0.4, shaft_diameter=0.06, head_length=0.2, head_diameter=0.16, color=colour
    )
    return {"frame_id": drone.name, "cylinders": [disc], "arrows": [nose], "texts": [_label(drone)]}


def _label(drone: SceneDrone) -> TextPrimitive:
    state = drone.row["state"]
    text = drone.name if state == "normal" else f"{drone.name}: {state}"
    above = Pose(position=Vector3(x=0.0, y=0.0, z=-0.6), orientation=_LEVEL)
    return TextPrimitive(pose=above, billboard=True, font_size=14.0, scale_invariant=True, color=_LABEL, text=text)


def _course(drone: SceneDrone) -> dict[str, Any]:
    """Of the drone's own estimate, thick; what the flock law asks for, thin."""
    lines = []
    velocity = drone.messages.get("state", {}).get("velocity_ned")
    if velocity is not None:
        lines.append(_line([drone.place, drone.place + COURSE_S * enu(velocity)], _colour(drone.colour), 0.08))
    command = drone.messages.get("command", {}).get("velocity_ne")
    if command is not None:
        end = drone.place + COURSE_S * enu(command[:2])
        lines.append(_line([drone.place, end], _colour(drone.colour, 0.5), 0.03))
    return {"frame_id": MAP, "lines": lines, "spheres": list(_goal(drone))}


def _goal(drone: SceneDrone) -> Iterator[SpherePrimitive]:
    mission = drone.messages.get("mission", {})
    if mission.get("goal_ne") is None:
        return
    height = mission["goal_height_m"]
    up = drone.place[2] if height is None else height
    place = enu((*mission["goal_ne"][:2], -up)) + enu(drone.row["home_ne"] or ())
    yield _sphere(place, 0.5, _colour(drone.colour, 0.6))


def _path(drone: SceneDrone) -> dict[str, Any]:
    lines = [_line(drone.path, _colour(drone.colour, 0.5), 0.04)] if len(drone.path) > 1 else []
    return {"frame_id": MAP, "lines": lines}


def _neighbours(drone: SceneDrone) -> dict[str, Any]:
    """Where it believes others to be: a sphere of one standard deviation at the end of a line."""
    spheres, lines = [], []
    for one in drone.messages.get("neighbours", {}).get("neighbours", ()):
        place = drone.place + enu(one["position_ned"])
        colour = _colour(drone.colour, 0.6 if one["confirmed"] else 0.25)
        spheres.append(_sphere(place, max(0.3, 2.0 * (one["position_sigma_m"] or 0.0)), colour))
        lines.append(_line([drone.place, place], colour, 0.02))
    return {"frame_id": MAP, "spheres": spheres, "lines": lines}


def _obstacles(drone: SceneDrone) -> dict[str, Any]:
    """A piece of a circle in each direction in which something is near, at the drone's height."""
    ranges = drone.messages.get("obstacles", {}).get("range_m", ())
    half = math.pi / max(len(ranges), 1)
    points = [
        drone.place + range_m * np.array([math.sin(azimuth), math.cos(azimuth), 0.0])
        for sector, range_m in enumerate(ranges)
        if range_m is not None
        for azimuth in ((2 * sector - 1) * half, (2 * sector + 1) * half)
    ]
    lines = [_line(points, _OBSTACLE, 0.15, LinePrimitiveLineType.LineList)] if points else []
    return {"frame_id": MAP, "lines": lines}


def _fence(drone: SceneDrone) -> dict[str, Any]:
    """On the ground."""
    fence, (north, east) = drone.row["fence"] or {}, drone.row["home_ne"] or (0.0, 0.0)
    home, loops = np.array([east, north, 0.0]), []
    if fence.get("radius_m"):
        angles = np.linspace(0.0, 2 * math.pi, 72, endpoint=False)
        loops.append([home + fence["radius_m"] * np.array([math.sin(a), math.cos(a), 0.0]) for a in angles])
    if fence.get("corners_m"):
        loops.append([home + enu((*corner, 0.0)) for corner in fence["corners_m"]])
    return {"frame_id": MAP, "lines": [_line(loop, _FENCE, 0.1, LinePrimitiveLineType.LineLoop) for loop in loops]}


SCENE_TOPICS: dict[str, Callable[[SceneDrone], dict[str, Any]]] = {
    "/scene/drones": _body,
    "/scene/courses": _course,
    "/scene/paths": _path,
    "/scene/neighbours": _neighbours,
    "/scene/obstacles": _obstacles,
    "/scene/fences": _fence,
}
"""What draws each."""


def _line(
    points: Iterable[FloatArray],
    colour: Color,
    thickness_m: float,
    kind: LinePrimitiveLineType = LinePrimitiveLineType.LineStrip,
) -> LinePrimitive:
    corners = [Point3(x=x, y=y, z=z) for x, y, z in (point.tolist() for point in points)]
    return LinePrimitive(
        type=kind, pose=Pose(position=vector(np.zeros(3)), orientation=_LEVEL), points=corners,
        thickness=thickness_m, color=colour,
    )  # fmt: skip


def _sphere(place: FloatArray, diameter_m: float, colour: Color) -> SpherePrimitive:
    size = Vector3(x=diameter_m, y=diameter_m, z=diameter_m)
    return SpherePrimitive(pose=Pose(position=vector(place), orientation=_LEVEL), size=size, color=colour)


def _colour(text: str, alpha: float = 1.0) -> Color:
    red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return Color(r=red, g=green, b=blue, a=alpha)
