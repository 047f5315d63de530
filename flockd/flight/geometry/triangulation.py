"""How far away matched pixels are, from the motion between their images."""

from __future__ import annotations

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.rig import RigCamera
from flockd.flight.geometry.transform import RigidTransform


def inverse_depths(
    camera: RigCamera, motion: RigidTransform, start: FloatArray, end: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Inverse depths (n,) in the second image, in 1 over the motion's unit, and baselines (n,) across the ray.

    Where a baseline is small, or NaN for pixels outside a lens's image circle, the inverse depth is noise.

    Args:
        camera: of both images.
        motion: takes body coordinates at the second image to those at the first.
        start: (n, 2) pixels in the first image.
        end: (n, 2) the same points in the second.
    """
    between = camera.T_body_camera.inverse() @ motion @ camera.T_body_camera
    # p is parallel to R q / w + t, so that p x R q + w (p x t) = 0: linear in w, and honest about noise around zero.
    p = camera.camera.rays(start)
    turned = camera.camera.unproject(end, np.ones(len(end))) @ between.rotation.T
    across, parallax = np.cross(p, between.translation), np.cross(p, turned)
    baseline = np.linalg.norm(across, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = -(parallax * across).sum(axis=1) / baseline**2
    return inverse, baseline
