"""Who is near whom in many flights, and what each drone perceives of the others with errors as of the networks.

Errors are drawn without a memory: each is a function of the flight's seed, the two drones and the time, between normal
numbers at the ends of a stretch of time that the next stretch shares. So a flight is the same whatever is flown beside
it, and only those near are looked at.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.spatial import cKDTree

from flockd.core.messages import BoolArray, FloatArray, IntArray
from flockd.sim.scenario.perceived import PerceivedErrors, Spread

DISTANCE, MISSED, BIAS, RANGE, BEARING, VELOCITY = 0, 1, 2, 3, 5, 7
"""Columns of `by_distance`; an error takes two: of z and of z^3, for a normal number z."""
_STRETCHES = 1.7
"""An error's time constant times this is the stretch whose errors are alike for as long, taken over all lags."""
_Z50, _Z95 = 0.674490, 1.959964
"""Half of all normal numbers, and 95 %, are nearer to 0."""
_MOST_FALSE = 4
"""False neighbours of a drone at one time, at most."""
_LEAST_RANGE_M = 1e-3


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

    def pairs(self, reach_m: float | FloatArray) -> tuple[IntArray, IntArray]:
        """(p,) drones, in order, and the number (p,) of another within `reach_m`, one for all drones or (drones,).

        A drone's others are in ascending order; there may be some that are farther by a rounding error.
        """
        reach = np.minimum(reach_m * (1.0 + 1e-9), _APART_M / 2)
        found = self._tree.query_ball_point(self._places, reach, return_sorted=True)
        counts = np.fromiter(map(len, found), np.int64, len(found))
        others = np.fromiter(itertools.chain.from_iterable(found), np.int64, counts.sum())
        owners = np.repeat(np.arange(len(found)), counts)
        return owners[owners != others], others[owners != others]


class Seen(NamedTuple):
    """What drones know of their neighbours, as p pairs."""

    owners: IntArray
    """(p,) whose neighbour it is, in ascending order."""
    offsets: FloatArray
    """(p, 3) m, NED, from the drone."""
    velocities: FloatArray
    """(p, 3) m/s, NED, over ground."""
    ages_s: FloatArray
    """(p,) for how long it has known them."""

    def of(self, chosen: IntArray | slice) -> Self:
        """Some of the pairs."""
        return type(self)._make(part[chosen] for part in self)


