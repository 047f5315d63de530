"""The velocity nearest to a wanted one within limits along directions: each limit is a half-plane."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray

ROUNDING_M_S = 1e-9
_PARALLEL = 1e-6
"""Sine of the angle between two directions below which their limits are not combined."""

Limits = tuple[FloatArray, FloatArray]
"""Directions (k, 2) of length 1, and the greatest speed along each, (k,) m/s, 0 or more."""
NO_LIMITS: Limits = np.empty((0, 2)), np.empty(0)


def nearest_within(velocity: FloatArray, directions: FloatArray, limits: FloatArray) -> FloatArray:
    """The nearest velocity whose components along directions (n, 2) of length 1 are within limits (n,), 0 or more.

    It is the velocity itself, its foot on the line of one limit, or the crossing of two such lines. Standstill always
    satisfies all limits, so that the result is never longer than the velocity. A limit of NaN counts as 0.
    """
    limits = np.nan_to_num(limits, nan=0.0, posinf=np.inf)
    over = directions @ velocity - limits
    if (over <= 0).all():
        return velocity
    binding = ~(limits > np.hypot(*velocity) + ROUNDING_M_S)  # no vector of at most this length exceeds the others
    directions, limits, over = directions[binding], limits[binding], over[binding]
    feet = velocity - over[:, None] * directions
    candidates = np.vstack([np.zeros(2), feet, crossings(directions, limits)])
    fits = np.max(candidates @ directions.T - limits, axis=1, initial=-np.inf) <= ROUNDING_M_S
    fitting = candidates[fits]
    nearest: FloatArray = fitting[np.argmin(np.linalg.norm(fitting - velocity, axis=1))]
    return nearest


def crossings(directions: FloatArray, limits: FloatArray) -> FloatArray:
    """(m, 2): crossings of the lines n . v = limit, for each two that are not parallel (Cramer's rule)."""
    i, j = np.triu_indices(len(directions), 1)
    a, b = directions[i], directions[j]
    determinants = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    cross = np.abs(determinants) > _PARALLEL
    a, b, c, d = a[cross], b[cross], limits[i][cross], limits[j][cross]
    points: FloatArray = (
        np.column_stack([c * b[:, 1] - d * a[:, 1], d * a[:, 0] - c * b[:, 0]]) / determinants[cross, None]
    )
    return points
