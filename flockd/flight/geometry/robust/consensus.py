"""The rigid motion that most pairs agree on, with a scale of their errors that the pairs themselves say.

Random triples whose sides have the same lengths before and after give the hypotheses; the mean logarithm of all
residuals ranks them; an a contrario test says within which distance a hypothesis' agreement is least likely by chance
(Moisan & Stival 2004, "A probabilistic criterion to detect rigid point matches between two images"). Tukey's weights
then polish the best one. As fast as the compiled peers, in numpy: everything is a product of large matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import gammaln

from flockd.core.messages import BoolArray, Float32Array, FloatArray, IntArray
from flockd.flight.geometry.rigid_fit import require_spread
from flockd.flight.geometry.robust.kernels import Tukey
from flockd.flight.geometry.rotations import cross_matrix
from flockd.flight.geometry.transform import RigidTransform

FEWEST_PAIRS = 10
"""With fewer the errors' scale cannot be told."""
_FLOOR_M = 1e-4
"""Residuals are not told apart below: exact pairs have none."""
_FIRST_TRIPLES = 192
_MOST_TRIPLES = 32_768
"""Where nine of ten are outliers one triple in a thousand is right: the chance to miss them all is one in 10^14."""
_MISSED = 1e-6
"""The chance that no triple drawn was right, at which the search ends."""
_CAUTION = 0.7
"""Share of the agreement that counts for this chance: among others there are some that agree by luck."""
_CLEAR_SIGMA = 0.03
"""In sizes of the cloud of points."""
_KEPT_TRIPLES = 24
"""Of those drawn, those whose sides agree best become hypotheses."""
_SCORED_PAIRS = 512
_NEXT, _BEFORE = np.array([1, 2, 0]), np.array([2, 0, 1])
"""Of three."""
_POLISHES = 3
_CONTRAST = 4.0
_FEWEST_AGREEING = 6
_CUT_SIGMAS = 4.685
"""Tukey's scale, 95 % efficient for Gaussian errors."""
_MEAN_NORM = math.sqrt(8.0 / math.pi)
"""Mean length of a vector of three Gaussian errors of sigma 1 (the Maxwell distribution)."""
_GROWTH_SIGMAS = 4.0
"""Errors count as growing with the range from so many standard deviations of their growth on."""
_MOST_GROWTH = 3.0
"""Power of the squared range: squared errors of stereo grow with 2."""
_FEWEST_FOR_GROWTH = 50
_LITTLE_DEPTH = 0.01
"""Variance of the squared range's logarithm: all are as far, and nothing can be told."""
_COLLINEAR = 1e-9
"""Spread across a line to the spread along it, squared metres, from which on it is looked at closely."""


@dataclass(frozen=True, eq=False)
class Consensus:
    """A motion, and what agrees with it."""

    transform: RigidTransform
    inliers: BoolArray
    """(n,)"""
    threshold: float
    """Metres: pairs at the middle range agree within it."""
    variances: FloatArray
    """(n,) m^2 of each pair's errors, each axis."""

    def covariance(self, target: FloatArray) -> FloatArray:
        """(6, 6) of a left increment (rotation vector in rad, translation in m) of the motion: what the inliers tell.

        An increment (w, v) moves a point q by w x q + v. ``target`` (n, 3) as it was given.
        """
        weights, q = 1.0 / self.variances[self.inliers], target[self.inliers]
        moments = (q * weights[:, None]).T @ q
        skew = cross_matrix(weights @ q)
        turning = np.trace(moments) * np.eye(3) - moments
        covariance: FloatArray = np.linalg.inv(np.block([[turning, skew], [skew.T, weights.sum() * np.eye(3)]]))
        return covariance