class Perception:
    """The perception of all drones of a batch of flights."""

    def __init__(self, errors: PerceivedErrors, step_s: float, seeds: Sequence[int], drones: int) -> None:
        """`seeds` of the flights, of so many `drones` each."""
        self._errors, self._step_s, self._drones = errors, step_s, drones
        self._seeds = np.repeat(np.array(seeds, dtype=np.int64), drones)
        self._table = by_distance(errors)

    def own_velocities(self, velocities: FloatArray, step: int) -> FloatArray:
        """(drones, 2) m/s: what each drone takes for its velocity (drones, 2) m/s."""
        slope, cubed = _cubic(self._errors.own_velocity_error_m_s)
        drones = np.arange(len(self._seeds))
        z = self._normals(drones, drones % self._drones, 0, step, self._errors.own_velocity_time_s)
        return np.asarray(velocities + slope * z + cubed * z**3, dtype=float)

    def perceive(self, reach_m: float, near: Near, states: FloatArray, step: int) -> Seen:
        """The neighbours that all drones perceive within `reach_m`, at `states` (drones, 6).

        Places are the level ones of the measurement, heights and sinking are without errors. Those that are there have
        been seen as if always.
        """
        errors, n, table = self._errors, self._drones, self._table
        owners, others = near.pairs(reach_m)
        offsets = states[others, :3] - states[owners, :3]
        ranges = np.linalg.norm(offsets, axis=1)
        steepest = math.sin(math.radians(errors.elevation_limit_deg))
        in_view = (ranges <= reach_m) & (np.abs(offsets[:, 2]) <= steepest * ranges)
        by_range = np.flatnonzero(in_view)[np.lexsort((ranges[in_view], owners[in_view]))]
        owners, others, offsets = owners[by_range], others[by_range], offsets[by_range]
        ranges = np.maximum(ranges[by_range], _LEAST_RANGE_M)
        pairs = owners % n * n + others % n
        visible = self._visible(owners, offsets / ranges[:, None], errors.drone_radius_m / ranges)
        z = self._normals(owners, pairs, 1, step, errors.missed_time_s)[:, 0]
        known = visible & (z >= _column(table, ranges, MISSED))
        owners, others, pairs = owners[known], others[known], pairs[known]
        offsets, ranges = offsets[known], ranges[known]
        z = self._normals(owners, pairs, 2, step, errors.error_time_s)
        longer = np.exp(_column(table, ranges, BIAS) + _error(table, ranges, RANGE, z[:, 0]))
        turn = _error(table, ranges, BEARING, z[:, 1])
        cos, sin = longer * np.cos(turn), longer * np.sin(turn)
        north, east, down = offsets.T
        velocities = states[others, 3:].copy()
        z = self._normals(owners, pairs, 3, step, errors.error_time_s)
        velocities[:, :2] += _error(table, ranges[:, None], VELOCITY, z)
        offsets = np.column_stack([north * cos - east * sin, north * sin + east * cos, down])
        true = Seen(owners, offsets, velocities, np.full(len(owners), math.inf))
        false = self._false(reach_m, states, step)
        seen = Seen._make(np.concatenate(parts) for parts in zip(true, false, strict=True))
        return seen.of(np.argsort(seen.owners, kind="stable"))

    def _false(self, reach_m: float, states: FloatArray, step: int) -> Seen:
        """Neighbours that are none, which fly as the drone itself does."""
        false = self._errors.false_neighbours
        lifetime = false.lifetime_s / self._step_s
        numbers, seeds = np.arange(_MOST_FALSE), self._seeds[:, None]
        drones = np.arange(len(states))[:, None] % self._drones
        at = step / lifetime + _uniform(_mixed(seeds, drones, 4 + numbers, -1))
        there = _uniform(_mixed(seeds, drones, 4 + numbers, np.floor(at))) <= min(false.at_once / _MOST_FALSE, 1.0)
        bits = _mixed(seeds, drones, 8 + numbers, np.floor(at))
        bearing = 2.0 * math.pi * _uniform(bits)
        range_m = np.interp(2.0 * _uniform(bits << np.uint64(32)), [0.0, 1.0, 2.0], false.distances_m)
        which, number = np.nonzero(there & (range_m <= reach_m))
        range_m, bearing, at = range_m[which, number], bearing[which, number], at[which, number]
        offsets = np.column_stack([range_m * np.cos(bearing), range_m * np.sin(bearing), np.zeros(len(which))])
        ages_s = (at - np.floor(at)) * false.lifetime_s
        return Seen(which, offsets, states[which, 3:], ages_s)

    def _visible(self, owners: IntArray, rays: FloatArray, widths: FloatArray) -> BoolArray:
        """Who is not hidden, (p,), of pairs from near to far.

        `rays` (p, 3) are directions, `widths` (p,) angular radii.

        Of two discs, one hides the other about by how deep they reach into each other. What is hidden hides nothing:
        what hides it hides what is behind it too.
        """
        visible = np.ones(len(owners), dtype=bool)
        if self._errors.hidden_limit >= 1.0 or not len(owners):
            return visible
        starts, counts = np.unique(owners, return_index=True, return_counts=True)[1:]
        before, kept = np.zeros((len(starts), counts.max(), 4)), np.zeros(len(starts), dtype=np.int64)
        for rank in range(counts.max()):
            drones = np.flatnonzero(counts > rank)
            pairs, most = starts[drones] + rank, kept[drones].max()
            nearer, own = before[drones, :most], widths[pairs, None]
            between = ((nearer[..., :3] - rays[pairs, None]) ** 2).sum(axis=2)
            both = own + nearer[..., 3]
            deep = np.minimum((both - np.sqrt(between)) / (2.0 * own), 1.0)
            deep[(between >= both**2) | (np.arange(most) >= kept[drones, None])] = 0.0
            # One after the other, so that the sum does not depend on how many others keep.
            hidden = np.cumsum(deep, axis=1)[:, -1] if most else np.zeros(len(drones))
            visible[pairs] = seen = hidden <= self._errors.hidden_limit
            before[drones[seen], kept[drones[seen]]] = np.column_stack([rays[pairs], widths[pairs]])[seen]
            kept[drones[seen]] += 1
        return visible

    def _normals(self, drones: IntArray, pairs: IntArray, kind: int, step: int, time_s: float) -> FloatArray:
        """(p, 2) normal numbers that change slowly: from one at a stretch's begin to one at its end, at equal variance.

        They are of `pairs` (p,) in the flights of `drones` (p,), and alike for about `time_s`.
        """
        seeds = self._seeds[drones]
        at = step / (_STRETCHES * time_s / self._step_s) + _uniform(_mixed(seeds, pairs, kind, -1))
        number = np.floor(at)
        share = ((at - number) * (math.pi / 2))[:, None]
        first, second = (_normal_pairs(_mixed(seeds, pairs, kind, number + one)) for one in (0, 1))
        return first * np.cos(share) + second * np.sin(share)


