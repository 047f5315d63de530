"""Where things are in the frame `map`: metres east, north and up from the home of the first drone by name."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from foxglove.messages import FrameTransform, LocationFix, Quaternion, Timestamp, Vector3

from flockd.core.earth import metres_a_degree
from flockd.core.messages import FloatArray
from flockd.fleet.page.drone_rows import Row
from flockd.flight.geometry import rotation_from_euler
from flockd.onboard.recording.foxglove import quaternion

MAP = "map"
_R_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
Message = Mapping[str, Any]


def enu(ned: Iterable[float | None]) -> FloatArray:
    """(3,) east, north, up of north, east, down, as a peer has them: what is null or missing counts as 0."""
    north, east, down = ([0.0 if value is None else value for value in ned] + [0.0] * 3)[:3]
    return np.array([east, north, -down])


class Places:
    """Where each drone is, or was last; without any position the first drone is in the middle, as on the page."""

    def __init__(self) -> None:
        self._last: dict[str, FloatArray] = {}

    def update(self, rows: Mapping[str, Row], order: Iterable[str]) -> dict[str, FloatArray]:
        """(3,) metres in `map` of each drone by its key; ``order``: of the keys by name."""
        for key, row in rows.items():
            if row["position_ne"] is not None:
                north, east = np.add(row["position_ne"], row["home_ne"] or (0.0, 0.0))
                self._last[key] = enu((north, east, -(row["height_m"] or 0.0)))
        if self._last:
            return dict(self._last)
        return {key: enu((0.0, 0.0, -(rows[key]["height_m"] or 0.0))) for key in list(order)[:1]}


def R_ned_body(state: Message | None) -> FloatArray:  # noqa: N802 - the field's own notation
    """(3, 3) of a `state` message; level and to the north where there is none."""
    angles = [(state or {}).get(f"{name}_deg") or 0.0 for name in ("roll", "pitch", "yaw")]
    return rotation_from_euler(*(math.radians(angle) for angle in angles))


def body_transform(stamp: Timestamp, frame: str, place: FloatArray, state: Message | None) -> FrameTransform:
    """Of a drone's body (forward, right, down) in the map."""
    return transform(stamp, MAP, frame, place, _R_ENU_NED @ R_ned_body(state))


def transform(
    stamp: Timestamp, parent: str, child: str, place: FloatArray, R_parent_child: FloatArray
) -> FrameTransform:
    """Of a frame at (3,) metres in its parent, turned by (3, 3)."""
    w, x, y, z = quaternion(R_parent_child)
    return FrameTransform(
        timestamp=stamp, parent_frame_id=parent, child_frame_id=child,
        translation=vector(place), rotation=Quaternion(x=x, y=y, z=z, w=w),
    )  # fmt: skip


def vector(values: FloatArray) -> Vector3:
    """Of (3,)."""
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def location_fix(stamp: Timestamp, frame: str, state: Message) -> LocationFix | None:
    """Of a `state` message; None where the drone or its home has no position."""
    home, position = state.get("home_deg") or [], state.get("position_ne") or []
    if min(len(home), len(position)) < 2 or None in (*home[:2], *position[:2]):
        return None
    a_degree = metres_a_degree(home[0])
    latitude, longitude = (home[i] + position[i] / a_degree[i] for i in range(2))
    # The height above the ellipsoid is not known: 0, as the schema has no other way.
    return LocationFix(timestamp=stamp, frame_id=frame, latitude=latitude, longitude=longitude)
