"""Residuals of directions, one coordinate at a time, which is faster in numpy; and ranges from two directions."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.transform import RigidTransform


def products(across: FloatArray, vectors: FloatArray) -> FloatArray:
    """(2, n) products of pairs of directions (3, 2, n) with vectors (3, n), or one (3, 1) for all."""
    along: FloatArray = np.add.reduce(across * vectors[:, None], axis=0)
    return along


def times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """(..., 2, n) products of matrices (2, 2, n) with vectors (..., 2, n)."""
    product: FloatArray = matrices[:, 0] * vectors[..., :1, :]
    product += matrices[:, 1] * vectors[..., 1:, :]
    return product


def whitening(parallax: FloatArray, flow_px: float, depth_sigma: float) -> FloatArray:
    """(2, 2, n) inverse roots W of ``C = flow^2 I + depth^2 p p'``, p the parallaxes (2, n): W' W = inverse of C.

    The first row of W is along the parallax, the second across it.

    Args:
        parallax: (2, n) derivative of the pixels by the logarithm of a point's depth.
        flow_px: standard deviation of a match.
        depth_sigma: standard deviation of that logarithm.
    """
    x, y = parallax
    length2 = x * x + y * y
    still = length2 == 0.0
    root = 1.0 / np.sqrt(np.where(still, 1.0, length2))
    whitened = np.empty((2, *parallax.shape))
    np.multiply(parallax, root / np.sqrt(flow_px**2 + depth_sigma**2 * length2), out=whitened[0])
    np.multiply(-y, root / flow_px, out=whitened[1, 0])
    np.multiply(x, root / flow_px, out=whitened[1, 1])
    if still.any():
        whitened[:, :, still] = np.eye(2)[:, :, None] / flow_px
    return whitened


def inverse_ranges_of_rays(p: FloatArray, q: FloatArray, between: RigidTransform) -> tuple[FloatArray, FloatArray]:
    """Inverse ranges (n,) in the second image, per unit of the motion, and baselines (n,) across the ray.

    If a baseline is small, or NaN for pixels outside a lens's image circle, the inverse range is noise.

    Args:
        p: (n, 3) unit vectors in the first image, in the camera's axes.
        q: (n, 3) unit vectors of the same points in the second image.
        between: takes coordinates of the camera at the second image to those at the first.
    """
    # p is parallel to R q / w + t, so that p x R q + w (p x t) = 0: linear in w, and unbiased around zero.
    # With unit p, by Lagrange, (p x a) . (p x b) = a . b - (p . a) (p . b).
    turned, along = q @ between.rotation.T, p @ between.translation
    parallax = turned @ between.translation - along * np.einsum("ij,ij->i", p, turned)
    baseline = np.sqrt(np.maximum(between.translation @ between.translation - along**2, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return -parallax / baseline**2, baseline
