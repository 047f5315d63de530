"""How far away matched pixels are, from the motion between their images."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.rig import RigCamera
from flockd.flight.geometry.transform import RigidTransform


def inverse_ranges(
    camera: RigCamera, motion: RigidTransform, start: FloatArray, end: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Inverse ranges (n,) in the second image, in 1 over the motion's unit, and baselines (n,) across the ray.

    Where a baseline is small, or NaN for pixels outside a lens's image circle, the inverse range is noise.

    Args:
        camera: of both images.
        motion: takes body coordinates at the second image to those at the first.
        start: (n, 2) pixels in the first image.
        end: (n, 2) the same points in the second.
    """
    between = camera.T_body_camera.inverse() @ motion @ camera.T_body_camera
    return inverse_ranges_of_rays(camera.camera.rays(start), camera.camera.rays(end), between)


def inverse_ranges_of_rays(p: FloatArray, q: FloatArray, between: RigidTransform) -> tuple[FloatArray, FloatArray]:
    """The same, of rays in the camera's axes.

    Args:
        p: (n, 3) unit vectors in the first image.
        q: (n, 3) unit vectors in the second.
        between: takes coordinates of the camera at the second image to those at the first.
    """
    # p is parallel to R q / w + t, so that p x R q + w (p x t) = 0: linear in w, and honest about noise around zero.
    # With unit p, by Lagrange, (p x a) . (p x b) = a . b - (p . a) (p . b).
    turned, along = q @ between.rotation.T, p @ between.translation
    parallax = turned @ between.translation - along * np.einsum("ij,ij->i", p, turned)
    baseline = np.sqrt(np.maximum(between.translation @ between.translation - along**2, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        return -parallax / baseline**2, baseline
