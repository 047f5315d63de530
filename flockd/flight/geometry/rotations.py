"""Rotation matrices: their angle, their Euler angles, and the exponential map."""

from __future__ import annotations

import math

import numpy as np

from flockd.core.messages import FloatArray


def rotation_angle_deg(rotation: FloatArray) -> float:
    """How far a (3, 3) rotation turns, degrees in [0, 180]."""
    # atan2 of sine and cosine: the arc cosine of the trace alone loses angles under 1e-6 degrees.
    doubled_sine = math.hypot(
        rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    )
    return math.degrees(math.atan2(doubled_sine, float(np.trace(rotation)) - 1.0))


def rotation_from_euler(roll: float, pitch: float, yaw: float) -> FloatArray:
    """(3, 3) ``R_ned_body`` of an attitude in radians, aerospace order: yaw about down, then pitch, then roll."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def euler_from_rotation(rotation: FloatArray) -> tuple[float, float, float]:
    """Roll, pitch, yaw in radians of a (3, 3) ``R_ned_body``; pitch in [-pi/2, pi/2].

    With the nose straight up or down roll and yaw turn about one axis: roll is then given as 0.
    """
    cos_pitch = math.hypot(rotation[0, 0], rotation[1, 0])
    pitch = math.atan2(-rotation[2, 0], cos_pitch)
    if cos_pitch < 1e-9:
        return 0.0, pitch, math.atan2(-rotation[0, 1], rotation[1, 1])
    return (
        math.atan2(rotation[2, 1], rotation[2, 2]),
        pitch,
        math.atan2(rotation[1, 0], rotation[0, 0]),
    )


def rotation_from_vector(vector: FloatArray) -> FloatArray:
    """(3, 3) rotation about the direction of ``vector`` (3,) by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = (float(component) for component in vector)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, one_minus_cosine = (1.0, 0.5) if angle < 1e-8 else (math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2)
    rotation: FloatArray = np.eye(3) + sine * cross + one_minus_cosine * (cross @ cross)
    return rotation
