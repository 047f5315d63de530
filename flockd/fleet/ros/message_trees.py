"""ROS 2's standard messages as trees of plain values, built from flockd's. Pure: neither a clock nor ROS is needed.

A tree maps a message's fields to numbers, text, bytes, arrays, trees and lists of trees. Missing fields are 0, as in
new messages of `rclpy` (`ros_node.py`). Arguments are in flockd's axes, results in those of REP 103.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from flockd.core.messages import FloatArray
from flockd.fleet.ros import ros_frames as rf
from flockd.onboard.telemetry.topics import NeighbourMessage, ObstaclesMessage, StateMessage

Tree = dict[str, Any]
"""One message."""

ODOMETRY = "nav_msgs/msg/Odometry"
POSE_ARRAY = "geometry_msgs/msg/PoseArray"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
DIAGNOSTIC = "diagnostic_msgs/msg/DiagnosticStatus"
MARKERS = "visualization_msgs/msg/MarkerArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TWIST = "geometry_msgs/msg/TwistStamped"
POSE = "geometry_msgs/msg/PoseStamped"
IMU = "sensor_msgs/msg/Imu"
"""Names of the types, as ROS 2 writes them."""
OK, WARN, ERROR, STALE = range(4)
"""Levels of a DiagnosticStatus."""
LEVEL_TURN: Tree = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
_NS = 1_000_000_000
_FLOAT64, _UINT32, _UINT8 = 8, 6, 2  # of sensor_msgs/msg/PointField


def ros_name(name: str) -> str:
    """The nearest name that ROS 2 permits in a topic: letters, digits and `_`, without a digit at the beginning."""
    plain = re.sub(r"_+", "_", re.sub(r"[^A-Za-z0-9]", "_", name))
    return f"d{plain}" if plain[:1].isdigit() else plain or "drone"


class Names(NamedTuple):
    """REP 105's frames of one drone, each `DRONE/...`."""

    drone: str

    @property
    def odom(self) -> str:
        """East, north and up from the drone's home, as its autopilot has it."""
        return f"{self.drone}/odom"

    @property
    def base_link(self) -> str:
        """The body: forward, left, up."""
        return f"{self.drone}/base_link"

    @property
    def level(self) -> str:
        """East, north and up from the drone: in it are neighbours and obstacles."""
        return f"{self.drone}/level"


