"""Rotation matrices from and to angles, vectors and quaternions, by scipy, which has no types."""

from __future__ import annotations

import math
import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.messages import FloatArray


def rotation_angle_deg(rotation: FloatArray) -> float:
    """How far a (3, 3) rotation turns, degrees in [0, 180]."""
    return math.degrees(float(Rotation.from_matrix(rotation).magnitude()))


def rotation_from_euler(roll: float | FloatArray, pitch: float | FloatArray, yaw: float | FloatArray) -> FloatArray:
    """(3, 3) ``R_ned_body`` of an attitude in radians, aerospace order: yaw about down, then pitch, then roll.

    (n, 3, 3) of angles (n,).
    """
    return np.asarray(Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=-1)).as_matrix())


def euler_from_rotation(rotation: FloatArray) -> tuple[float, float, float]:
    """Roll, pitch, yaw in radians of a (3, 3) ``R_ned_body``; pitch in [-pi/2, pi/2].

    With the nose straight up or down roll and yaw turn about one axis: roll is then given as 0.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # scipy's of the nose straight up or down
        yaw, pitch, roll = Rotation.from_matrix(rotation).as_euler("ZYX")
    return float(roll), float(pitch), float(yaw)


def rotation_from_vector(vector: FloatArray) -> FloatArray:
    """(3, 3) rotation about the direction of ``vector`` (3,) by its length in radians; (n, 3, 3) of (n, 3)."""
    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def vector_from_rotation(rotation: FloatArray) -> FloatArray:
    """The inverse: (3,) of a (3, 3) rotation, (n, 3) of (n, 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def rotation_from_quaternion(quaternion: FloatArray) -> FloatArray:
    """(3, 3) of a quaternion (4,) x y z w of any length. Raises ValueError for one of no length."""
    return np.asarray(Rotation.from_quat(quaternion).as_matrix())


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """(4,) x y z w with w >= 0 of a (3, 3) rotation."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True))
