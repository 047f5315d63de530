"""Figures of a flock at one instant: the paper's two objectives (Eq. 44, 45) and the measures common in the field.

The measures of the field follow Soria, Schiano and Floreano, "The influence of limited visual sensing on the Reynolds
flocking algorithm" (2019): order, union, safety. Positions are (n, 2) or (n, 3) metres: distances are
taken over the axes given.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import connected_components

from flockd.core.config.flocking import FlockingParameters
from flockd.core.messages import BoolArray, FloatArray


def obj1(velocities: FloatArray, desired: FloatArray, *, circling: bool) -> FloatArray:
    """Flocking velocity deviation of each UAV, (n,): Eq. 44, whose sum over the flock the paper plots.

    `velocities` (n, 2) and `desired` (2,) m/s, not zero. `circling`: the branch for t < 66 s, -0.5 where a UAV flies as
    desired; the other is the L1 distance to the desired velocity.
    """
    if circling:
        result: FloatArray = -(velocities @ desired) / (2 * (desired @ desired))
        return result
    return np.asarray(np.abs(desired - velocities).sum(axis=1), dtype=float)


def obj2(positions: FloatArray, velocities: FloatArray, parameters: FlockingParameters) -> FloatArray:
    """Flocking shape deviation of each UAV, (n,): Eq. 45 from positions (n, 2) m and velocities (n, 2) m/s."""
    distances = pair_distances(positions)
    speed_differences = np.abs(velocities[:, None] - velocities[None]).sum(axis=2)
    terms = np.abs(parameters.desired_distance_m - distances) + speed_differences
    return np.asarray((terms * _adjacency(distances, parameters.observation_distance_m)).sum(axis=1), dtype=float)


def order(velocities: FloatArray) -> float:
    """Mean cosine between the velocities of all pairs: 1 is a flock that flies one way. 1 for a single UAV.

    One that stands still has no direction: its cosines count as 0.
    """
    n = len(velocities)
    if n < 2:
        return 1.0
    speeds = np.linalg.norm(velocities, axis=1, keepdims=True)
    directions = np.divide(velocities, speeds, out=np.zeros_like(velocities, dtype=float), where=speeds > 0)
    cosines = directions @ directions.T
    return float(cosines[np.triu_indices(n, 1)].mean())


def union(positions: FloatArray, interaction_distance_m: float) -> float:
    """(n - components) / (n - 1): 1 is one connected flock, 0 is all alone. 1 for a single UAV.

    Two UAVs are connected when no farther apart than the interaction distance.
    """
    n = len(positions)
    if n < 2:
        return 1.0
    components, _ = connected_components(_adjacency(pair_distances(positions), interaction_distance_m), directed=False)
    return (n - int(components)) / (n - 1)


def safety(positions: FloatArray, collision_radius_m: float = 0.5) -> float:
    """1 - the share of pairs nearer than twice the collision radius. 1 for a single UAV."""
    n = len(positions)
    if n < 2:
        return 1.0
    distances = pair_distances(positions)[np.triu_indices(n, 1)]
    return 1.0 - float(np.mean(distances < 2 * collision_radius_m))


def min_distance(positions: FloatArray) -> float:
    """The nearest pair's distance, m; infinite for a single UAV."""
    n = len(positions)
    return float(np.min(pair_distances(positions)[np.triu_indices(n, 1)], initial=np.inf))


def closest_distances(positions: FloatArray) -> FloatArray:
    """(S, n, n) m: how near each pair of (S, n, k) m comes from each step to the next, at the last step just then.

    Each is taken to fly straight from step to step (`closest_approach`).
    """
    offsets = positions[:, None] - positions[:, :, None]
    return np.concatenate([closest_approach(offsets[:-1], offsets[1:]), np.linalg.norm(offsets[-1:], axis=-1)])


def pair_distances(positions: FloatArray) -> FloatArray:
    """Distances (n, n) m between all pairs of positions (n, k) m."""
    return np.asarray(np.linalg.norm(positions[:, None] - positions[None], axis=2), dtype=float)


def _adjacency(distances: FloatArray, limit_m: float) -> BoolArray:
    return (distances <= limit_m) & ~np.eye(len(distances), dtype=bool)


def closest_approach(begin: FloatArray, end: FloatArray) -> FloatArray:
    """(...) m, the least distance of two points whose offset goes straight from `begin` (..., k) to `end` (..., k) m.

    |d + s w|^2 is least at s = -(d . w) / (w . w), between 0 and 1. Exact where both fly straight at an even speed;
    where their relative acceleration is at most a, it errs by at most a T^2 / 8 over a time T.
    """
    way = end - begin
    square = np.maximum((way * way).sum(axis=-1), np.finfo(float).tiny)
    share = np.clip(-(begin * way).sum(axis=-1) / square, 0.0, 1.0)
    return np.asarray(np.linalg.norm(begin + share[..., None] * way, axis=-1), dtype=float)
