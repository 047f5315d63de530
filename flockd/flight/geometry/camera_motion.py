"""How each camera moved by what it alone saw, with how well that is known: what calibration of a rig in flight uses.

A match fixes the direction of its point before and after. How far it is, the depth map says, and is not believed
much: what a wrong depth moves a point by is taken out of the residual's weight, as in `ego_motion_refinement`. So near
points count by their epipolar lines, and far ones fix the rotation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry.cameras import Camera
from flockd.flight.geometry.pairs import PointPairs
from flockd.flight.geometry.rig import RigCamera
from flockd.flight.geometry.robust.kernels import Cauchy, Kernel, Tukey
from flockd.flight.geometry.rotations import rotation_from_vector
from flockd.flight.geometry.transform import RigidTransform

MIN_MATCHES = 40
_MAX_MATCHES = 600
_ROUNDS, _FINE_ROUNDS = 7, 4
_NEAR, _THERE = 1.0, 1e-4
"""Squares of standard deviations that a step is long: below the first the fine rounds begin, below the second they
end."""
_DEPTH_SIGMA = 3.0
"""Relative error of a depth, and of all depths of an image together."""
_FLOW_PX = 0.2
"""Least standard deviation of a match, pixels."""
_MATCHES_A_FLOW = 4.0
"""So many matches err together: a dense flow is smooth."""
_CAUCHY_SIGMAS, _TUKEY_SIGMAS = 2.385, 4.685
"""A start far off needs the first; the second, as a false match tells of a focal length what the others do not."""
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
    sigma_px: float
    """Standard deviation of a match off the motion."""
    matches: int
    sights: Sights
    projection: FloatArray
    """(6, 2 n) from the residuals to the motion that they ask for."""

    def by_focal(self, motion: RigidTransform) -> FloatArray:
        """(6,) by how much a motion would seem to change with the logarithm of the focal length.

        How large turns appear depends on it. To be asked of the motion as all that is known has it: with that of this
        camera alone, its noise would count as turns. What an image alone says of the focal length is not used, as it
        hangs on depths.
        """
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
    """The motion that best explains the pairs of one camera; None where they are too few, or fix none.

    Args:
        mounted: as the pairs were lifted.
        pairs: what stands still.
        start: about the motion, in the camera's axes.
        log_focal: logarithm of the focal length over that of ``mounted``, that the directions are taken with.
    """
    mine = np.flatnonzero(pairs.camera_names == mounted.name)
    if len(mine) < MIN_MATCHES:
        return None
    if len(mine) > _MAX_MATCHES:
        mine = mine[np.linspace(0, len(mine) - 1, _MAX_MATCHES).astype(np.int64)]
    pairs = pairs.select(mine)
    range_m = np.linalg.norm(pairs.previous - mounted.T_body_camera.translation, axis=1)
    sights = Sights.of(mounted.camera, pairs, range_m, log_focal)
    _, jacobian = sights.linearised(start)
    numbers = np.concatenate([jacobian.reshape(len(mine), -1), sights.after], axis=1)
    seen = np.asarray(np.isfinite(numbers).all(axis=1))
    if np.count_nonzero(seen) < MIN_MATCHES:
        return None
    return _solved(sights.select(seen), start)


@dataclass(frozen=True, eq=False)
class Sights:
    """Directions of n points before and after, in a camera's axes."""

    before: FloatArray
    """(n, 3) points, metres."""
    after: FloatArray
    """(n, 3) unit vectors."""
    across: FloatArray
    """(n, 2, 3) two directions at right angles to ``after``, each divided by what a pixel spans there: pixels."""
    camera: Camera
    other: Camera
    """The same with a focal length that is a little longer."""
    before_other: FloatArray
    """(n, 3) ``before`` by that one."""

    @classmethod
    def of(cls, camera: Camera, pairs: PointPairs, range_m: FloatArray, log_focal: float) -> Sights:
        """Of one camera's pairs, at ranges (n,), as seen with its focal length scaled."""
        used, other = (scaled_focal(camera, log_focal + step) for step in (0.0, _FOCAL_STEP))
        after = used.rays(pairs.pixels_current)
        one = np.cross(after, np.eye(3)[np.argmin(np.nan_to_num(np.abs(after)), axis=1)])
        one /= np.linalg.norm(one, axis=1, keepdims=True)
        across = np.stack([one, np.cross(after, one)], axis=1) / used.pixel_angle(after)[:, None, None]
        before, before_other = (one.rays(pairs.pixels_previous) * range_m[:, None] for one in (used, other))
        return cls(before, after, across, used, other, before_other)

    def select(self, which: BoolArray) -> Sights:
        """Those that a mask (n,) names."""
        return replace(
            self,
            before=self.before[which],
            after=self.after[which],
            across=self.across[which],
            before_other=self.before_other[which],
        )

    def linearised(self, motion: RigidTransform) -> tuple[FloatArray, FloatArray]:
        """(n, 2) pixels: where the motion moves each point to, off where it was seen; and how that changes.

        (n, 2, 7) by a rotation vector on the right, the translation, and the logarithm of all depths.
        """
        moved = _moved(self.before, motion)
        length = np.sqrt(np.einsum("ni,ni->n", moved, moved))
        unit = moved / length[:, None]
        along: FloatArray = np.einsum("nij,nj->ni", self.across, unit)
        by_point = (self.across - along[:, :, None] * unit[:, None, :]) / length[:, None, None]
        by_start = by_point @ motion.rotation.T
        jacobian = np.empty((len(moved), 2, 7))
        # exp(w)^T y is y - w x y, and a . (y x w) is w . (a x y)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            jacobian[:, :, i] = by_point[:, :, j] * moved[:, None, k] - by_point[:, :, k] * moved[:, None, j]
        jacobian[:, :, _TRANSLATION] = -by_start
        jacobian[:, :, _DEPTH] = np.einsum("nij,nj->ni", by_start, self.before)
        return along, jacobian

    def by_focal(self, motion: RigidTransform) -> FloatArray:
        """(n, 2) pixels by the logarithm of the focal length, of where the motion moves each point to."""
        # At the pixel that the point is expected at: a wrong match says nothing of a focal length.
        there = self.other.rays(self.camera.project(_moved(self.before, motion)))
        stepped = _unit(_moved(self.before_other, motion)) - there
        changes: FloatArray = np.einsum("nij,nj->ni", self.across, stepped) / _FOCAL_STEP
        return np.nan_to_num(changes)

    def by_readout(self, motion: RigidTransform, rates: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Two of (n, 2) pixels a second of readout over the width, and over the height, of the same."""
        moved = _moved(self.before, motion)
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        first = np.cross(rates[0], self.before) @ motion.rotation / length
        second = np.cross(rates[1], self.after)
        places = [self.camera.project(points) / self.camera.size - 0.5 for points in (self.before, self.after)]
        changes = (first * places[0][:, axis, None] - second * places[1][:, axis, None] for axis in (0, 1))
        across, along = (np.nan_to_num(np.einsum("nij,nj->ni", self.across, change)) for change in changes)
        return across, along


def _moved(points: FloatArray, motion: RigidTransform) -> FloatArray:
    """(n, 3) in the camera's axes at the second image."""
    moved: FloatArray = (points - motion.translation) @ motion.rotation
    return moved


def _unit(vectors: FloatArray) -> FloatArray:
    unit: FloatArray = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


def _solved(sights: Sights, start: RigidTransform) -> CameraMotion | None:
    motion, fine = start, False
    for number in range(_ROUNDS):
        residuals, jacobian = sights.linearised(motion)
        if not np.isfinite(jacobian).all():
            return None
        whitening = _whitening(jacobian[:, :, _DEPTH])
        white = np.einsum("nij,nj->ni", whitening, residuals)
        size2 = (white**2).sum(axis=1)
        # For a Rayleigh distribution the median is sqrt(2 ln 2) sigma.
        sigma = max(float(np.median(np.sqrt(size2))) / np.sqrt(2.0 * np.log(2.0)), 1.0)
        fine = fine or number >= _ROUNDS - _FINE_ROUNDS
        kernel: Kernel = Tukey(_TUKEY_SIGMAS * sigma) if fine else Cauchy(_CAUCHY_SIGMAS * sigma)
        weights = kernel.weight(size2) / (sigma**2 * _MATCHES_A_FLOW)
        J = (whitening @ jacobian).reshape(-1, 7)
        weighted = J * np.repeat(weights, 2)[:, None]
        hessian = weighted.T @ J
        hessian[_DEPTH, _DEPTH] += 1.0 / _DEPTH_SIGMA**2
        # Without the depths, whatever they are together (their Schur complement).
        J = J - np.outer(J[:, _DEPTH], hessian[_DEPTH] / hessian[_DEPTH, _DEPTH])
        information = hessian - np.outer(hessian[:, _DEPTH], hessian[_DEPTH]) / hessian[_DEPTH, _DEPTH]
        information, slope = information[:6, :6], (J.T @ (white.ravel() * np.repeat(weights, 2)))[:6]
        if not np.isfinite(information).all() or np.linalg.cond(information) > _MAX_CONDITION:
            return None
        step = np.linalg.solve(information, -slope)
        length2 = float(-slope @ step)
        if number == _ROUNDS - 1 or (fine and length2 < _THERE):
            break
        fine = length2 < _NEAR or fine
        motion = RigidTransform(motion.rotation @ rotation_from_vector(step[:3]), motion.translation + step[3:])
    whitened = (J[:, :6] * np.repeat(weights, 2)[:, None]).reshape(-1, 2, 6)
    projection = -np.linalg.solve(information, np.einsum("nij,nik->njk", whitening, whitened).reshape(-1, 6).T)
    return CameraMotion(motion, information, sigma * _FLOW_PX, len(white), sights, projection)


def _whitening(parallax: FloatArray) -> FloatArray:
    """(n, 2, 2) inverse square roots of ``flow^2 I + depth^2 p p'``, of parallaxes (n, 2) in pixels."""
    length = np.linalg.norm(parallax, axis=1)
    direction = parallax / np.maximum(length, 1e-12)[:, None]
    discount = 1.0 - _FLOW_PX / np.hypot(_FLOW_PX, _DEPTH_SIGMA * length)
    whitening: FloatArray = (
        np.eye(2) - discount[:, None, None] * direction[:, :, None] * direction[:, None, :]
    ) / _FLOW_PX
    return whitening
