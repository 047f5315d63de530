"""The fence and the height limits of the drone."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray
from flockd.core.navigation import is_inside
from flockd.flight.safety.approach import HEIGHT_NOISE_M, stopping_speed
from flockd.flight.safety.half_planes import NO_LIMITS, Limits


def outside_fence(parameters: GateParameters, position: FloatArray) -> bool:
    """Whether (2,) metres north and east of home are outside the fence; with a fence, also if they are not finite."""
    radius_m, corners_m = parameters.fence_radius_m, parameters.fence_corners_m
    beyond = radius_m is not None and not math.hypot(*position) <= radius_m
    return beyond or (corners_m != () and not is_inside(corners_m, *position.tolist()))


def outside_heights(parameters: GateParameters, height_m: float) -> bool:
    """Whether a height is outside the band by more than the noise of one that is held at its edge, or not finite."""
    return not parameters.min_height_m - HEIGHT_NOISE_M <= height_m <= parameters.max_height_m + HEIGHT_NOISE_M


def towards_fence(p: GateParameters, position: FloatArray, flies_on_s: float = 0.0) -> Limits:
    """Directions (n, 2) to the fences, or outward if one was left, and the greatest speed towards each, (n,) m/s.

    A fence counts as a wall with `obstacle_clearance_m`: see `stopping_speed`. Outside it the speed outward is zero. A
    round one limits the speed along it too: a vehicle that responds late leaves a circle along the tangent. A
    `position` that is not finite gives no direction. The drone may fly on for `flies_on_s` before it brakes, and for
    its reaction time at least.
    """
    offsets: list[FloatArray] = []
    left_m: list[float] = []
    if not np.isfinite(position).all():
        return NO_LIMITS
    if p.fence_radius_m is not None:
        out_m = math.hypot(*position)
        off = np.linspace(0.0, 2.0 * math.pi, 12, endpoint=False)  # from the outward direction
        azimuths = math.atan2(position[1], position[0]) + off
        offsets.extend(np.column_stack([np.cos(azimuths), np.sin(azimuths)]))
        half_chord = np.sqrt(np.maximum(p.fence_radius_m**2 - (out_m * np.sin(off)) ** 2, 0.0))
        left_m.extend((half_chord - out_m * np.cos(off)).tolist())
    if p.fence_corners_m:
        to_sides = _nearest_of_sides(position, np.array(p.fence_corners_m)) - position
        ranges_m = np.linalg.norm(to_sides, axis=1)
        if is_inside(p.fence_corners_m, *position.tolist()):
            offsets.extend(to_sides)
            left_m.extend(ranges_m.tolist())
        else:
            offsets.append(-to_sides[np.argmin(ranges_m)])
            left_m.append(0.0)
    directions = np.reshape(offsets, (len(offsets), 2))
    lengths = np.hypot(directions[:, 0], directions[:, 1])
    somewhere = lengths > 0
    reaction_s = max(p.reaction_s, flies_on_s)
    most_m_s = stopping_speed(np.array(left_m) - p.obstacle_clearance_m, p.braking_m_s2, reaction_s)
    return directions[somewhere] / lengths[somewhere, None], most_m_s[somewhere]


def _nearest_of_sides(point: FloatArray, corners: FloatArray) -> FloatArray:
    """(n, 2): the point of each side of a polygon that is nearest to a point."""
    sides = np.roll(corners, -1, axis=0) - corners
    along = np.sum((point - corners) * sides, axis=1) / np.sum(sides**2, axis=1)
    nearest: FloatArray = corners + np.clip(along, 0.0, 1.0)[:, None] * sides
    return nearest