def header(time_ns: int, frame: str) -> Tree:
    """``time_ns``: since 1970."""
    return {"stamp": {"sec": time_ns // _NS, "nanosec": time_ns % _NS}, "frame_id": frame}


def vector(values: Iterable[float]) -> Tree:
    """A Vector3 or a Point."""
    x, y, z = map(float, values)
    return {"x": x, "y": y, "z": z}


def turn(R: FloatArray) -> Tree:
    """A Quaternion."""
    return dict(zip("xyzw", rf.quaternion_of(R).tolist(), strict=True))


def state_odometry(time_ns: int, names: Names, state: StateMessage) -> Tree | None:
    """Of telemetry's `state`: where the body is from home, and its velocity in its own axes, as the message's
    definition asks for. None where the drone does not know its position.

    Covariances are zero, which means not known. A velocity that is not known is zero with a variance of -1.
    """
    place, velocity_ned = _known(state["position_ne"], 2), _known(state["velocity_ned"], 3)
    if place is None or not _finite(state["height_m"]):
        return None
    position_ned, R_ned_frd = np.array([*place, -state["height_m"]]), attitude_of_state(state)
    R_enu_flu = rf.attitude_in_ros(R_ned_frd)
    body = R_ned_frd.T @ velocity_ned if velocity_ned is not None else np.zeros(3)
    return {
        "header": header(time_ns, names.odom),
        "child_frame_id": names.base_link,
        "pose": {
            "pose": {"position": vector(rf.enu_of_ned(position_ned)), "orientation": turn(R_enu_flu)},
        },
        "twist": {
            "twist": {"linear": vector(rf.flu_of_frd(body))},
            "covariance": np.array([0.0 if velocity_ned is not None else -1.0, *np.zeros(35)]),
        },
    }


def attitude_of_state(state: StateMessage) -> FloatArray:
    """R_ned_frd (3, 3); level and facing north if it is not known."""
    return rf.attitude_of_angles(*(state[key] or 0.0 for key in ("roll_deg", "pitch_deg", "yaw_deg")))


TRACK_FIELDS = (
    *((name, _FLOAT64) for name in ("x", "y", "z", "vx", "vy", "vz", "position_variance", "velocity_variance")),
    *((name, _FLOAT64) for name in ("age", "unseen")),
    ("track", _UINT32),
    ("confirmed", _UINT8),
)
"""Fields of a point of `tracks`: metres and m/s over ground in east, north, up; the variance of each axis; seconds."""
_POINT = np.dtype([(name, {_FLOAT64: "<f8", _UINT32: "<u4", _UINT8: "u1"}[kind]) for name, kind in TRACK_FIELDS])


def neighbour_poses(time_ns: int, names: Names, neighbours: Sequence[NeighbourMessage]) -> Tree:
    """Positions of neighbours from the drone, in the order of `tracks`. Their headings are not known."""
    positions = [rf.enu_of_ned(np.array(one["position_ned"])) for one in usable(neighbours)]
    return {
        "header": header(time_ns, names.level),
        "poses": [{"position": vector(position), "orientation": LEVEL_TURN} for position in positions],
    }


def tracks(time_ns: int, names: Names, neighbours: Sequence[NeighbourMessage]) -> Tree:
    """A PointCloud2 with a point of `TRACK_FIELDS` for each neighbour: with variances, velocity and track number."""
    used = usable(neighbours)
    points = np.zeros(len(used), _POINT)
    for point, one in zip(points, used, strict=True):
        place, velocity = (rf.enu_of_ned(np.array(one[key])) for key in ("position_ned", "velocity_ned"))
        point["x"], point["y"], point["z"] = place
        point["vx"], point["vy"], point["vz"] = velocity
        point["position_variance"] = one["position_sigma_m"] ** 2
        point["velocity_variance"] = one["velocity_sigma_m_s"] ** 2
        point["age"], point["unseen"] = one["age_s"], one["unseen_s"]
        point["track"], point["confirmed"] = one["track"] % 2**32, one["confirmed"]
    fields = [
        {"name": name, "offset": _POINT.fields[name][1], "datatype": kind, "count": 1}  # type: ignore[index]
        for name, kind in TRACK_FIELDS
    ]
    return {
        "header": header(time_ns, names.level),
        "height": 1,
        "width": len(used),
        "fields": fields,
        "point_step": _POINT.itemsize,
        "row_step": _POINT.itemsize * len(used),
        "data": points.tobytes(),
        "is_dense": True,
    }


def usable(neighbours: Sequence[NeighbourMessage]) -> list[NeighbourMessage]:
    """The neighbours with complete numbers: a peer may have sent incomplete ones."""
    numbers = ("position_sigma_m", "velocity_sigma_m_s", "age_s", "unseen_s")
    return [
        one
        for one in neighbours
        if _known(one["position_ned"], 3) is not None
        and _known(one["velocity_ned"], 3) is not None
        and all(_finite(one[key]) for key in numbers)  # type: ignore[literal-required]
    ]


def scan(time_ns: int, names: Names, obstacles: ObstaclesMessage) -> Tree | None:
    """Ranges counter-clockwise from west, by REP 117: infinite is free as far as ``range_max``, NaN is not known.

    A direction that is known to be free up to a shorter range is NaN, so that unseen space is not cleared;
    ``intensities`` has that range in metres. None: the sectors cannot be converted to a scan.
    """
    count = len(obstacles["range_m"])
    if count == 0 or count % 4 or len(obstacles["seen_m"]) != count:
        return None
    order = rf.scan_order(count)
    ranges, seen = (
        np.array([math.nan if one is None else one for one in obstacles[key]], np.float64)[order]
        for key in ("range_m", "seen_m")
    )
    seen = np.nan_to_num(seen)
    measured = np.isfinite(ranges)
    farthest = float(max(seen.max(), ranges[measured].max(initial=0.0)))
    free = np.where(seen >= farthest, math.inf, math.nan)
    step = 2 * math.pi / count
    return {
        "header": header(time_ns, names.level),
        "angle_min": -math.pi,
        "angle_max": -math.pi + (count - 1) * step,
        "angle_increment": step,
        "range_max": farthest,
        "ranges": np.where(measured, ranges, free).astype(np.float32),
        "intensities": seen.astype(np.float32),
    }


def diagnostics(time_ns: int, statuses: Sequence[Tree]) -> Tree:
    """A DiagnosticArray."""
    return {"header": header(time_ns, ""), "status": list(statuses)}


def diagnostic(name: str, level: int, sentence: str, values: Mapping[str, object]) -> Tree:
    """A DiagnosticStatus; unknown values are left out."""
    known = [{"key": key, "value": _written(value)} for key, value in values.items() if value is not None]
    return {"level": level, "name": name, "message": sentence, "hardware_id": name.partition(":")[0], "values": known}


def transform(time_ns: int, parent: str, child: str, place: FloatArray, R_parent_child: FloatArray) -> Tree:
    """A TransformStamped; ``place`` (3,) and the rotation are in the axes of ROS."""
    return {
        "header": header(time_ns, parent),
        "child_frame_id": child,
        "transform": {"translation": vector(place), "rotation": turn(R_parent_child)},
    }


def _written(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _known(values: object, size: int) -> FloatArray | None:
    """A list from a peer; None: a number is missing."""
    if not isinstance(values, list) or len(values) != size or not all(map(_finite, values)):
        return None
    return np.array(values, np.float64)


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
