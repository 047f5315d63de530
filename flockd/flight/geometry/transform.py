"""A rigid transform, as a value."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flockd.core.messages import FloatArray

EYE = np.eye(3)
_TOLERANCE = 1e-6 + 1e-5 * EYE
"""Largest deviation of a rotation times its transpose from the identity."""


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """``p_a = rotation @ p_b + translation``: named ``T_a_b``, it takes coordinates from frame b to frame a.

    Raises ValueError if ``rotation`` (3, 3) is not a rotation or ``translation`` (3,) is not finite.
    """

    rotation: FloatArray
    translation: FloatArray

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, dtype=np.float64)
        translation = np.asarray(self.translation, dtype=np.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(f"a rigid transform is (3, 3) and (3,), not {rotation.shape} and {translation.shape}")
        if not np.isfinite(translation).all():
            raise ValueError("a rigid transform's translation must be finite")
        is_orthonormal = (np.abs(rotation @ rotation.T - EYE) <= _TOLERANCE).all()  # NaN is not
        (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
        if not is_orthonormal or a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0.0:
            raise ValueError("the matrix is not a rotation: its columns must be orthonormal and right-handed")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    def apply(self, points: FloatArray) -> FloatArray:
        """Points (..., 3) of frame b in frame a."""
        moved: FloatArray = np.asarray(points) @ self.rotation.T + self.translation
        return moved

    def inverse(self) -> RigidTransform:
        """``T_b_a``."""
        return self._inverse

    @cached_property
    def _inverse(self) -> RigidTransform:
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        """``T_a_b @ T_b_c`` is ``T_a_c``."""
        return RigidTransform(self.rotation @ other.rotation, self.apply(other.translation))