def find_consensus(
    source: FloatArray, target: FloatArray, *, min_inlier_ratio: float, max_threshold: float, seed: int
) -> Consensus:
    """The motion ``target = R source + t`` of (n, 3) pairs, despite outliers; n at least `FEWEST_PAIRS`.

    Raises ValueError with the reason where no more than ``min_inlier_ratio`` n pairs agree, no better than by chance,
    or with errors of a standard deviation above ``max_threshold`` metres.
    """
    random = np.random.default_rng(seed)
    scored = np.arange(len(source)) if len(source) <= _SCORED_PAIRS else random.integers(0, len(source), _SCORED_PAIRS)
    rows = np.ascontiguousarray(source.T), np.ascontiguousarray(target.T)  # numpy is fastest along long rows
    apart = rows[1] - rows[1].mean(axis=1)[:, None]
    reach_m = math.sqrt(3.0 * float(np.vdot(apart, apart)) / len(target))
    motion = _found(rows, scored, reach_m, min_inlier_ratio, random)
    if motion is None:
        require_spread("source", source)
        require_spread("target", target)
        raise ValueError("the points are collinear: no three of those drawn span a triangle")
    rotation, translation, agreement = motion
    sigma_m, growth = agreement.sigma_m, np.ones(len(source))
    for polish in range(_POLISHES):
        squared = _squared(rows, rotation, translation)
        if polish == _POLISHES - 1:
            growth = _growth(rows[0], squared, squared < (_CUT_SIGMAS * sigma_m) ** 2)
            squared = squared / growth
        if polish > 0:
            sigma_m = _sigma_m(squared, sigma_m)
        weights = Tukey(_CUT_SIGMAS * sigma_m).weight(squared) / growth
        rotation, translation, spread = _fitted(rows, weights)
    squared = _squared(rows, rotation, translation) / growth
    sigma_m = _sigma_m(squared, sigma_m)
    inliers = squared < (_CUT_SIGMAS * sigma_m) ** 2
    if agreement.log_chance >= 0.0 or sigma_m > max_threshold:
        raise ValueError(f"no motion brings {len(source)} pairs together better than chance does")
    count = int(np.count_nonzero(inliers))
    if count <= max(min_inlier_ratio * len(source), 3):
        raise ValueError(
            f"no motion has more than {min_inlier_ratio:.0%} of {len(source)} pairs; the best has "
            f"{count / len(source):.0%}"
        )
    if spread[1] <= _COLLINEAR * spread[0]:
        require_spread("source", source[inliers])
        require_spread("target", target[inliers])
    return Consensus(RigidTransform(rotation, translation), inliers, _CUT_SIGMAS * sigma_m, growth * sigma_m**2)


def _sigma_m(squared: FloatArray, before_m: float) -> float:
    """Standard deviation of the errors, each axis, of the residuals that `before_m` does not cut off."""
    lengths = np.sqrt(squared[squared < (_CUT_SIGMAS * before_m) ** 2])
    return max(float(lengths.mean()) / _MEAN_NORM, _FLOOR_M) if len(lengths) else before_m


@dataclass(frozen=True)
class _Agreement:
    """Of a motion's residuals, those that are unlikely to be small by chance."""

    share: float
    sigma_m: float
    """Standard deviation of their errors, each axis."""
    log_chance: float
    """Logarithm of how many motions of pairs without a motion would agree as well."""
    is_clear: bool
    """They agree closely, for the size of the cloud of points: it is no rough motion that brings them near."""


_Rows = tuple[FloatArray, FloatArray]
"""Points before and after, (3, n) both."""


def _found(
    rows: _Rows, scored: IntArray, reach_m: float, least: float, random: np.random.Generator
) -> tuple[FloatArray, FloatArray, _Agreement] | None:
    """Rotation and translation of the best hypothesis, and its agreement; None: all points are on a line."""
    n = rows[0].shape[1]
    source_rows, target_rows = (points.take(scored, axis=1).astype(np.float32) for points in rows)
    best_score, best = math.inf, None
    drawn, count = 0, _FIRST_TRIPLES
    while True:
        triangles = _alike(rows, _random_triples(n, count, random))
        axes = _frames(triangles)
        rotations = axes[:, 1] @ axes[:, 0].transpose(0, 2, 1)
        middles = triangles.sum(axis=0) / 3.0
        translations = middles[:, 1] - np.einsum("bij,bj->bi", rotations, middles[:, 0])
        drawn += count
        squared = _squared_of_all(source_rows, target_rows, rotations, translations)
        scores = np.log(squared + np.float32(_FLOOR_M**2)).mean(axis=1)
        scores[~np.isfinite(scores)] = math.inf
        winner = int(scores.argmin())
        if scores[winner] < best_score:
            best_score = float(scores[winner])
            residuals = np.sqrt(squared[winner]).astype(np.float64)
            best = rotations[winner], translations[winner], _agreement(residuals, reach_m, least)
        if drawn >= _MOST_TRIPLES:
            return best
        if best is not None and best[2].log_chance < 0.0 and drawn >= _enough(best[2], least):
            return best
        count = min(4 * count, _MOST_TRIPLES - drawn)


