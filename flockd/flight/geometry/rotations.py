"""Rotation matrices from and to angles, vectors and quaternions: the adapter of scipy, which has no types."""

from __future__ import annotations

import math
import warnings

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.messages import FloatArray


def rotation_angle_deg(rotation: FloatArray) -> float:
    """Angle of a (3, 3) rotation, degrees in [0, 180]."""
    return math.degrees(float(Rotation.from_matrix(rotation).magnitude()))


def rotation_from_euler(roll: float | FloatArray, pitch: float | FloatArray, yaw: float | FloatArray) -> FloatArray:
    """(3, 3) ``R_ned_body`` of an attitude in radians, aerospace order: yaw about down, then pitch, then roll.

    (n, 3, 3) of angles (n,).
    """
    return np.asarray(Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1)).as_matrix())


def euler_from_rotation(rotation: FloatArray) -> tuple[float, float, float]:
    """Roll, pitch, yaw in radians of a (3, 3) ``R_ned_body``; pitch in [-pi/2, pi/2].

    With the nose straight up or down roll and yaw share one axis: roll is then 0.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # scipy warns if the nose is straight up or down
        yaw, pitch, roll = Rotation.from_matrix(rotation).as_euler("ZYX")
    return float(roll), float(pitch), float(yaw)


def rotation_from_vector(vector: FloatArray) -> FloatArray:
    """(3, 3) rotation about the direction of ``vector`` (3,) by its length in radians; (n, 3, 3) of (n, 3)."""
    if np.ndim(vector) == 1:  # scipy is several times slower for a single one
        return np.asarray(cv2.Rodrigues(np.asarray(vector, np.float64))[0], np.float64)
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def vector_from_rotation(rotation: FloatArray) -> FloatArray:
    """The inverse of `rotation_from_vector`: (3,) of a (3, 3) rotation, (n, 3) of (n, 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def rotation_from_quaternion(quaternion: FloatArray) -> FloatArray:
    """(3, 3) of a quaternion (4,) x y z w of any length. Raises ValueError for length zero.

    By Rodrigues' formula: an autopilot's is read 20 times a second, and scipy is ten times slower.
    """
    cross, w, square = cross_matrix(quaternion[:3]), quaternion[3], float(quaternion @ quaternion)
    if not square > 0.0:
        raise ValueError("a quaternion has no length")
    rotation: FloatArray = np.eye(3) + 2.0 / square * (w * cross + cross @ cross)
    return rotation


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """(4,) x y z w with w >= 0 of a (3, 3) rotation."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True))


def crossed(a: FloatArray, b: FloatArray) -> FloatArray:
    """(3, ...) cross products: `np.cross` spends most of its time on rearranging axes."""
    a, b = np.concatenate([a, a[:2]]), np.concatenate([b, b[:2]])
    product: FloatArray = a[1:4] * b[2:5]
    product -= a[2:5] * b[1:4]
    return product


def cross_matrix(vector: FloatArray) -> FloatArray:
    """(3, 3) that takes y to ``vector x y``."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
