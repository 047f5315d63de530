"""How far away matched pixels are, from the motion between their images."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.transform import RigidTransform


def inverse_ranges_of_rays(p: FloatArray, q: FloatArray, between: RigidTransform) -> tuple[FloatArray, FloatArray]:
    """Inverse ranges (n,) in the second image, in 1 over the motion's unit, and baselines (n,) across the ray.

    Where a baseline is small, or NaN for pixels outside a lens's image circle, the inverse range is noise.

    Args:
        p: (n, 3) unit vectors in the first image, in the camera's axes.
        q: (n, 3) those of the same points in the second.
        between: takes coordinates of the camera at the second image to those at the first.
    """
    # p is parallel to R q / w + t, so that p x R q + w (p x t) = 0: linear in w, and honest about noise around zero.
    # With unit p, by Lagrange, (p x a) . (p x b) = a . b - (p . a) (p . b).
    turned, along = q @ between.rotation.T, p @ between.translation
    parallax = turned @ between.translation - along * np.einsum("ij,ij->i", p, turned)
    baseline = np.sqrt(np.maximum(between.translation @ between.translation - along**2, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return -parallax / baseline**2, baseline
