"""A neighbour's motion (Eq. 22-37) where both drones' motions are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.config.geometry import GeometryParameters
from flockd.core.messages import EgoMotion, FloatArray
from flockd.flight.geometry import (
    PointPairs,
    RigidTransform,
    estimate_neighbour_motion,
    rotation_from_euler,
)

from .synthetic_world import four_camera_rig

RIG = four_camera_rig()
OWN_STEP = RigidTransform(rotation_from_euler(0.01, -0.02, 0.05), np.array([0.45, 0.1, -0.02]))  # F to C
EGO = EgoMotion(OWN_STEP.rotation, OWN_STEP.translation, interval_s=0.5, pairs=100, inliers=100, threshold_m=0.01)
INTERVAL_S = 0.5


def neighbour_pairs(
    centre_c: FloatArray, turn: FloatArray, shift_c: FloatArray, random: np.random.Generator
) -> tuple[PointPairs, FloatArray]:
    """Points on a 0.6 m box that turns about its centre and is shifted, in C, and each camera's view of them; and the
    box's corners at the end, in F."""
    half = np.array([0.3, 0.3, 0.1])
    body = np.concatenate([random.uniform(-half, half, (300, 3)), [half, -half]])
    previous = body + centre_c
    current = OWN_STEP.inverse().apply(body @ turn.T + centre_c + shift_c)
    before, after = RIG.pixels_of(previous), RIG.pixels_of(current)
    several = []
    for name in RIG.cameras:
        seen = np.isfinite(before[name][:, 0]) & np.isfinite(after[name][:, 0])
        several.append(
            PointPairs(
                previous=previous[seen],
                current=current[seen],
                labels=np.full(int(seen.sum()), 1),
                camera_names=np.full(int(seen.sum()), name),
                pixels_previous=before[name][seen],
                pixels_current=after[name][seen],
            )
        )
    return PointPairs.concatenate(several), current


def test_a_neighbours_motion_is_freed_of_the_own_one() -> None:
    shift = np.array([0.3, -0.2, 0.05])
    turn = Rotation.from_euler("ZYX", [8.0, 3.0, -2.0], degrees=True).as_matrix()
    pairs, current = neighbour_pairs(np.array([5.0, 0.5, -0.4]), turn, shift, np.random.default_rng(0))
    motion = estimate_neighbour_motion(pairs, EGO, GeometryParameters())
    assert np.allclose(motion.rotation, turn, atol=1e-6)
    # The mean of the points moves by the shift and by what the turn does to the mean's small offset from the centre.
    mean_offset = pairs.previous.mean(axis=0) - [5.0, 0.5, -0.4]
    assert np.allclose(motion.translation, shift + turn @ mean_offset - mean_offset, atol=1e-9)
    assert np.allclose(motion.velocity, motion.translation / INTERVAL_S)
    assert np.allclose(motion.centre, (current.min(axis=0) + current.max(axis=0)) / 2.0)
    assert motion.pairs == motion.inliers == len(pairs)


@pytest.mark.parametrize("outlier_share", [0.3, 0.6])
def test_background_behind_the_neighbour_neither_drags_nor_widens_it(outlier_share: float) -> None:
    random = np.random.default_rng(3)
    shift = np.array([0.3, 0.1, 0.0])
    pairs, current = neighbour_pairs(np.array([6.0, 0.0, 0.0]), np.eye(3), shift, random)
    wrong = random.random(len(pairs)) < outlier_share
    behind = pairs.previous * random.uniform(1.3, 2.0, (len(pairs), 1))
    spoilt = PointPairs(
        previous=np.where(wrong[:, None], behind, pairs.previous),
        current=np.where(wrong[:, None], OWN_STEP.inverse().apply(behind), pairs.current),  # it stands still
        labels=pairs.labels,
        camera_names=pairs.camera_names,
        pixels_previous=pairs.pixels_previous,
        pixels_current=pairs.pixels_current,
    )
    motion = estimate_neighbour_motion(spoilt, EGO, GeometryParameters())
    if outlier_share < 0.5:
        assert motion.inliers == np.count_nonzero(~wrong)
        assert np.allclose(motion.velocity, shift / INTERVAL_S, atol=1e-6)
        assert np.allclose(motion.centre, (current[~wrong].min(axis=0) + current[~wrong].max(axis=0)) / 2.0)
    else:
        # The larger set that moves as one wins, and it is the background.
        assert np.allclose(motion.velocity, 0.0, atol=1e-6)


def test_too_few_points_are_no_estimate() -> None:
    pairs, _ = neighbour_pairs(np.array([5.0, 0.0, 0.0]), np.eye(3), np.zeros(3), np.random.default_rng(4))
    with pytest.raises(ValueError, match="fewer than three pairs"):
        estimate_neighbour_motion(pairs.select(np.array([0, 1])), EGO, GeometryParameters())
