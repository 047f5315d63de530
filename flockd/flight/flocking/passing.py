"""How drones that would come too near pass each other: the velocity nearest to the law's that keeps clear of all."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.flocking import FlockingParameters
from flockd.core.messages import FloatArray
from flockd.flight.flocking.law import FlockingLaw, level_offsets, lookahead_s
from flockd.flight.geometry.level import SAME_SPOT_M, limit_norm

HORIZON_S = 2.5
"""Who would come too near within this time is passed: five steps of the paper's pilot."""
_SHARE = 0.5
"""Of the change of velocity that is needed each of two takes half. Where the other does nothing, the next steps take
half of what is left each time."""
_HEAD_ON_RAD = 0.1
"""Off a course that leads to a neighbour's middle by less than this, its side is noise: each turns to its right, as
aircraft do (ICAO Annex 2, Rules of the Air, 3.2.2.2)."""
_RING = 24
_SPEEDS = 1.0, 0.5
"""Directions, and shares of the highest speed, that are tried where no velocity keeps clear of all."""
_ROUNDING_M_S = 1e-9


def command(
    law: FlockingLaw,
    velocity: FloatArray,
    offsets: FloatArray,
    velocities: FloatArray,
    desired: FloatArray,
    step_s: float,
    vertical_m: float,
    ages_s: FloatArray | float = math.inf,
) -> tuple[FloatArray, FloatArray]:
    """As of `FlockingLaw.command`, but clear of who would come too near; arguments as of `clear_of`.

    The acceleration, (2,) m/s^2, is the law's, or else the one that leads to the velocity within its sampling time.
    """
    wanted, acceleration = law.command(velocity, level_offsets(offsets), velocities, desired, step_s, ages_s)
    clear = clear_of(wanted, velocity, offsets, velocities, law.parameters, vertical_m)
    return clear, acceleration if clear is wanted else (clear - velocity) / lookahead_s(step_s)


def clear_of(
    wanted: FloatArray,
    velocity: FloatArray,
    offsets: FloatArray,
    velocities: FloatArray,
    parameters: FlockingParameters,
    vertical_m: float,
) -> FloatArray:
    """The velocity nearest to the `wanted` one, (2,) m/s, that passes each neighbour at the separation distance.

    `velocity` (2,) m/s is the own one, `offsets` (n, 3) metres NED are the neighbours' and `velocities` (n, 2) m/s
    theirs, over ground. One that is `vertical_m` above or below, or more, is passed anyway.

    Optimal reciprocal collision avoidance (J. van den Berg, S. Guy, M. Lin, D. Manocha, "Reciprocal n-body collision
    avoidance", 2011): for each neighbour one half-plane of velocities, so that none comes nearer within `HORIZON_S` if
    both take their share. Where one is nearer already it comes no nearer, and the law's separation parts them. Where
    nobody would come too near it is what was wanted; where no velocity is clear of all, the one that is least off.
    """
    distance_m, max_speed_m_s = parameters.separation_distance_m, parameters.max_speed_m_s
    at_height = np.abs(offsets[:, 2]) < vertical_m
    normals, least = _half_planes(velocity, offsets[at_height, :2], velocities[at_height], distance_m)
    if (normals @ wanted >= least - _ROUNDING_M_S).all():
        return wanted
    angles = np.arange(_RING) * (2 * math.pi / _RING)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    feet = wanted + (least - normals @ wanted)[:, None] * normals
    tried = np.vstack([feet, _crossings(normals, least), *(max_speed_m_s * share * ring for share in _SPEEDS)])
    tried = np.array([limit_norm(one, max_speed_m_s) for one in tried])
    off = np.maximum(least - tried @ normals.T, 0.0).max(axis=1)
    best = tried[off <= off.min() + _ROUNDING_M_S]
    nearest: FloatArray = best[np.argmin(np.linalg.norm(best - wanted, axis=1))]
    return nearest


def _half_planes(
    velocity: FloatArray, offsets: FloatArray, velocities: FloatArray, distance_m: float
) -> tuple[FloatArray, FloatArray]:
    """Normals (k, 2) and the least part, (k,) m/s, that the own velocity is to have along each."""
    found = [
        _half_plane(velocity, offset, velocity - theirs, distance_m)
        for offset, theirs in zip(offsets, velocities, strict=True)
        if math.hypot(*offset) > SAME_SPOT_M
    ]
    return np.reshape([normal for normal, _ in found], (-1, 2)), np.array([least for _, least in found])


def _half_plane(
    velocity: FloatArray, offset: FloatArray, relative: FloatArray, distance_m: float
) -> tuple[FloatArray, float]:
    """Of one neighbour: the nearest point outside the cone of relative velocities that lead to it, cut off at the time.

    The cone's apex is standstill; its end is a circle of `distance_m` over the horizon around the offset over it.
    """
    range_m = math.hypot(*offset)
    ahead = offset / range_m
    if range_m <= distance_m:
        return -ahead, float(velocity @ -ahead) + max(float(relative @ ahead), 0.0)
    beyond = relative - offset / HORIZON_S
    along = float(beyond @ offset)
    if along < 0 and along**2 > distance_m**2 * float(beyond @ beyond):
        normal = beyond / math.hypot(*beyond)
        change = distance_m / HORIZON_S - math.hypot(*beyond)
    else:
        right = np.array([-ahead[1], ahead[0]])  # north and east: a quarter turn clockwise
        to_right = float(relative @ right) > -_HEAD_ON_RAD * math.hypot(*relative)
        sine = distance_m / range_m
        normal = math.sqrt(1 - sine**2) * (right if to_right else -right) - sine * ahead
        change = -float(relative @ normal)
    return normal, float(velocity @ normal) + (_SHARE * change if change > 0 else change)


def _crossings(normals: FloatArray, least: FloatArray) -> FloatArray:
    """(m, 2): where two of the lines n . v = least cross, for each two that are not parallel."""
    i, j = np.triu_indices(len(normals), 1)
    determinants = normals[i, 0] * normals[j, 1] - normals[i, 1] * normals[j, 0]
    cross = np.abs(determinants) > 1e-6
    a, b, c, d = normals[i][cross], normals[j][cross], least[i][cross], least[j][cross]
    points: FloatArray = (
        np.column_stack([c * b[:, 1] - d * a[:, 1], d * a[:, 0] - c * b[:, 0]]) / determinants[cross, None]
    )
    return points