def by_distance(errors: PerceivedErrors) -> FloatArray:
    """(entries, 9) in the columns above; what is missed as the normal number below which it is."""
    from scipy.special import ndtri  # noqa: PLC0415 - heavy

    rows = []
    for entry in errors.by_distance:
        missed = float(np.clip(ndtri(entry.missed), -9.0, 9.0))
        spreads = (entry.range_error, entry.bearing_error_deg, entry.velocity_error_m_s)
        of_range, of_bearing, of_velocity = (_cubic(spread) for spread in spreads)
        radians = tuple(math.radians(value) for value in of_bearing)
        rows.append([entry.distance_m, missed, entry.range_bias, *of_range, *radians, *of_velocity])
    return np.array(rows)


def _cubic(spread: Spread) -> tuple[float, float]:
    """a and b such that a z + b z^3, for a normal number z, has this median and 95th percentile."""
    b = (spread.p95 - spread.median * _Z95 / _Z50) / (_Z95**3 - _Z50**2 * _Z95)
    b = min(max(b, 0.0), spread.median / _Z50**3)
    return spread.median / _Z50 - b * _Z50**2, b


def _column(table: FloatArray, ranges: FloatArray, column: int) -> FloatArray:
    """A column of `by_distance` at ranges, as at the ends beyond them."""
    return np.interp(ranges, table[:, DISTANCE], table[:, column])


def _error(table: FloatArray, ranges: FloatArray, column: int, z: FloatArray) -> FloatArray:
    """The errors that belong to normal numbers."""
    return _column(table, ranges, column) * z + _column(table, ranges, column + 1) * z**3


def _mixed(*numbers: Any) -> Any:
    """64 bits that depend on all bits of whole numbers, or of arrays of them (the finaliser of SplitMix64)."""
    bits = np.array([0x9E3779B97F4A7C15], dtype=np.uint64)
    for number in numbers:
        bits = bits ^ np.asarray(number).astype(np.int64).astype(np.uint64)
        bits = bits * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(0x9E3779B97F4A7C15)
        bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        bits = bits ^ (bits >> np.uint64(31))
    return bits


def _uniform(bits: Any) -> FloatArray:
    """From above 0 to 1, of the upper 32 bits."""
    return np.asarray(((bits >> np.uint64(32)).astype(float) + 1.0) * (1.0 / 4294967296.0), dtype=float)


def _normal_pairs(bits: Any) -> FloatArray:
    """(p, 2) normal numbers (Box and Muller)."""
    radius = np.sqrt(-2.0 * np.log(_uniform(bits)))
    angle = 2.0 * math.pi * _uniform(bits << np.uint64(32))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
