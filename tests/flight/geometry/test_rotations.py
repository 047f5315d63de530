"""Rotations and rigid transforms against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.flight.geometry import RigidTransform, euler_from_rotation, rotation_angle_deg, rotation_from_euler
from flockd.flight.geometry.rotations import rotation_from_vector, vector_from_rotation


def test_euler_angles_agree_with_scipy_both_ways() -> None:
    random = np.random.default_rng(0)
    for roll, pitch, yaw in random.uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (50, 3)):
        expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        assert np.allclose(rotation_from_euler(roll, pitch, yaw), expected, atol=1e-12)
        assert euler_from_rotation(expected) == pytest.approx((roll, pitch, yaw))


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_a_nose_straight_up_or_down_still_gives_angles_of_the_same_attitude(pitch: float) -> None:
    attitude = Rotation.from_euler("ZYX", [0.4, pitch, 0.3]).as_matrix()
    roll, found_pitch, yaw = euler_from_rotation(attitude)
    assert roll == 0.0
    assert np.allclose(Rotation.from_euler("ZYX", [yaw, found_pitch, roll]).as_matrix(), attitude, atol=1e-8)


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 0.01, 45.0, 179.9999, 180.0])
def test_the_angle_of_a_rotation_survives_from_tiny_to_half_a_turn(degrees: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    rotation = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    assert rotation_angle_deg(rotation) == pytest.approx(degrees, abs=1e-9)


def test_rotation_vectors_agree_with_scipy() -> None:
    random = np.random.default_rng(1)
    for scale in (0.0, 1e-200, 1e-12, 1e-6, 0.1, 3.0, 20.0):
        vector = random.normal(0.0, scale, 3)
        expected = Rotation.from_rotvec(vector).as_matrix()
        assert np.allclose(rotation_from_vector(vector), expected, rtol=0.0, atol=1e-14)
        assert np.allclose(rotation_from_vector(vector[None])[0], expected, rtol=0.0, atol=1e-14)
    assert np.isnan(rotation_from_vector(np.array([0.0, np.inf, 1.0]))).all()


def test_vectors_of_single_rotations_agree_with_scipy_up_to_half_a_turn() -> None:
    random = np.random.default_rng(4)
    for degrees in (0.0, 1e-9, 0.01, 30.0, 120.0, 170.0, 179.9):
        for axis in random.normal(size=(20, 3)):
            rotation = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
            assert vector_from_rotation(rotation.as_matrix()) == pytest.approx(rotation.as_rotvec(), abs=1e-12)


def test_transforms_chain_and_invert_like_4x4_matrices() -> None:
    random = np.random.default_rng(2)
    homogeneous, transforms = [], []
    for _ in range(2):
        rotation, translation = Rotation.random(rng=random).as_matrix(), random.normal(size=3)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, translation
        homogeneous.append(matrix)
        transforms.append(RigidTransform(rotation, translation))
    points = random.normal(size=(5, 3))
    padded = np.concatenate([points, np.ones((5, 1))], axis=1)
    chained = (transforms[0] @ transforms[1].inverse()).apply(points)
    expected = padded @ (homogeneous[0] @ np.linalg.inv(homogeneous[1])).T
    assert np.allclose(chained, expected[:, :3])
    assert np.array_equal(RigidTransform.identity().apply(points), points)


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
