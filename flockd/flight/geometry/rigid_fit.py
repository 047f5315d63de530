"""Least-squares rigid motion between paired points (Eq. 17-20): Kabsch's method by singular value decomposition."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.transform import RigidTransform

_COLLINEAR = 1e-6  # spread across a line relative to the spread along it


def fit_rigid(source: FloatArray, target: FloatArray, weights: FloatArray | None = None) -> RigidTransform:
    """The motion with the least weighted ``|target - (R source + t)|^2`` (Eq. 18-20).

    ``source`` and ``target`` are (n, 3) metres, ``weights`` (n,) not negative. Raises ValueError with the reason for
    fewer than three pairs, mismatched lengths, numbers that are not finite, and points that coincide or are collinear.
    """
    source, target = checked_pairs(source, target)
    if weights is None:
        weights = np.ones(len(source))
    weights = np.asarray(weights, dtype=np.float64)
    if weights.shape != (len(source),):
        raise ValueError(f"{len(source)} pairs need as many weights, not {weights.shape}")
    if not np.isfinite(weights).all() or weights.min() < 0.0 or weights.sum() <= 0.0:
        raise ValueError("weights must be finite and not negative, and some must be positive")
    weights = weights / weights.sum()
    for name, points in (("source", source), ("target", target)):
        _require_spread(name, points, weights)
    rotations, translations = kabsch(source[None], target[None], weights)
    return RigidTransform(rotations[0], translations[0])


def checked_pairs(source: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both as float64; raises ValueError if they are not paired points."""
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    for name, points in (("source", source), ("target", target)):
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"{name} points are (n, 3), not {points.shape}")
    if len(source) != len(target):
        raise ValueError(f"mismatched lengths: {len(source)} source points, {len(target)} target points")
    if len(source) < 3:
        raise ValueError(f"fewer than three pairs ({len(source)}) do not fix a rigid motion")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise ValueError("points that are not finite")
    return source, target


def kabsch(source: FloatArray, target: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (b, 3, 3) and translations (b, 3) of b problems: points (b, n, 3), weights (n,) that sum to 1."""
    source_mean = weights @ source  # Eq. 18
    target_mean = weights @ target  # Eq. 19
    centred_source = source - source_mean[:, None]
    centred_target = target - target_mean[:, None]
    rotations = _rotations((centred_target * weights[:, None]).transpose(0, 2, 1) @ centred_source)
    translations = target_mean - np.einsum("bij,bj->bi", rotations, source_mean)
    return rotations, translations


def _rotations(covariances: FloatArray) -> FloatArray:
    """(b, 3, 3) the rotations R with the largest trace of ``R^T covariance``, of covariances (b, 3, 3)."""
    u, _, vt = np.linalg.svd(covariances)  # Eq. 20
    # Without the sign the best orthogonal matrix may be a reflection, for flat or noisy points.
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    rotations: FloatArray = u @ vt
    return rotations


def _require_spread(name: str, points: FloatArray, weights: FloatArray) -> None:
    """Raises ValueError if points (n, 3) with weights (n,), which sum to 1, coincide or are collinear."""
    centred = points - weights @ points
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh((centred * weights[:, None]).T @ centred), 0.0))
    scale = max(float(np.abs(points).max()), 1e-9)
    if spread[2] <= 1e-9 * scale:
        raise ValueError(f"the {name} points coincide")
    if spread[1] <= _COLLINEAR * spread[2]:
        raise ValueError(f"the {name} points are collinear")
