"""The motion of each camera by its own images, with covariance, for the calibration of a rig in flight.

A match gives the directions of its point in both images; the depth map gives its range, with a large error. As in
`geometry.ego_motion`, the part of a residual that a wrong depth explains has less weight. So near points contribute
by their epipolar lines, and far ones fix the rotation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry.cameras import Camera
from flockd.flight.geometry.pairs import PointPairs
from flockd.flight.geometry.rig import RigCamera
from flockd.flight.geometry.robust.kernels import cauchy, median, tukey
from flockd.flight.geometry.rotations import cross_matrix, crossed, rotation_from_vector
from flockd.flight.geometry.sightlines import products, times, whitening
from flockd.flight.geometry.transform import RigidTransform

MIN_MATCHES = 40
_MAX_MATCHES = 300
"""Largest number of matches. More are thinned out evenly, because neighbouring errors are correlated; 600 were no
better for the four rigs of a simulated flight."""
_ROUNDS, _FINE_ROUNDS = 7, 4
_NEAR, _THERE = 1.0, 1e-2
"""Squared length of a step in standard deviations below which the fine iterations begin, and end."""
_DEPTH_SIGMA = 3.0
"""Relative error of a depth, and of all depths of an image together."""
_FLOW_PX = 0.2
"""Least standard deviation of a match, pixels."""
_MATCHES_A_FLOW = 4.0
"""Number of matches with a common error: a dense flow is smooth."""
_CAUCHY_SIGMAS, _TUKEY_SIGMAS = 2.385, 4.685
"""Kernels for a distant start, and for the fine iterations, because false matches bias a focal length."""
_FOCAL_STEP = 1e-3
_MAX_CONDITION = 1e12
_ROTATION, _TRANSLATION, _DEPTH = slice(0, 3), slice(3, 6), 6


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """A camera's motion between two images, in its own axes: ``x_first = R x_second + t``, with its information."""

    motion: RigidTransform
    """(R, t) for the focal length that was assumed."""
    information: FloatArray
    """(6, 6) inverse covariance of a rotation vector that R is multiplied by from the right, and of t in metres."""
    sights: Sights
    projection: FloatArray
    """(6, 2 n) from the residuals to the motion that they ask for."""

    def by_focal(self, motion: RigidTransform) -> FloatArray:
        """(6,) by how much a motion would seem to change with the logarithm of the focal length, because that
        determines how large turns appear. Take it at the best estimate of the motion: at this camera's own, its noise
        would count as turns. What an image alone tells of the focal length is not used, because it depends on
        depths."""
        change: FloatArray = self.projection @ self.sights.by_focal(motion).ravel()
        return change

    def by_readout(self, motion: RigidTransform, rates: tuple[FloatArray, FloatArray]) -> FloatArray:
        """(6, 2) likewise with the seconds that pass over the image's width, and over its height, as rows are read.

        ``rates`` are those of turn, (3,) rad/s in the camera's axes, at the first image and at the second.
        """
        changes = self.sights.by_readout(motion, rates)
        return np.stack([self.projection @ change.ravel() for change in changes], axis=1)


def scaled_focal(camera: Camera, log_scale: float) -> Camera:
    """The camera with its focal lengths multiplied by ``exp(log_scale)``."""
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= np.exp(log_scale)
    return replace(camera, matrix=matrix)


def camera_motion(
    mounted: RigCamera, pairs: PointPairs, start: RigidTransform, log_focal: float
) -> CameraMotion | None:
    """The motion that best explains the pairs of one camera; None: they are too few, or do not determine it.

    Args:
        mounted: as the pairs were lifted.
        pairs: what stands still.
        start: about the motion, in the camera's axes.
        log_focal: logarithm of the focal length over that of ``mounted``, that the directions are taken with.
    """
    mine = np.flatnonzero(pairs.camera_names == mounted.name)
    if len(mine) < MIN_MATCHES:
        return None
    together = max(_MATCHES_A_FLOW * min(_MAX_MATCHES / len(mine), 1.0), 1.0)
    if len(mine) > _MAX_MATCHES:
        mine = mine[np.linspace(0, len(mine) - 1, _MAX_MATCHES).astype(np.int64)]
    pixels = pairs.pixels_previous[mine], pairs.pixels_current[mine]
    range_m = np.linalg.norm(pairs.previous[mine] - mounted.T_body_camera.translation, axis=1)
    sights = Sights.of(mounted.camera, pixels, range_m, log_focal)
    if sights.before.shape[1] < MIN_MATCHES:
        return None
    return _solved(sights, start, together)


