"""Where the camera was: poses from matrices and quaternions, and between two of them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry import RigidTransform, rotation_from_quaternion
from flockd.ground.datasets.errors import DatasetError

_MAX_GAP_S = 0.1
"""Between poses farther apart in time nothing is known."""
_ROUNDING = 1e-2
"""How far from a rotation a matrix of rounded numbers may be."""


class PoseTrack:
    """Poses over time, and between their times."""

    def __init__(self, times_s: FloatArray, translations: FloatArray, quaternions: FloatArray) -> None:
        """Times (n,) that increase, translations (n, 3), quaternions (n, 4) as x y z w of any length but 0."""
        self._times_s = times_s
        self._translations = translations
        self._quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)

    def at(self, time_s: float) -> RigidTransform | None:
        """The pose at that time; None before, after and in the track's gaps."""
        after = int(np.searchsorted(self._times_s, time_s))
        if after < len(self._times_s) and self._times_s[after] == time_s:
            return RigidTransform(rotation_from_quaternion(self._quaternions[after]), self._translations[after])
        if after == 0 or after == len(self._times_s):
            return None
        begin_s, end_s = self._times_s[after - 1], self._times_s[after]
        if end_s - begin_s > _MAX_GAP_S:
            return None
        share = (time_s - begin_s) / (end_s - begin_s)
        first, second = self._quaternions[after - 1 : after + 1]
        # Both signs are one rotation. Over a tenth of a second the chord is as good as the arc.
        between = (1 - share) * first + share * math.copysign(1.0, first @ second) * second
        place = (1 - share) * self._translations[after - 1] + share * self._translations[after]
        return RigidTransform(rotation_from_quaternion(between / np.linalg.norm(between)), place)


def pose_of_matrix(values: FloatArray, where: str) -> RigidTransform:
    """From the 16 numbers of a 4x4 matrix, row by row. Raises DatasetError, which begins with ``where``."""
    matrix = values.reshape(4, 4)
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    rotation = u @ vt  # the nearest: the numbers were rounded when they were written
    if np.abs(rotation - matrix[:3, :3]).max() > _ROUNDING or np.linalg.det(rotation) < 0:
        raise DatasetError(f"{where}: its first three columns are no rotation; write a camera-to-world matrix")
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=_ROUNDING):
        raise DatasetError(f"{where}: its last row is not 0 0 0 1; write a camera-to-world matrix")
    return RigidTransform(rotation, matrix[:3, 3])


def track_of_rows(file: Path, times_s: FloatArray, translations: FloatArray, quaternions: FloatArray) -> PoseTrack:
    """A track from a file's columns. Raises DatasetError where times do not increase or a quaternion is 0."""
    if np.any(np.diff(times_s) <= 0):
        raise DatasetError(f"{file}: its times do not increase; sort it by time")
    if np.any(np.linalg.norm(quaternions, axis=1) < 1e-6):
        raise DatasetError(f"{file}: a quaternion is all zero; delete that line")
    return PoseTrack(times_s, translations, quaternions)
