"""The drone's own motion, from the background in all its cameras (Eq. 7-21, Algorithm 1)."""

from __future__ import annotations

import numpy as np

from flockd.core.config.geometry import GeometryParameters
from flockd.core.messages import EgoMotion, FloatArray
from flockd.flight.geometry.ego_motion_refinement import refine_ego_motion
from flockd.flight.geometry.pairs import PointPairs
from flockd.flight.geometry.rig import Rig, RigCamera
from flockd.flight.geometry.robust.ransac import ransac_rigid
from flockd.flight.geometry.transform import RigidTransform

_EXPLAINED_PX = 3.0
"""A motion explains a match if it moves it to within this distance."""
_MIN_EXPLAINED = 0.08
"""Least share of all matches that a motion explains. On real images true motions explain at least 15 %. Motions found
in false matches only, some of which always agree within metres, explain less than 6 %."""
_MIN_KEPT = 0.9
"""Least share of the explained matches that the refinement keeps; if it loses more, it has followed false matches."""


def estimate_ego_motion(pairs: PointPairs, rig: Rig, interval_s: float, parameters: GeometryParameters) -> EgoMotion:
    """``P_C = R_FC P_F + T_FC`` (Eq. 7) from the background pairs of all cameras together.

    By Algorithm 1. With ``parameters.refine`` its reprojection error is then minimised; if that loses matches, the
    result of Algorithm 1 is kept. ``inliers`` and ``threshold_m`` are Algorithm 1's. Raises ValueError with the
    reason if there is no estimate, or if it explains too few of its matches.
    """
    found = ransac_rigid(
        pairs.current,
        pairs.previous,
        threshold=parameters.initial_threshold_m,
        min_inlier_ratio=parameters.min_inlier_ratio,
        hypotheses=parameters.hypotheses,
        max_threshold=parameters.max_threshold_m,
    )
    motion = found.transform
    by_camera = [(camera, pairs[pairs.camera_names == name]) for name, camera in rig.cameras.items()]
    explained = _explained(by_camera, motion) / len(pairs)
    if parameters.refine:
        refined = refine_ego_motion(pairs, rig, motion, found.inliers)
        still = _explained(by_camera, refined) / len(pairs)
        if still >= _MIN_KEPT * explained:
            motion, explained = refined, still
    if explained < _MIN_EXPLAINED:
        raise ValueError(
            f"the best motion explains only {explained:.1%} of {len(pairs)} matches within {_EXPLAINED_PX:g} px"
        )
    return EgoMotion(
        rotation=motion.rotation,
        translation=motion.translation,
        interval_s=interval_s,
        pairs=len(pairs),
        inliers=int(found.inliers.sum()),
        threshold_m=found.threshold,
    )


def _explained(by_camera: list[tuple[RigCamera, PointPairs]], motion: RigidTransform) -> int:
    """Number of matches, by the camera that saw them, that the motion explains."""
    near = 0
    for camera, pairs in by_camera:
        u, v = (moved_pixels(camera, pairs.previous, motion) - pairs.pixels_current).T
        near += int(np.count_nonzero(u * u + v * v < _EXPLAINED_PX**2))  # NaN behind a camera compares false
    return near


def moved_pixels(camera: RigCamera, points: FloatArray, motion: RigidTransform) -> FloatArray:
    """(n, 2) where a camera of a body that moved, as in Eq. 7, sees points (n, 3) of C; NaN if not visible."""
    mount = camera.T_body_camera
    return camera.camera.project((motion.inverse().apply(points) - mount.translation) @ mount.rotation)