def _enough(agreement: _Agreement, least: float) -> float:
    """So many triples leave a chance of `_MISSED` that none was of agreeing pairs alone.

    A rough agreement may hide that of fewer pairs with a better motion: then the ``least`` share counts.
    """
    share = agreement.share if agreement.is_clear else min(agreement.share, least)
    right = (_CAUTION * share) ** 3
    return math.log(_MISSED) / math.log1p(-right)


def _random_triples(n: int, count: int, random: np.random.Generator) -> IntArray:
    """(3, count) indices below n, three different ones in each column: each some way on from the one before."""
    triples = random.integers([[0], [1], [1]], [[n], [n], [n - 1]], (3, count))
    triples[2] += triples[1] + (triples[2] >= n - triples[1])  # not all the way round, to where it began
    triples[1:] += triples[0]
    triples %= n
    return triples


def _alike(rows: _Rows, triples: IntArray) -> FloatArray:
    """(3, b, 2, 3): of the triangles of (3, count) points, before and after, those whose sides agree best, for their
    size."""
    if triples.shape[1] > _KEPT_TRIPLES:
        before, after = (_sides(points, triples) for points in rows)
        with np.errstate(divide="ignore", invalid="ignore"):
            unlike = np.abs(before - after).max(axis=0) / np.minimum(before, after).min(axis=0)
        triples = triples[:, np.argpartition(unlike, _KEPT_TRIPLES)[:_KEPT_TRIPLES]]  # NaN is last
    return np.stack([points.T[triples] for points in rows], axis=2)


def _sides(points: FloatArray, triples: IntArray) -> FloatArray:
    """(3, count) lengths of the sides of triangles of points (3, n)."""
    corners = points.take(triples, axis=1)
    along = corners.take(_NEXT, axis=1)
    along -= corners
    return np.sqrt(_squared_lengths(along))


