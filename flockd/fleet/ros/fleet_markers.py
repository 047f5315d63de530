"""Markers of a drone for RViz, in the frame `map`: one MarkerArray, which replaces the one before. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from flockd.core.messages import FloatArray
from flockd.fleet.drone_rows import GONE, QUIET, Row
from flockd.fleet.ros.message_trees import LEVEL_TURN, Tree, header, turn, vector
from flockd.fleet.ros.ros_frames import MAP, attitude_in_ros, attitude_of_angles, enu_of_ned

COURSE_S = 2.0
"""Time ahead to which a course is drawn."""
COLOURS = (
    (0.0, 0.45, 0.7),
    (0.9, 0.62, 0.0),
    (0.0, 0.62, 0.45),
    (0.84, 0.37, 0.0),
    (0.8, 0.47, 0.65),
    (0.34, 0.7, 0.91),
)
_FENCE, _LABEL = (0.8, 0.2, 0.2), (1.0, 1.0, 1.0)
_ARROW, _SPHERE, _CYLINDER, _LINE_STRIP, _TEXT = 0, 2, 3, 4, 9
_DELETE_ALL = 3
_ABOVE = np.array([0.0, 0.0, 0.6])
"""Distance of a drone's name from the drone, metres."""


def markers(time_ns: int, name: str, number: int, row: Row) -> Tree:
    """Markers of one drone; only their deletion if its position is not known. ``number`` chooses its colour."""
    drawn: list[Tree] = [{"header": header(time_ns, MAP), "action": _DELETE_ALL}]
    if row["position_ne"] is not None:
        place = home_in_map(row) + enu_of_ned(np.array([*row["position_ne"], -(row["height_m"] or 0.0)]))
        colour = COLOURS[number % len(COLOURS)]
        parts = [
            *_body(name, row, place, colour),
            *_course(row, place, colour),
            *_neighbours(row, place, colour),
            *_fence(row),
        ]
        drawn += [{"header": header(time_ns, MAP), "ns": name, "id": i, **part} for i, part in enumerate(parts)]
    return {"markers": drawn}


def home_in_map(row: Row) -> FloatArray:
    """(3,) metres to the drone's home; zeros if it is not known."""
    return enu_of_ned(np.array([*(row["home_ne"] or (0.0, 0.0)), 0.0]))


def _body(name: str, row: Row, place: FloatArray, colour: tuple[float, ...]) -> Iterable[Tree]:
    """A disc, its nose, and its name."""
    gone = row["state"] in {GONE, QUIET}
    R = attitude_in_ros(attitude_of_angles(*(row[f"{angle}_deg"] or 0.0 for angle in ("roll", "pitch", "yaw"))))
    pose = {"position": vector(place), "orientation": turn(R)}
    tint = _tint(colour, 0.4 if gone else 1.0)
    yield {"type": _CYLINDER, "pose": pose, "scale": vector((0.5, 0.5, 0.12)), "color": tint}
    yield {"type": _ARROW, "pose": pose, "scale": vector((0.6, 0.06, 0.16)), "color": tint}
    text = name if row["state"] == "normal" else f"{name}: {row['state']}"
    above = {"position": vector(place + _ABOVE), "orientation": LEVEL_TURN}
    yield {"type": _TEXT, "pose": above, "scale": vector((0.0, 0.0, 0.3)), "color": _tint(_LABEL), "text": text}


def _course(row: Row, place: FloatArray, colour: tuple[float, ...]) -> Iterable[Tree]:
    """The estimated course, thick; the flocking law's command, thin; and the goal."""
    for velocity, alpha, thickness_m in ((row["velocity_ned"], 1.0, 0.08), (row["command_ne"], 0.5, 0.03)):
        if velocity is not None:
            end = place + COURSE_S * enu_of_ned(np.array([*velocity, 0.0][:3]))
            yield _lines([place, end], _tint(colour, alpha), thickness_m)
    if row["goal_ne"] is not None:
        goal = home_in_map(row) + enu_of_ned(np.array([*row["goal_ne"], 0.0]))
        goal[2] = place[2] if row["goal_height_m"] is None else row["goal_height_m"]
        yield _sphere(goal, 0.5, _tint(colour, 0.6))


def _neighbours(row: Row, place: FloatArray, colour: tuple[float, ...]) -> Iterable[Tree]:
    """Its neighbours: a sphere of one standard deviation at the end of a line."""
    for one in (one for one in row["sees"] if one["ned"] is not None):
        there = place + enu_of_ned(np.array(one["ned"]))
        tint = _tint(colour, 0.6 if one["confirmed"] else 0.25)
        yield _sphere(there, max(0.3, 2.0 * (one["sigma_m"] or 0.0)), tint)
        yield _lines([place, there], tint, 0.02)


def _fence(row: Row) -> Iterable[Tree]:
    """The fence, on the ground."""
    fence, home = row["fence"] or {}, home_in_map(row)
    angles = np.linspace(0.0, 2 * math.pi, 73)
    circle = (fence.get("radius_m") or 0.0) * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    corners = [enu_of_ned(np.array([*corner, 0.0])) for corner in fence.get("corners_m") or ()]
    for points in (circle if circle.any() else [], [*corners, *corners[:1]]):
        if len(points):
            yield _lines([home + point for point in points], _tint(_FENCE, 0.8), 0.1)


def _lines(points: Iterable[FloatArray], tint: Tree, thickness_m: float) -> Tree:
    pose: dict[str, Any] = {"position": vector((0.0, 0.0, 0.0)), "orientation": LEVEL_TURN}
    scale = vector((thickness_m, 0.0, 0.0))
    return {"type": _LINE_STRIP, "pose": pose, "scale": scale, "color": tint, "points": [vector(one) for one in points]}


def _sphere(place: FloatArray, diameter_m: float, tint: Tree) -> Tree:
    pose = {"position": vector(place), "orientation": LEVEL_TURN}
    return {"type": _SPHERE, "pose": pose, "scale": vector([diameter_m] * 3), "color": tint}


def _tint(colour: tuple[float, ...], alpha: float = 1.0) -> Tree:
    return dict(zip("rgba", (*colour, alpha), strict=True))