@dataclass(frozen=True, eq=False)
class Sights:
    """Directions of n points before and after, in a camera's axes. Each coordinate is a row: numpy is faster so."""

    before: FloatArray
    """(3, n) points, metres."""
    after: FloatArray
    """(3, n) unit vectors."""
    across: FloatArray
    """(3, 2, n) two directions at right angles to ``after``, each divided by what a pixel spans there: pixels."""
    camera: Camera
    other: Camera
    """The same with a focal length that is a little longer."""
    before_other: FloatArray
    """(3, n) ``before`` by that one."""
    places: tuple[FloatArray, FloatArray]
    """(2, n) where in the images ``before`` and ``after`` are, from -0.5 to 0.5 over the width, and over the height."""

    @classmethod
    def of(cls, camera: Camera, pixels: tuple[FloatArray, FloatArray], range_m: FloatArray, log_focal: float) -> Sights:
        """Of one camera's pixels (m, 2) before and after, at ranges (m,), as seen with its focal length scaled.

        Pixels outside that camera's image are left out.
        """
        used, other = (scaled_focal(camera, log_focal + step) for step in (0.0, _FOCAL_STEP))
        before, before_other = (one.rays(pixels[0]) * range_m[:, None] for one in (used, other))
        after = used.rays(pixels[1])
        seen = np.flatnonzero(np.isfinite(before[:, 0] + after[:, 0]))
        before, before_other, after = (np.ascontiguousarray(of[seen].T) for of in (before, before_other, after))
        across = _tangents(after) / used.pixel_angle(after.T)
        first, second = (np.ascontiguousarray((of[seen] / camera.size - 0.5).T) for of in pixels)
        return cls(before, after, across, used, other, before_other, (first, second))

    def linearised(self, motion: RigidTransform) -> _Linearisation:
        """The residuals: where the motion moves each point to, less where it was seen; and their derivatives."""
        moved = _moved(self.before, motion)
        length = _length(moved)
        unit = moved / length
        along = products(self.across, unit)
        # A longer depth moves a point along itself, which is not seen, and by the translation.
        way = motion.rotation.T @ motion.translation
        parallax = (products(self.across, way[:, None]) - along * (way @ unit)) / length
        white_by = whitening(parallax, _FLOW_PX, _DEPTH_SIGMA)
        across, white = times(white_by, self.across), times(white_by, along)
        jacobian = np.empty((7, *along.shape))
        # exp(w)^T y is y - w x y, and a . (y x w) is w . (a x y)
        jacobian[_ROTATION] = crossed(across, unit[:, None])
        np.multiply(white, unit[:, None], out=jacobian[_TRANSLATION])
        jacobian[_TRANSLATION] -= across
        jacobian[_TRANSLATION] /= length
        jacobian[_DEPTH] = (-way @ jacobian[_TRANSLATION].reshape(3, -1)).reshape(along.shape)
        return _Linearisation(white, jacobian, white_by)

    def by_focal(self, motion: RigidTransform) -> FloatArray:
        """(2, n) pixels by the logarithm of the focal length, of where the motion moves each point to."""
        # At the pixel that the point is expected at: a wrong match says nothing of a focal length.
        there = self.other.rays(self.camera.project(_moved(self.before, motion).T)).T
        stepped = _moved(self.before_other, motion)
        stepped /= _length(stepped)
        stepped -= there
        changes = products(self.across, stepped) / _FOCAL_STEP
        return np.where(np.isfinite(changes), changes, 0.0)

    def by_readout(self, motion: RigidTransform, rates: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Two of (2, n) pixels a second of readout over the width, and over the height, of the same."""
        turning = (motion.rotation.T @ cross_matrix(rates[0])) @ self.before / _length(_moved(self.before, motion))
        first, second = products(self.across, turning), products(self.across, cross_matrix(rates[1]) @ self.after)
        return (
            first * self.places[0][0] - second * self.places[1][0],
            first * self.places[0][1] - second * self.places[1][1],
        )


def _moved(points: FloatArray, motion: RigidTransform) -> FloatArray:
    """(3, n) in the camera's axes at the second image."""
    moved: FloatArray = motion.rotation.T @ (points - motion.translation[:, None])
    return moved


def _length(vectors: FloatArray) -> FloatArray:
    """(n,) of (3, n)."""
    x, y, z = vectors
    length: FloatArray = np.sqrt(x * x + y * y + z * z)
    return length


def _tangents(unit: FloatArray) -> FloatArray:
    """(3, 2, n) two directions at right angles to each unit vector (3, n), and to each other.

    Duff et al., "Building an orthonormal basis, revisited", JCGT 2017.
    """
    x, y, z = unit
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.stack(
        [np.stack([1.0 + sign * x * x * a, b]), np.stack([sign * b, sign + y * y * a]), np.stack([-sign * x, -y])]
    )


@dataclass(frozen=True, eq=False)
class _Linearisation:
    residuals: FloatArray
    """(2, n) whitened"""
    jacobian: FloatArray
    """(7, 2, n) likewise, by a rotation vector on the right, the translation in the axes of the second image, and the
    logarithm of all depths"""
    whitening: FloatArray
    """(2, 2, n) what both are multiplied by, from pixels"""


def _solved(sights: Sights, start: RigidTransform, together: float) -> CameraMotion | None:
    """The motion by Gauss-Newton steps; each ``together`` matches have their errors in common."""
    motion, fine = start, False
    for number in range(_ROUNDS):
        there = sights.linearised(motion)
        J, white = there.jacobian.reshape(7, -1), there.residuals
        size2 = white[0] ** 2 + white[1] ** 2
        if not np.isfinite(size2).all():
            return None
        # For a Rayleigh distribution the median is sqrt(2 ln 2) sigma.
        sigma = max(math.sqrt(median(size2) / (2.0 * math.log(2.0))), 1.0)
        fine = fine or number >= _ROUNDS - _FINE_ROUNDS
        kernel, scale = (tukey, _TUKEY_SIGMAS) if fine else (cauchy, _CAUCHY_SIGMAS)
        weights = kernel(size2, scale * sigma) / (sigma**2 * together)
        weighted = (there.jacobian * weights).reshape(7, -1)
        hessian = weighted @ J.T
        slope = weighted @ white.ravel()
        hessian[_DEPTH, _DEPTH] += 1.0 / _DEPTH_SIGMA**2
        # With the depths eliminated together (their Schur complement).
        by_depth = hessian[:6, _DEPTH] / hessian[_DEPTH, _DEPTH]
        information = hessian[:6, :6] - by_depth[:, None] * hessian[_DEPTH, :6]
        slope = slope[:6] - by_depth * slope[_DEPTH]
        if not np.isfinite(information).all():
            return None
        least, *_, most = np.linalg.eigvalsh(information).tolist()
        if not least * _MAX_CONDITION > most:
            return None
        step = np.linalg.solve(information, -slope)
        length2 = float(-slope @ step)
        R = motion.rotation
        motion = RigidTransform(R @ rotation_from_vector(step[:3]), motion.translation + R @ step[3:])
        if fine and length2 < _THERE:
            break
        fine = length2 < _NEAR or fine
    weighted = weighted[:6] - by_depth[:, None] * weighted[_DEPTH]
    asked = times(there.whitening.transpose(1, 0, 2), weighted.reshape(6, 2, -1)).reshape(6, -1)
    turned = np.eye(6)
    turned[_TRANSLATION, _TRANSLATION] = R
    return CameraMotion(
        motion=motion,
        information=turned @ information @ turned.T,
        sights=sights,
        projection=-turned @ np.linalg.inv(information) @ asked,
    )
