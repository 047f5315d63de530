"""Rotations, rigid transforms and their fits against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.messages import FloatArray
from flockd.flight.geometry import (
    RigidTransform,
    euler_from_rotation,
    fit_rigid,
    rotation_from_euler,
)
from flockd.flight.geometry.rotations import rotation_from_vector, vector_from_rotation


def test_euler_angles_agree_with_scipy_both_ways() -> None:
    random = np.random.default_rng(0)
    for roll, pitch, yaw in random.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (50, 3)):
        expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        assert np.allclose(rotation_from_euler(roll, pitch, yaw), expected, atol=1e-12)
        assert euler_from_rotation(expected) == pytest.approx((roll, pitch, yaw))


def test_rotation_vectors_agree_with_scipy_both_ways_up_to_half_a_turn() -> None:
    random = np.random.default_rng(1)
    for scale in (0.0, 1e-200, 1e-12, 1e-6, 0.1, 3.0, 20.0):
        vector = random.normal(0.0, scale, 3)
        expected = Rotation.from_rotvec(vector).as_matrix()
        assert np.allclose(rotation_from_vector(vector), expected, rtol=0.0, atol=1e-14)
        assert np.allclose(rotation_from_vector(vector[None])[0], expected, rtol=0.0, atol=1e-14)
    assert np.isnan(rotation_from_vector(np.array([0.0, np.inf, 1.0]))).all()
    for degrees in (0.0, 1e-9, 0.01, 30.0, 120.0, 170.0, 179.9):
        for axis in random.normal(size=(20, 3)):
            rotation = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
            assert vector_from_rotation(rotation.as_matrix()) == pytest.approx(rotation.as_rotvec(), abs=1e-12)


def test_transforms_chain_and_invert_like_4x4_matrices() -> None:
    random = np.random.default_rng(2)
    one, other = np.tile(np.eye(4), (2, 1, 1))
    for matrix in (one, other):
        matrix[:3, :3], matrix[:3, 3] = Rotation.random(rng=random).as_matrix(), random.normal(size=3)
    transforms = [RigidTransform(matrix[:3, :3], matrix[:3, 3]) for matrix in (one, other)]
    points = random.normal(size=(5, 3))
    chained = (transforms[0] @ transforms[1].inverse()).apply(points)
    expected = np.column_stack([points, np.ones(5)]) @ (one @ np.linalg.inv(other)).T
    assert np.allclose(chained, expected[:, :3])


@pytest.mark.parametrize(
    ("rotation", "translation", "reason"),
    [
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3), "not a rotation"),
        (np.eye(3) * 1.01, np.zeros(3), "not a rotation"),
        (np.full((3, 3), np.nan), np.zeros(3), "not a rotation"),
        (np.eye(3), np.array([0.0, np.nan, 0.0]), "finite"),
        (np.eye(4), np.zeros(3), r"\(3, 3\)"),
    ],
)
def test_what_is_no_rigid_motion_is_refused(rotation: np.ndarray, translation: np.ndarray, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        RigidTransform(rotation, translation)


# Kabsch's fit against scipy's, which solves the same problem by its own code.


SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
LINE = np.outer(np.arange(5.0), [1.0, 2.0, -1.0]) + np.array([3.0, 0.0, 1.0])


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(("count", "noise_m"), [(3, 0.0), (4, 0.0), (50, 0.0), (30, 0.5)])
def test_points_give_scipys_least_squares_result(weighted: bool, count: int, noise_m: float) -> None:
    random = np.random.default_rng(1)
    for _ in range(10):
        source, turn, shift = random.normal(0.0, 5.0, (count, 3)), Rotation.random(rng=random), random.normal(size=3)
        target = turn.apply(source) + shift + random.normal(0.0, noise_m, (count, 3))
        weights = random.uniform(0.1, 2.0, count) if weighted else np.ones(count)
        source_mean, target_mean = (np.average(p, axis=0, weights=weights) for p in (source, target))
        expected, _ = Rotation.align_vectors(target - target_mean, source - source_mean, weights=weights)
        found = fit_rigid(source, target, weights if weighted else None)
        assert np.allclose(found.rotation, expected.as_matrix(), atol=1e-9)
        assert np.allclose(found.translation, target_mean - expected.apply(source_mean), atol=1e-9)
        assert noise_m > 0 or np.allclose(found.rotation, turn.as_matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ("source", "target", "weights", "reason"),
    [
        (SQUARE[:2], SQUARE[:2], None, "fewer than three pairs"),
        (SQUARE, SQUARE[:3], None, "4 source points, 3 target points"),
        (SQUARE[:, :2], SQUARE[:, :2], None, r"\(n, 3\)"),
        (SQUARE, np.where(SQUARE > 0.5, np.inf, SQUARE), None, "not finite"),
        (LINE, LINE + 1.0, None, "source points are collinear"),
        (SQUARE, LINE[:4], None, "target points are collinear"),
        (np.full((4, 3), 2.5), SQUARE, None, "source points coincide"),
        (SQUARE, SQUARE, np.array([1.0, 1.0, 0.0, 0.0]), "collinear"),
        (SQUARE, SQUARE, np.array([1.0, 1.0, 1.0, -1.0]), "negative"),
        (SQUARE, SQUARE, np.array([1.0, 1.0, 1.0, np.nan]), "finite"),
        (SQUARE, SQUARE, np.zeros(4), "some must be positive"),
        (SQUARE, SQUARE, np.ones(3), "as many weights"),
    ],
)
def test_degenerate_input_is_refused_with_its_reason(
    source: FloatArray, target: FloatArray, weights: FloatArray | None, reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        fit_rigid(source, target, weights)
