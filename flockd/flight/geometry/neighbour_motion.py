"""A neighbour's own motion, freed of the drone's own (Eq. 22-37)."""

from __future__ import annotations

from flockd.core.config.geometry import GeometryParameters
from flockd.core.messages import EgoMotion, NeighbourMotion
from flockd.flight.geometry.pairs import PointPairs
from flockd.flight.geometry.robust.ransac import ransac_rigid
from flockd.flight.geometry.transform import RigidTransform


def estimate_neighbour_motion(
    pairs: PointPairs, ego: EgoMotion, parameters: GeometryParameters, *, seed: int = 0
) -> NeighbourMotion:
    """How one neighbour moved in C, and where it is in F, from all pairs on it, whichever cameras saw them.

    By Algorithm 1: of a few pairs, whose errors are not small beside the neighbour's size, consensus learns too little,
    and rounding decided whether there was a motion. Raises ValueError with the reason where there is no estimate.
    """
    current_in_c = RigidTransform(ego.rotation, ego.translation).apply(pairs.current)  # Eq. 22
    found = ransac_rigid(
        pairs.previous,
        current_in_c,
        method="paper",
        threshold=parameters.initial_threshold_m,
        min_inlier_ratio=parameters.min_inlier_ratio,
        hypotheses=parameters.hypotheses,
        max_threshold=parameters.max_threshold_m,
        seed=seed,
    )  # Eq. 34
    translation = current_in_c[found.inliers].mean(axis=0) - pairs.previous[found.inliers].mean(axis=0)  # Eq. 35
    seen = pairs.current[found.inliers]
    return NeighbourMotion(
        rotation=found.transform.rotation,
        translation=translation,
        velocity=translation / ego.interval_s,  # Eq. 36
        interval_s=ego.interval_s,
        centre=(seen.min(axis=0) + seen.max(axis=0)) / 2.0,  # Eq. 37
        pairs=len(pairs),
        inliers=int(found.inliers.sum()),
    )
