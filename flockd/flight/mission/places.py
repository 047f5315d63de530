"""Positions of waypoints and orders, in metres from home."""

from __future__ import annotations

import numpy as np

from flockd.core.config.mission import WaypointParameters
from flockd.core.messages import FloatArray, MissionOrder
from flockd.core.navigation import metres_from


def place_of_order(order: MissionOrder, origin: FloatArray, home_deg: FloatArray | None) -> FloatArray | None:
    """(2,) metres north and east of home; None: the order names no place, or home is not known."""
    if order.place is not None:
        place: FloatArray = origin + order.place
        return place
    if order.place_deg is None or home_deg is None:
        return None
    return np.array(metres_from(home_deg.tolist(), order.place_deg.tolist()))


def place_of_waypoint(
    waypoint: WaypointParameters, origin: FloatArray, home_deg: FloatArray | None
) -> FloatArray | None:
    """(2,) metres north and east of home; None: the waypoint is in degrees and home is not known."""
    if waypoint.north_m is not None and waypoint.east_m is not None:
        place: FloatArray = origin + np.array([waypoint.north_m, waypoint.east_m])
        return place
    assert waypoint.latitude_deg is not None and waypoint.longitude_deg is not None  # checked by WaypointParameters
    place_deg = waypoint.latitude_deg, waypoint.longitude_deg
    return None if home_deg is None else np.array(metres_from(home_deg.tolist(), place_deg))
