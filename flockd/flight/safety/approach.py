"""How fast a drone may approach neighbours, obstacles and the fence so that it can stop in time."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry.level import SAME_SPOT_M
from flockd.flight.safety.half_planes import Limits

COLUMN = 1.5
"""Horizontal distance, in degraded separations, within which a neighbour is above or below the drone: downwash widens
on its way down, and drones do not hold their positions exactly."""
HEIGHT_NOISE_M = 0.3
"""Noise of a height over a few seconds: a smaller difference between commanded and own height does not count as a
climb."""


def towards_neighbours(
    p: GateParameters,
    offsets: FloatArray,
    velocities: FloatArray,
    separation_m: float,
    margins: FloatArray,
    unseen_s: FloatArray,
) -> Limits:
    """For each neighbour near the drone's height its direction, (n, 2), and the greatest speed towards it, (n,) m/s.

    `offsets` (k, 3) metres NED from the drone, `velocities` (k, 2) m/s over ground; `margins` (k, 2): how much nearer,
    m, and how much faster in approach, m/s, each may be; `unseen_s` (k,): time since each was last seen. Each counts
    twice: as flying on, and as braking since then.
    """
    velocities = np.where(np.isfinite(velocities), velocities, 0.0)
    towards, most_m_s = towards_flying_on(p, offsets, velocities, separation_m, margins)
    towards_it, if_it_brakes_m_s = _braking(p, offsets, velocities, separation_m, margins, unseen_s)
    return np.concatenate([towards, towards_it]), np.concatenate([most_m_s, if_it_brakes_m_s])


def _braking(
    p: GateParameters,
    offsets: FloatArray,
    velocities: FloatArray,
    separation_m: float,
    margins: FloatArray,
    unseen_s: FloatArray,
) -> Limits:
    """As `towards_neighbours`, for neighbours that brake since they were last seen, as hard as their gates permit.

    The neighbour stands where its braking ends, and the drone stops before that place as before an obstacle. A tracker
    that has not noticed the braking does no harm. One that has noticed half of it places the neighbour too far ahead:
    so the distance left is reduced by the velocity's error times the reaction time to neighbours.
    """
    speeds = np.hypot(velocities[:, 0], velocities[:, 1])
    since = speeds / (2 * p.max_acceleration_m_s2) - unseen_s  # s at its speed from its place now to its stop
    places = offsets.copy()
    places[:, :2] += velocities * since[:, None]
    meets = _about_level(p, places, separation_m)
    ranges = np.hypot(places[meets, 0], places[meets, 1])
    left_m = ranges - separation_m - margins[meets] @ [1.0, p.neighbour_reaction_s]
    return places[meets, :2] / ranges[:, None], stopping_speed(left_m, p.braking_m_s2, p.reaction_s)


def _about_level(p: GateParameters, offsets: FloatArray, separation_m: float) -> BoolArray:
    """(k,) which of the offsets (k, 3) m have a direction, and are near the drone's height."""
    ranges = np.hypot(offsets[:, 0], offsets[:, 1])
    about_m = max(separation_m, p.vertical_separation_m)
    meets: BoolArray = (ranges >= SAME_SPOT_M) & (ranges < math.inf) & (np.abs(offsets[:, 2]) < about_m)
    return meets


