"""The drone's own motion from the background that all its cameras see (Eq. 7-21, Algorithm 1)."""

from __future__ import annotations

from flockd.config.parameters import GeometryParameters
from flockd.geometry.pairs import BACKGROUND_LABEL, PointPairs
from flockd.geometry.ransac import ransac_rigid
from flockd.geometry.refinement import refine_ego_motion
from flockd.geometry.rig import Rig
from flockd.messages import EgoMotion


def estimate_ego_motion(
    pairs: PointPairs, rig: Rig, interval_s: float, parameters: GeometryParameters, *, seed: int = 0
) -> EgoMotion:
    """``P_C = R_FC P_F + T_FC`` (Eq. 7) from the pairs labelled background, of all cameras together.

    Algorithm 1 finds it; with ``parameters.refine`` its reprojection error is then made small, and the result of
    Algorithm 1 stays where that fails. ``inliers`` and ``threshold_m`` are Algorithm 1's. Raises ValueError with the
    reason where there is no estimate.
    """
    background = pairs.select(pairs.labels == BACKGROUND_LABEL)
    found = ransac_rigid(
        background.current,
        background.previous,
        threshold=parameters.initial_threshold_m,
        min_inlier_ratio=parameters.min_inlier_ratio,
        hypotheses=parameters.hypotheses,
        max_threshold=parameters.max_threshold_m,
        seed=seed,
    )
    motion = found.transform
    if parameters.refine:
        motion = refine_ego_motion(background, rig, motion, seed=seed) or motion
    return EgoMotion(
        rotation=motion.rotation,
        translation=motion.translation,
        interval_s=interval_s,
        pairs=len(background),
        inliers=int(found.inliers.sum()),
        threshold_m=found.threshold,
    )
