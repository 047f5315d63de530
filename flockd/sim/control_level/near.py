"""Who is near whom in many flights at once, by one k-d tree."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial import cKDTree

from flockd.core.messages import FloatArray, IntArray

_APART_M = 1e7
"""The flights' planes lie so far above each other in the tree; a distance beyond half of that counts as infinite."""


class Near:
    """The drones of all flights by their level places; a drone's number counts through all flights."""

    def __init__(self, states: FloatArray) -> None:
        """`states` (6, flights, n) m and m/s, NED."""
        _, flights, n = states.shape
        planes = np.repeat(_APART_M * np.arange(flights), n)
        self._places = np.column_stack([*states[:2].reshape(2, -1), planes])
        self._tree = cKDTree(self._places)

    def nearest(self, k: int) -> tuple[FloatArray, IntArray]:
        """Level distance (drones,) m to the k-th nearest other drone, and which: infinite and itself where none is."""
        found_m, found = self._tree.query(self._places, k=[k + 1], distance_upper_bound=_APART_M / 2)
        numbers = np.arange(len(self._places))
        return found_m[:, 0], np.where(np.isinf(found_m[:, 0]), numbers, found[:, 0])

    def pairs(self, who: IntArray, reach_m: FloatArray) -> tuple[IntArray, IntArray]:
        """Of the drones `who` (m,), (p,) of `who`, in order, and the number (p,) of another within its `reach_m` (m,).

        A drone's others are in ascending order; there may be some that are farther by a rounding error.
        """
        reach = np.minimum(reach_m * (1.0 + 1e-9), _APART_M / 2)
        found = self._tree.query_ball_point(self._places[who], reach, return_sorted=True)
        counts = np.fromiter(map(len, found), np.int64, len(who))
        others = np.fromiter(itertools.chain.from_iterable(found), np.int64, counts.sum())
        owners = np.repeat(who, counts)
        return owners[owners != others], others[owners != others]