def towards_flying_on(
    p: GateParameters, offsets: FloatArray, velocities: FloatArray, separation_m: float, margins: FloatArray
) -> Limits:
    """As `towards_neighbours`, for neighbours that fly on with their estimated velocities.

    The speed is zero within the separation. Beyond it, it is such that the distance left suffices if both brake, as in
    Shalev-Shwartz et al. 2017, "On a formal model of safe and scalable self-driving cars": with speed v towards a
    neighbour that approaches at w (negative: flies away), the drone's reaction time r and its braking b, (v + w) r +
    v^2 / 2b + w |w| / 2b <= distance left. The neighbour's gate may just have let it begin to approach; so this has to
    hold for w = v too, except in following. A neighbour that flies away is followed at its own speed, or faster if the
    drone would still stop behind it after it braked unseen for r: v r + v^2 / 2b - w^2 / 2b <= distance left. Otherwise
    no gap in a moving flock would close.
    """
    meets = _about_level(p, offsets, separation_m)
    ranges = np.hypot(offsets[meets, 0], offsets[meets, 1])
    towards, velocities, margins = offsets[meets, :2] / ranges[:, None], velocities[meets], margins[meets]
    goes = (velocities * towards).sum(axis=1)
    comes = -np.minimum(np.maximum(goes, -p.max_speed_m_s), p.max_speed_m_s)
    left_m = ranges - separation_m - margins[:, 0]
    soonest = np.minimum(comes + margins[:, 1], p.max_speed_m_s)
    lag = p.braking_m_s2 * p.neighbour_reaction_s
    square = lag**2 + 2 * p.braking_m_s2 * (left_m - soonest * p.neighbour_reaction_s) - soonest * np.abs(soonest)
    most_m_s = np.sqrt(np.maximum(square, lag**2)) - lag
    soon = p.braking_m_s2 * p.reaction_s  # it begins to approach from standstill, or flies away
    if_both_come = np.sqrt(soon**2 + p.braking_m_s2 * np.maximum(left_m, 0.0)) - soon
    goes = np.maximum(-comes, 0.0)
    if_it_brakes = np.sqrt(lag**2 + 2 * p.braking_m_s2 * np.maximum(left_m, 0.0) + goes**2) - lag
    following = np.maximum(np.minimum(if_it_brakes, if_both_come + goes), goes)
    most_m_s = np.minimum(most_m_s, np.maximum(if_both_come, following))
    return towards, np.where(left_m > 0, most_m_s, 0.0)


def towards_obstacles(points: FloatArray, clearance_m: float, braking_m_s2: float, reaction_s: float) -> Limits:
    """For each obstacle point its direction, (n, 2), and the greatest speed towards it, (n,) m/s: see `stopping_speed`.

    `points` (m, 2) metres north and east from the drone; those that are not finite, or at distance zero, are left out.
    """
    ranges = np.hypot(points[:, 0], points[:, 1])
    somewhere = (ranges > 0) & (ranges < math.inf)
    points, ranges = points[somewhere], ranges[somewhere]
    return points / ranges[:, None], stopping_speed(ranges - clearance_m, braking_m_s2, reaction_s)


def stopping_speed(left_m: FloatArray, braking_m_s2: float, reaction_s: float) -> FloatArray:
    """The fastest speed, m/s, from which a drone stops within `left_m`: v r + v^2 / 2b = left; 0 if none is left."""
    lag = braking_m_s2 * reaction_s
    speed: FloatArray = np.sqrt(lag**2 + 2 * braking_m_s2 * np.maximum(left_m, 0.0)) - lag
    return speed


def between_neighbours(p: GateParameters, start_m: float, own_m: float, offsets: FloatArray) -> tuple[float, float]:
    """The lowest and the highest height that may be commanded, from `start_m` on, with neighbours above or below.

    `own_m` is the drone's height, and `offsets` (n, 3) metres NED are the neighbours' from it. A height that is
    commanded already, and from which the drone's own differs only by noise, is kept. NaN for `own_m` counts as
    `start_m`.
    """
    own_m = own_m if math.isfinite(own_m) else start_m
    up = -offsets[np.hypot(offsets[:, 0], offsets[:, 1]) < COLUMN * p.degraded_separation_m, 2]
    room_up = np.maximum(up[up > 0] - p.vertical_separation_m, 0.0).min(initial=math.inf)
    room_down = np.maximum(-up[up < 0] - p.vertical_separation_m, 0.0).min(initial=math.inf)
    highest_m = max(own_m + float(room_up), min(start_m, own_m + HEIGHT_NOISE_M))
    lowest_m = min(own_m - float(room_down), max(start_m, own_m - HEIGHT_NOISE_M))
    return lowest_m, highest_m
