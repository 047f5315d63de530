"""The fence and the heights within which the drone has to stay."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray
from flockd.core.polygon import is_inside


def outside_fence(parameters: GateParameters, position: FloatArray) -> bool:
    """Whether (2,) metres north and east of home are outside the fence; so is what is not finite, if there is one."""
    unknown = not np.isfinite(position).all()
    return is_fenced(parameters) and bool(unknown or len(offsets_outside(parameters, position)))


def outside_heights(parameters: GateParameters, height_m: float) -> bool:
    """Whether a height is outside the band, or not finite."""
    return not parameters.min_height_m <= height_m <= parameters.max_height_m


def is_fenced(p: GateParameters) -> bool:
    """Whether there is a fence at all."""
    return p.fence_radius_m is not None or bool(p.fence_corners_m)


def offsets_outside(p: GateParameters, position: FloatArray) -> FloatArray:
    """(n, 2) metres, for each fence that was left: from its nearest point to the position, if that is finite."""
    offsets: list[FloatArray] = []
    if not np.isfinite(position).all():
        return np.empty((0, 2))
    distance = math.hypot(*position)
    if p.fence_radius_m is not None and distance > p.fence_radius_m:
        offsets.append(position * (1 - p.fence_radius_m / distance))
    if p.fence_corners_m and not is_inside(p.fence_corners_m, *position.tolist()):
        offsets.append(position - _nearest_on_outline(position, np.array(p.fence_corners_m)))
    return np.reshape(offsets, (len(offsets), 2))


def _nearest_on_outline(point: FloatArray, corners: FloatArray) -> FloatArray:
    """The point (2,) of a polygon's outline that is nearest to a point."""
    sides = np.roll(corners, -1, axis=0) - corners
    along = np.sum((point - corners) * sides, axis=1) / np.sum(sides**2, axis=1)
    feet = corners + np.clip(along, 0.0, 1.0)[:, None] * sides
    nearest: FloatArray = feet[np.argmin(np.linalg.norm(feet - point, axis=1))]
    return nearest
