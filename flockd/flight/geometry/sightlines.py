"""Residuals of directions, coordinate by coordinate, as numpy is faster so; and what a depth's error makes of them."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray


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
    """(2, 2, n) roots of the inverses of ``flow^2 I + depth^2 p p'``, p the parallaxes (2, n): its transpose times
    itself is that. The first row is along the parallax, the second across it.

    Args:
        parallax: (2, n) pixels by the logarithm of a point's depth.
        flow_px: standard deviation of a match.
        depth_sigma: that of the logarithm.
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
