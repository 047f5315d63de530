"""Positions of waypoints and orders, in metres from home."""

from __future__ import annotations

import numpy as np

from flockd.core.config.mission import WaypointParameters
from flockd.core.messages import FloatArray, MissionOrder
from flockd.core.navigation import degrees_apart, metres_a_degree


def place_of_order(order: MissionOrder, origin: FloatArray, home_deg: FloatArray | None) -> FloatArray | None:
    """(2,) metres north and east of home; None: the order names no place, or home is not known."""
    if order.place is not None:
        place: FloatArray = origin + order.place
        return place
    return None if order.place_deg is None else _from_degrees(order.place_deg, home_deg)


def place_of_waypoint(
    waypoint: WaypointParameters, origin: FloatArray, home_deg: FloatArray | None
) -> FloatArray | None:
    """(2,) metres north and east of home; None: the waypoint is in degrees and home is not known."""
    if waypoint.north_m is not None and waypoint.east_m is not None:
        place: FloatArray = origin + np.array([waypoint.north_m, waypoint.east_m])
        return place
    assert waypoint.latitude_deg is not None and waypoint.longitude_deg is not None  # checked by WaypointParameters
    return _from_degrees(np.array([waypoint.latitude_deg, waypoint.longitude_deg]), home_deg)


def _from_degrees(place_deg: FloatArray, home_deg: FloatArray | None) -> FloatArray | None:
    """Metres north and east, on a plane at home: correct to a few metres within 10 km, to centimetres within 1 km."""
    if home_deg is None:
        return None
    across_deg = degrees_apart(float(place_deg[1]), float(home_deg[1]))
    north_m, east_m = metres_a_degree(float(place_deg[0] + home_deg[0]) / 2)
    return np.array([(place_deg[0] - home_deg[0]) * north_m, across_deg * east_m])
