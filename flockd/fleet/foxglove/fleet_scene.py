"""The 3D scene in the frame `map`: metres east, north and up from the home of the first drone by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import foxglove.messages as fm
import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.earth import degrees_apart, metres_a_degree
from flockd.core.messages import FloatArray
from flockd.fleet.fleet_status import GONE, QUIET
from flockd.fleet.page.drone_rows import Row

MAP = "map"
COURSE_S = 2.0
"""A course leads to where the drone is then."""
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#a39400", "#808890")
"""The drones' colours, in the order in which they appear: the page's."""
_BODY_M = 0.5
_FENCE = fm.Color(r=0.8, g=0.2, b=0.2, a=0.8)
_OBSTACLE = fm.Color(r=0.45, g=0.45, b=0.45, a=1.0)
_LABEL = fm.Color(r=1.0, g=1.0, b=1.0, a=1.0)
_ENU_NED = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class SceneDrone:
    """What is drawn of one drone."""

    name: str
    row: Row
    place: FloatArray
    """(3,) metres in `map`."""
    path: Sequence[FloatArray]
    """Where it was until now."""
    colour: str
    """#rrggbb."""

    def tint(self, alpha: float = 1.0) -> fm.Color:
        """Its colour."""
        red, green, blue = (int(self.colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
        return fm.Color(r=red, g=green, b=blue, a=alpha)


def enu(ned: Iterable[float]) -> FloatArray:
    """(3,) east, north, up of north, east and, unless it is 0, down."""
    north, east, down = (*ned, 0.0)[:3]
    return np.array([east, north, -down])


def place_of(row: Row) -> FloatArray | None:
    """(3,) metres in `map`; None where the position is not known."""
    if row["position_ne"] is None:
        return None
    height_m = row["height_m"] or 0.0
    return enu(row["position_ne"]) + enu((*(row["home_ne"] or (0.0, 0.0)), -height_m))


def attitude(row: Row) -> Rotation:
    """From a drone's body (forward, right, down) to north, east, down; level and to the north where it tells none."""
    return Rotation.from_euler("ZYX", [row[f"{name}_deg"] or 0.0 for name in ("yaw", "pitch", "roll")], degrees=True)


def body_transform(stamp: fm.Timestamp, drone: SceneDrone) -> fm.FrameTransform:
    """From a drone's body (forward, right, down) to the map."""
    return transform(stamp, MAP, drone.name, drone.place, _ENU_NED * attitude(drone.row))


def transform(stamp: fm.Timestamp, parent: str, child: str, place: FloatArray, turn: Rotation) -> fm.FrameTransform:
    """From a frame at (3,) metres in its parent to that one."""
    x, y, z, w = turn.as_quat().tolist()
    return fm.FrameTransform(
        timestamp=stamp, parent_frame_id=parent, child_frame_id=child,
        translation=_vector(place), rotation=fm.Quaternion(x=x, y=y, z=z, w=w),
    )  # fmt: skip


def location_fix(stamp: fm.Timestamp, drone: str, row: Row) -> fm.LocationFix | None:
    """Where a drone is on the earth; None where its position or its home is not known."""
    home, position = row["home_deg"], row["position_ne"]
    if home is None or position is None:
        return None
    a_degree = metres_a_degree(home[0])
    latitude, longitude = (home[i] + position[i] / a_degree[i] for i in range(2))
    # The height above the ellipsoid is not known: 0, as the schema has no other way.
    return fm.LocationFix(timestamp=stamp, frame_id=drone, latitude=latitude, longitude=degrees_apart(longitude, 0.0))


def scene_update(topic: str, drones: Iterable[SceneDrone], stamp: fm.Timestamp) -> fm.SceneUpdate:
    """One entity a drone in the place of the one before, without primitives where there is nothing to draw."""
    draw = SCENE_TOPICS[topic]
    return fm.SceneUpdate(
        entities=[fm.SceneEntity(timestamp=stamp, id=one.name, **{"frame_id": MAP, **draw(one)}) for one in drones]
    )


def empty_scene() -> fm.SceneUpdate:
    """Deletes all that was drawn."""
    return fm.SceneUpdate(deletions=[fm.SceneEntityDeletion(type=fm.SceneEntityDeletionType.All)])


def _body(drone: SceneDrone) -> dict[str, Any]:
    """In the drone's own frame, so that it turns with it."""
    state, colour = drone.row["state"], drone.tint(0.4 if drone.row["state"] in {GONE, QUIET} else 1.0)
    disc = fm.CylinderPrimitive(
        pose=_pose(), size=fm.Vector3(x=_BODY_M, y=_BODY_M, z=0.12), bottom_scale=1.0, top_scale=1.0, color=colour
    )
    nose = fm.ArrowPrimitive(
        pose=_pose(), shaft_length=0.4, shaft_diameter=0.06, head_length=0.2, head_diameter=0.16, color=colour
    )
    label = fm.TextPrimitive(
        pose=_pose((0.0, 0.0, -0.6)), billboard=True, font_size=14.0, scale_invariant=True, color=_LABEL,
        text=drone.name if state == "normal" else f"{drone.name}: {state}",
    )  # fmt: skip
    return {"frame_id": drone.name, "cylinders": [disc], "arrows": [nose], "texts": [label]}


def _course(drone: SceneDrone) -> dict[str, Any]:
    """The drone's own estimate, thick; what the flock law asks for, thin; and the goal."""
    row, lines, spheres = drone.row, [], []
    for velocity, alpha, thickness_m in ((row["velocity_ned"], 1.0, 0.08), (row["command_ne"], 0.5, 0.03)):
        if velocity is not None:
            end = drone.place + COURSE_S * enu(velocity)
            lines.append(_line([drone.place, end], drone.tint(alpha), thickness_m))
    if row["goal_ne"] is not None:
        goal = enu(row["goal_ne"]) + enu(row["home_ne"] or (0.0, 0.0))
        goal[2] = drone.place[2] if row["goal_height_m"] is None else row["goal_height_m"]
        spheres.append(_sphere(goal, 0.5, drone.tint(0.6)))
    return {"lines": lines, "spheres": spheres}


def _path(drone: SceneDrone) -> dict[str, Any]:
    return {"lines": [_line(drone.path, drone.tint(0.5), 0.04)] if drone.path else []}


def _neighbours(drone: SceneDrone) -> dict[str, Any]:
    """Where it believes others to be: a sphere of one standard deviation at the end of a line."""
    spheres, lines = [], []
    for one in (one for one in drone.row["sees"] if one["ned"] is not None):
        place = drone.place + enu(one["ned"])
        colour = drone.tint(0.6 if one["confirmed"] else 0.25)
        spheres.append(_sphere(place, max(0.3, 2.0 * (one["sigma_m"] or 0.0)), colour))
        lines.append(_line([drone.place, place], colour, 0.02))
    return {"spheres": spheres, "lines": lines}


def _obstacles(drone: SceneDrone) -> dict[str, Any]:
    """A piece of a circle in each direction in which something is near, at the drone's height."""
    ranges = drone.row["obstacles_m"] or ()
    half = math.pi / max(len(ranges), 1)
    points = [
        drone.place + _level(range_m, azimuth)
        for sector, range_m in enumerate(ranges)
        if range_m is not None
        for azimuth in ((2 * sector - 1) * half, (2 * sector + 1) * half)
    ]
    return {"lines": [_line(points, _OBSTACLE, 0.15, fm.LinePrimitiveLineType.LineList)] if points else []}


def _fence(drone: SceneDrone) -> dict[str, Any]:
    """On the ground."""
    fence, home, loops = drone.row["fence"] or {}, enu(drone.row["home_ne"] or (0.0, 0.0)), []
    if fence.get("radius_m"):
        angles = np.linspace(0.0, 2 * math.pi, 72, endpoint=False)
        loops.append([home + _level(fence["radius_m"], angle) for angle in angles])
    if fence.get("corners_m"):
        loops.append([home + enu(corner) for corner in fence["corners_m"]])
    return {"lines": [_line(loop, _FENCE, 0.1, fm.LinePrimitiveLineType.LineLoop) for loop in loops]}


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
    colour: fm.Color,
    thickness_m: float,
    kind: fm.LinePrimitiveLineType = fm.LinePrimitiveLineType.LineStrip,
) -> fm.LinePrimitive:
    corners = [fm.Point3(x=x, y=y, z=z) for x, y, z in (point.tolist() for point in points)]
    return fm.LinePrimitive(type=kind, pose=_pose(), points=corners, thickness=thickness_m, color=colour)


def _sphere(place: FloatArray, diameter_m: float, colour: fm.Color) -> fm.SpherePrimitive:
    return fm.SpherePrimitive(pose=_pose(place), size=_vector([diameter_m] * 3), color=colour)


def _pose(place: Iterable[float] = (0.0, 0.0, 0.0)) -> fm.Pose:
    return fm.Pose(position=_vector(place), orientation=fm.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))


def _level(range_m: float, azimuth: float) -> FloatArray:
    return range_m * np.array([math.sin(azimuth), math.cos(azimuth), 0.0])


def _vector(values: Iterable[float]) -> fm.Vector3:
    x, y, z = map(float, values)
    return fm.Vector3(x=x, y=y, z=z)
