"""Matching of estimates to the truth."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray


def match_neighbours(estimated: FloatArray, true: FloatArray, within_m: float = 1.0) -> list[tuple[int, int]]:
    """Greedy assignment of estimates to drones: (estimate, drone) index pairs, one to one, the nearest pair first.

    `estimated` (m, 3) and `true` (n, 3) are metres relative to one observer, which is not among them. No pair is
    farther apart than `within_m` or a quarter of the true range, whichever is more.
    """
    distances = np.linalg.norm(estimated[:, None] - true[None], axis=2)
    allowed = np.maximum(within_m, 0.25 * np.linalg.norm(true, axis=1))
    pairs: list[tuple[int, int]] = []
    for flat in np.argsort(distances, axis=None, kind="stable"):
        estimate, drone = divmod(int(flat), len(true))
        taken = any(estimate == e or drone == d for e, d in pairs)
        if not taken and distances[estimate, drone] <= allowed[drone]:
            pairs.append((estimate, drone))
    return sorted(pairs)