def _frames(triangles: FloatArray) -> FloatArray:
    """(b, 2, 3, 3) right-handed axes, in columns, of triangles (3, b, 2, 3); NaN where one is a line."""
    along, other = triangles[1] - triangles[0], triangles[2] - triangles[0]
    axes = np.empty((*along.shape, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        along /= np.sqrt(np.einsum("ijk,ijk->ij", along, along))[..., None]
        normal = _cross(along, other)
        normal /= np.sqrt(np.einsum("ijk,ijk->ij", normal, normal))[..., None]
    axes[..., 0], axes[..., 1], axes[..., 2] = along, _cross(normal, along), normal
    return axes


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """(..., 3): `np.cross`, which takes most of its time to arrange its axes."""
    product: FloatArray = a[..., _NEXT] * b[..., _BEFORE]
    product -= a[..., _BEFORE] * b[..., _NEXT]
    return product


def _squared_of_all(
    source: Float32Array, target: Float32Array, rotations: FloatArray, translations: FloatArray
) -> Float32Array:
    """(b, n) squared residuals of motions (b, 3, 3), (b, 3), of points in columns (3, n), in single precision."""
    off = (rotations.astype(np.float32).reshape(-1, 3) @ source).reshape(len(rotations), 3, -1)
    off -= target
    off += translations.astype(np.float32)[:, :, None]
    off *= off
    squared: Float32Array = off[:, 0]
    squared += off[:, 1]
    squared += off[:, 2]
    return squared


def _squared(rows: _Rows, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    off = rotation @ rows[0]
    off += translation[:, None]
    off -= rows[1]
    return _squared_lengths(off)


def _squared_lengths(vectors: FloatArray) -> FloatArray:
    """(n,) of vectors (3, n), which are changed."""
    vectors *= vectors
    squared: FloatArray = vectors[0]
    squared += vectors[1]
    squared += vectors[2]
    return squared


def _agreement(residuals: FloatArray, reach_m: float, least: float) -> _Agreement:
    """Of residuals (n,) m: those within twice the smallest distance that holds many more than the shell around it.

    Pairs without a motion fill space evenly: the shell from r to 2 r has seven times the room of the ball within. By
    chance a residual is within r with the probability (r / R)^3, R = `reach_m`.
    """
    n = len(residuals)
    r = np.maximum(np.sort(residuals), _FLOOR_M)
    counts, choices = _counts(n)
    within_twice = r.searchsorted(2.0 * r)
    dense = 7.0 * counts > _CONTRAST * (within_twice - counts + 1.0)
    first = max(int(least * _CAUTION * n), _FEWEST_AGREEING) - 1
    place = first + int(dense[first:].argmax())
    count = int(within_twice[place]) if dense[place] else n
    sigma_m = float(r[:count].mean()) / _MEAN_NORM
    log_chance = choices[count - 1] + 3.0 * (count - 3) * math.log(min(r[count - 1] / reach_m, 1.0))
    share = count / n
    return _Agreement(share, sigma_m, float(log_chance), sigma_m < _CLEAR_SIGMA * reach_m)


@lru_cache(maxsize=64)
def _counts(n: int) -> tuple[FloatArray, FloatArray]:
    """k = 1, ..., n, and log(n - 3) + log C(n, k) + log C(k, 3), from k = 4 on."""
    k = np.arange(1.0, n + 1.0)

    def log_choose(of: FloatArray | float, take: FloatArray | float) -> FloatArray:
        return np.asarray(gammaln(of + 1.0) - gammaln(take + 1.0) - gammaln(of - take + 1.0))

    return k, math.log(n - 3.0) + log_choose(float(n), k) + log_choose(np.maximum(k, 3.0), 3.0)


def _growth(source: FloatArray, squared: FloatArray, inliers: BoolArray) -> FloatArray:
    """(n,) how much larger than at the middle range of points (3, n) the squared errors are: a power of it, or one.

    The range's errors of stereo and of learned depth grow with it. The power is a regression of the logarithms.
    """
    flat = np.ones(len(squared))
    if np.count_nonzero(inliers) < _FEWEST_FOR_GROWTH:
        return flat
    x = np.log(np.maximum(_squared_lengths(source.copy()), 1e-6))
    x -= float(x[inliers].mean())
    within = x[inliers]
    spread = float(within @ within)
    if spread < _LITTLE_DEPTH * len(within):
        return flat
    errors = np.log(np.maximum(squared[inliers], _FLOOR_M**2))
    errors -= errors.mean()
    power = float(within @ errors) / spread
    sigma = math.sqrt(max(float(errors @ errors) - power**2 * spread, 0.0) / (spread * len(within)))
    if power < _GROWTH_SIGMAS * sigma:
        return flat
    grown: FloatArray = np.exp(min(power, _MOST_GROWTH) * x)
    return grown


def _fitted(rows: _Rows, weights: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotation and translation of the weighted least squares (Eq. 18-20), and the points' spread (3,), m^2."""
    weights = weights / weights.sum()
    source, target = rows
    source_mean, target_mean = source @ weights, target @ weights
    moments = ((target - target_mean[:, None]) * weights) @ (source - source_mean[:, None]).T
    u, spread, vt = np.linalg.svd(moments)
    rotation = u @ vt
    if np.linalg.det(rotation) < 0.0:
        u[:, 2] = -u[:, 2]
        rotation = u @ vt
    return rotation, target_mean - rotation @ source_mean, spread
