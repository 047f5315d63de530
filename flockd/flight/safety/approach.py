"""How fast a drone may fly towards what is near: so that it can stop in time."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry.level import SAME_SPOT_M
from flockd.flight.safety.half_planes import Limits

COLUMN = 1.5
"""A neighbour is above or below if its level range is less than this many times the degraded separation: downwash
widens on its way down, and neither drone stays exactly in its place."""
_HEIGHT_NOISE_M = 0.3
"""Noise of a height over a few seconds: a difference this small between asked and own height is no climb."""


def towards_neighbours(
    p: GateParameters,
    offsets: FloatArray,
    velocities: FloatArray,
    separation_m: float,
    margins: FloatArray,
    unseen_s: FloatArray,
) -> Limits:
    """For each neighbour near the drone's height its direction, (n, 2), and the greatest speed towards it, (n,) m/s.

    `offsets` (k, 3) metres NED from the drone, `velocities` (k, 2) m/s over ground; `margins` (k, 2) by how much
    each may be nearer, m, and come faster, m/s; `unseen_s` (k,) is how long ago each was seen last. Each counts twice:
    as flying on, and as braking since then.
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
    """As `towards_neighbours`, if each neighbour has braked since it was last seen, as hard as its gate permits.

    The neighbour stands where its braking ends, and the drone stops before that place as before an obstacle. A tracker
    that does not notice the braking does no harm. A tracker that notices half of it places the neighbour too far
    ahead: so the distance left is reduced by the error of its velocity times the reaction time to neighbours.
    """
    speeds = np.hypot(velocities[:, 0], velocities[:, 1])
    since = speeds / (2 * p.max_acceleration_m_s2) - unseen_s  # s of flight from where it would be by now
    places = offsets.copy()
    places[:, :2] += velocities * since[:, None]
    meets = _about_level(p, places, separation_m)
    ranges = np.hypot(places[meets, 0], places[meets, 1])
    left_m = ranges - separation_m - margins[meets] @ [1.0, p.neighbour_reaction_s]
    return places[meets, :2] / ranges[:, None], stopping_speed(left_m, p.braking_m_s2, p.reaction_s)


def _about_level(p: GateParameters, offsets: FloatArray, separation_m: float) -> BoolArray:
    """(k,): which of (k, 3) m are in a direction, and about at the drone's height."""
    ranges = np.hypot(offsets[:, 0], offsets[:, 1])
    about_m = max(separation_m, p.vertical_separation_m)
    meets: BoolArray = (ranges >= SAME_SPOT_M) & (ranges < math.inf) & (np.abs(offsets[:, 2]) < about_m)
    return meets


def towards_flying_on(
    p: GateParameters, offsets: FloatArray, velocities: FloatArray, separation_m: float, margins: FloatArray
) -> Limits:
    """As `towards_neighbours`, if each neighbour flies on with its estimated velocity.

    Nearer than the separation: not at all. Farther, so fast that the distance left suffices if both brake, as in
    Shalev-Shwartz et al. 2017, "On a formal model of safe and scalable self-driving cars": with v towards a
    neighbour that comes at w (negative: goes), the drone's reaction time r and its braking b,
    (v + w) r + v^2 / 2b + w |w| / 2b <= distance left. The neighbour's gate may let it begin to come just now; so,
    but for following one that goes, this has to hold for w = v too. One that goes is followed as fast as it goes, and
    faster where the drone would still stop behind it if it braked unseen for r: v r + v^2 / 2b - w^2 / 2b <= distance
    left. Else no gap would ever close in a flock that flies along.
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
    soon = p.braking_m_s2 * p.reaction_s  # it begins to come from standstill, or from less
    if_both_come = np.sqrt(soon**2 + p.braking_m_s2 * np.maximum(left_m, 0.0)) - soon
    goes = np.maximum(-comes, 0.0)
    if_it_brakes = np.sqrt(lag**2 + 2 * p.braking_m_s2 * np.maximum(left_m, 0.0) + goes**2) - lag
    following = np.maximum(np.minimum(if_it_brakes, if_both_come + goes), goes)
    most_m_s = np.minimum(most_m_s, np.maximum(if_both_come, following))
    return towards, np.where(left_m > 0, most_m_s, 0.0)


def towards_obstacles(points: FloatArray, clearance_m: float, braking_m_s2: float, reaction_s: float) -> Limits:
    """For each obstacle's point its direction, (n, 2), and how fast to fly there, (n,) m/s: see `stopping_speed`.

    `points` (m, 2) metres north and east from the drone; those that are not finite, or at no distance, are left out.
    """
    ranges = np.hypot(points[:, 0], points[:, 1])
    somewhere = (ranges > 0) & (ranges < math.inf)
    points, ranges = points[somewhere], ranges[somewhere]
    return points / ranges[:, None], stopping_speed(ranges - clearance_m, braking_m_s2, reaction_s)


def stopping_speed(left_m: FloatArray, braking_m_s2: float, reaction_s: float) -> FloatArray:
    """The fastest speed, m/s, from which a drone stops within `left_m`: v r + v^2 / 2b = left; 0 where none is left."""
    lag = braking_m_s2 * reaction_s
    speed: FloatArray = np.sqrt(lag**2 + 2 * braking_m_s2 * np.maximum(left_m, 0.0)) - lag
    return speed


def between_neighbours(p: GateParameters, start_m: float, own_m: float, offsets: FloatArray) -> tuple[float, float]:
    """From which height to which one may be asked for, from `start_m` on, where neighbours are above or below.

    `own_m` is the drone's height, and `offsets` (n, 3) metres NED are the neighbours' from there. A height that was
    asked for already, and from which the drone's own differs by noise only, stays. A drone that does not know its
    height counts as where it was asked to be.
    """
    own_m = own_m if math.isfinite(own_m) else start_m
    up = -offsets[np.hypot(offsets[:, 0], offsets[:, 1]) < COLUMN * p.degraded_separation_m, 2]
    room_up = np.maximum(up[up > 0] - p.vertical_separation_m, 0.0).min(initial=math.inf)
    room_down = np.maximum(-up[up < 0] - p.vertical_separation_m, 0.0).min(initial=math.inf)
    highest_m = max(own_m + float(room_up), min(start_m, own_m + _HEIGHT_NOISE_M))
    lowest_m = min(own_m - float(room_down), max(start_m, own_m - _HEIGHT_NOISE_M))
    return lowest_m, highest_m
