"""The rigid motion that most pairs agree on: by consensus, or by Algorithm 1, whose threshold finds its own size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from flockd.core.messages import BoolArray, FloatArray, IntArray
from flockd.flight.geometry.rigid_fit import checked_pairs, fit_rigid, kabsch
from flockd.flight.geometry.robust.consensus import FEWEST_PAIRS, find_consensus
from flockd.flight.geometry.transform import RigidTransform

_RESELECTIONS = 10
_FLAT_TRIANGLE = 1e-3  # height over longest side under which three points count as collinear
_CHUNK = 100_000  # residuals held at once while scoring


@dataclass(frozen=True, eq=False)
class RansacResult:
    """The motion, the mask (n,) of the pairs that agree with it, and the threshold in metres within which they do."""

    transform: RigidTransform
    inliers: BoolArray
    threshold: float
    covariance: FloatArray | None = None
    """(6, 6) of a left increment (rotation vector in rad, translation in m) of the motion; None: by Algorithm 1."""


Method = Literal["consensus", "paper"]


def ransac_rigid(
    source: FloatArray,
    target: FloatArray,
    *,
    method: Method = "consensus",
    threshold: float = 0.01,
    min_inlier_ratio: float = 0.2,
    seed: int = 0,
    hypotheses: int = 200,
    max_threshold: float = 2.0,
) -> RansacResult:
    """The motion ``target = R source + t`` of ``source`` and ``target`` (n, 3) metres, despite outliers.

    ``consensus`` learns the size of the errors from the pairs, and whether it grows with the range: see
    `find_consensus`; it has no use for ``threshold`` and ``hypotheses``. ``paper`` is Algorithm 1, which also stands in
    where there are fewer than ten pairs. Its threshold doubles from ``threshold`` metres, at most to ``max_threshold``,
    until some hypothesis, fitted to three random pairs, has more than ``min_inlier_ratio`` n pairs within it; the
    hypothesis with the most wins and is fitted again to all its inliers. Every threshold sees ``hypotheses``
    hypotheses, as when Algorithm 1's inner counter is reset; they are the same ones, so each is scored only once.
    Beyond the paper: fitting and selecting alternate for as long as that finds more inliers.

    Deterministic for a ``seed``. Raises ValueError with the reason for degenerate input (see `fit_rigid`), and where
    no motion has enough inliers.
    """
    source, target = checked_pairs(source, target)
    if not 0.0 < threshold <= max_threshold:
        raise ValueError(f"the threshold {threshold} m must be positive and not above its maximum {max_threshold} m")
    if method == "consensus" and len(source) >= FEWEST_PAIRS:
        found = find_consensus(
            source, target, min_inlier_ratio=min_inlier_ratio, max_threshold=max_threshold, seed=seed
        )
        return RansacResult(found.transform, found.inliers, found.threshold, found.covariance(target))
    rotations, translations = _hypotheses(source, target, hypotheses, np.random.default_rng(seed))
    ladder = [threshold]
    while ladder[-1] * 2.0 <= max_threshold:
        ladder.append(ladder[-1] * 2.0)
    counts = _count_inliers(source, target, rotations, translations, np.array(ladder))
    # Three pairs always fit their own motion: they are evidence of nothing, but fewer cannot be refitted.
    enough = counts > max(min_inlier_ratio * len(source), 2)
    if not enough.any():
        best_share = counts[:, -1].max() / len(source)
        raise ValueError(
            f"no motion has more than {min_inlier_ratio:.0%} of {len(source)} pairs within {ladder[-1]:g} m; "
            f"the best has {best_share:.0%}"
        )
    step = int(np.argmax(enough.any(axis=0)))
    winner = int(np.argmax(counts[:, step]))
    inliers = _inliers(source, target, RigidTransform(rotations[winner], translations[winner]), ladder[step])
    transform = fit_rigid(source[inliers], target[inliers])
    for _ in range(_RESELECTIONS):
        wider = _inliers(source, target, transform, ladder[step])
        if wider.sum() <= inliers.sum():
            break
        inliers = wider
        transform = fit_rigid(source[inliers], target[inliers])
    return RansacResult(transform, inliers, ladder[step])


def _hypotheses(
    source: FloatArray, target: FloatArray, count: int, random: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Motions of random triples that are not collinear."""
    triples = _random_triples(len(source), count, random)
    usable = _is_wide(source[triples]) & _is_wide(target[triples])
    if not usable.any():
        raise ValueError("the points are collinear: no three of those drawn span a triangle")
    triples = triples[usable]
    return kabsch(source[triples], target[triples], np.full(3, 1.0 / 3.0))


def _random_triples(n: int, count: int, random: np.random.Generator) -> IntArray:
    """(count, 3) indices below n, three different ones in each row."""
    first = random.integers(0, n, count)
    second = random.integers(0, n - 1, count)
    second += second >= first
    third = random.integers(0, n - 2, count)
    # Step over the two that are taken, the lower one first.
    third += third >= np.minimum(first, second)
    third += third >= np.maximum(first, second)
    return np.stack([first, second, third], axis=1)


def _is_wide(triangles: FloatArray) -> BoolArray:
    """Mask (b,) of the triangles (b, 3, 3) that are not collinear."""
    a = triangles[:, 1] - triangles[:, 0]
    b = triangles[:, 2] - triangles[:, 0]
    longest_squared = np.maximum.reduce([(a * a).sum(1), (b * b).sum(1), ((a - b) ** 2).sum(1)])
    doubled_area = np.linalg.norm(np.cross(a, b), axis=1)
    wide: BoolArray = doubled_area > _FLAT_TRIANGLE * longest_squared
    return wide


def _count_inliers(
    source: FloatArray, target: FloatArray, rotations: FloatArray, translations: FloatArray, thresholds: FloatArray
) -> IntArray:
    """(hypotheses, thresholds): how many pairs each hypothesis brings within each threshold."""
    # Single precision is good to 10 micrometres within 100 m, and takes half the time. Small chunks stay in the cache.
    source_rows = np.ascontiguousarray(source.T, dtype=np.float32)
    target_rows = np.ascontiguousarray(target.T, dtype=np.float32)
    rotations, translations = rotations.astype(np.float32), translations.astype(np.float32)
    limits = (thresholds**2).astype(np.float32)
    counts = np.empty((len(rotations), len(thresholds)), dtype=np.int64)
    rows = max(1, _CHUNK // len(source))
    for start in range(0, len(rotations), rows):
        chunk = slice(start, start + rows)
        difference = rotations[chunk] @ source_rows
        difference += translations[chunk, :, None]
        difference -= target_rows
        difference *= difference
        squared = difference.sum(axis=1)
        for column, limit in enumerate(limits):
            counts[chunk, column] = np.count_nonzero(squared < limit, axis=1)
    return counts


def _inliers(source: FloatArray, target: FloatArray, transform: RigidTransform, threshold: float) -> BoolArray:
    difference = target - transform.apply(source)
    inside: BoolArray = np.einsum("ij,ij->i", difference, difference) < threshold**2
    return inside
