"""Converts between flockd's axes and those of ROS (REP 103 and REP 105). No other file does. Pure.

flockd's world is north, east, down (NED), its body forward, right, down (FRD); those of ROS are east, north, up (ENU)
and forward, left, up (FLU).
Yaw counts from east counter-clockwise in ROS, and from north clockwise in flockd. ``R_a_b`` takes
coordinates from b to a.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.messages import FloatArray, IntArray

MAP = "map"
"""REP 105's frame of the world of all drones, which does not drift; its origin is the home of one drone."""
_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_FLU_FRD = np.diag([1.0, -1.0, -1.0])


def enu_of_ned(ned: FloatArray) -> FloatArray:
    """(..., 3) in ENU of (..., 3) in NED."""
    enu: FloatArray = np.asarray(ned, np.float64) @ _ENU_NED.T
    return enu


ned_of_enu = enu_of_ned
"""It is its own inverse."""


def flu_of_frd(frd: FloatArray) -> FloatArray:
    """(..., 3) in FLU of (..., 3) in FRD."""
    flu: FloatArray = np.asarray(frd, np.float64) @ _FLU_FRD.T
    return flu


frd_of_flu = flu_of_frd


def attitude_in_ros(R_ned_frd: FloatArray) -> FloatArray:
    """R_enu_flu (3, 3) of an attitude."""
    return _ENU_NED @ R_ned_frd @ _FLU_FRD


def attitude_of_ros(R_enu_flu: FloatArray) -> FloatArray:
    """R_ned_frd (3, 3) of an attitude in ROS."""
    return _ENU_NED @ R_enu_flu @ _FLU_FRD


def attitude_of_angles(roll_deg: float, pitch_deg: float, yaw_deg: float) -> FloatArray:
    """R_ned_frd (3, 3) of flockd's angles: yaw, then pitch, then roll."""
    R: FloatArray = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix()
    return R


def quaternion_of(R: FloatArray) -> FloatArray:
    """(4,) x, y, z, w of a rotation, in the order of ROS, with w not below 0."""
    quaternion: FloatArray = Rotation.from_matrix(R).as_quat(canonical=True)
    return quaternion


def rotation_of(quaternion: FloatArray) -> FloatArray:
    """(3, 3) of x, y, z, w. Raises ValueError if the length is not 1 within a hundredth, as in an empty message."""
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) < 0.01:  # true for NaN too
        raise ValueError(f"its orientation is no rotation: a quaternion of length {length:.3g}; fill it in")
    R: FloatArray = Rotation.from_quat(quaternion).as_matrix()
    return R


def scan_order(count: int) -> IntArray:
    """For each ray of a scan in ENU, the sector of `ObstacleRanges`, whose azimuths are clockwise from north.

    The scan's first ray points at -180 degrees, which is west, its next ones counter-clockwise from there.
    """
    if count % 4:
        raise ValueError(f"a scan of {count} sectors has none to the west; their number has to be a multiple of four")
    return (3 * count // 4 - np.arange(count)) % count
