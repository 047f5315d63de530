"""The ego-motion polished by its reprojection error: metric scale from the depths, accuracy from the flow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flockd.geometry.pairs import PointPairs
from flockd.geometry.rig import Rig, RigCamera
from flockd.geometry.rotations import rotation_from_vector
from flockd.geometry.transform import RigidTransform
from flockd.messages import BoolArray, FloatArray

_MAX_PAIRS = 2500
_FLOW_SIGMA_PX = 0.3
_DEPTH_SIGMA = 0.05
"""Relative error of depth. Only its ratio to the flow's error matters: the common size is found from the residuals."""
_CAUCHY = 1.2
"""Cauchy's scale in standard deviations. Half of the 2.385 that Gaussian errors ask for: the depth of a whole object
is wrong together, and the stricter scale halved the error where that is 15 %, for 5 % where all errors are Gaussian."""
_RAYLEIGH_MEDIAN = 1.1774
_MAX_STEPS = 20
_SCALED_STEPS = 4
_CONVERGED = 1e-4
"""A step under this many radians and metres."""
_UNSEEN_PX = 1e3
"""Residual of a point that a motion moves out of the lens's reach."""


def refine_ego_motion(
    pairs: PointPairs, rig: Rig, initial: RigidTransform, *, agreeing: BoolArray | None = None, seed: int = 0
) -> RigidTransform | None:
    """The motion near ``initial`` (F to C) that best reprojects the pairs, or None where there is no better one.

    Both ways over all cameras: the point lifted at t must fall on its pixel at t+1 and the point lifted at t+1 on its
    pixel at t. Gauss-Newton on the six parameters with Cauchy weights. A residual along the point's parallax is
    discounted by what the depth's own error makes of it, across it only the flow's error counts: far points fix the
    rotation, near ones with sound depth the translation's length, and all of them its direction. How large a residual
    may be is learned from the pairs that ``agreeing`` (n,) marks, those that agree with ``initial`` in space: of all
    pairs, more than half may be false matches.

    None means that the steps did not converge or the robust cost did not fall. Raises ValueError for pairs of a camera
    that is not in the rig.
    """
    strangers = set(pairs.camera_names.tolist()) - set(rig.cameras)
    if strangers:
        raise ValueError(f"pairs of camera {sorted(strangers)[0]!r}, which is not in the rig")
    agreeing = np.ones(len(pairs), np.bool_) if agreeing is None else agreeing
    if len(pairs) > _MAX_PAIRS:
        drawn = np.sort(np.random.default_rng(seed).choice(len(pairs), _MAX_PAIRS, replace=False))
        pairs, agreeing = pairs.select(drawn), agreeing[drawn]
    mine = {name: pairs.camera_names == name for name in rig.cameras}
    views = [_View(rig.cameras[name], pairs.select(which)) for name, which in mine.items() if which.any()]
    # As `_linearise` puts them: camera by camera, there and back.
    typical = np.concatenate([np.tile(agreeing[which], 2) for which in mine.values()])
    if not typical.any():
        return None
    motion = initial
    for iteration in range(_MAX_STEPS):
        residuals, jacobians, parallax = _linearise(views, motion)
        if iteration == 0:
            at_first = residuals
        if iteration < _SCALED_STEPS:
            # While the motion is still rough, so are the size of the residuals and the direction of the parallax.
            whitening = _whitening(parallax)
            scale = _CAUCHY * _sigma(_times(whitening[typical], residuals[typical]))
        white = _times(whitening, residuals)
        weights = 1.0 / (1.0 + (white**2).sum(axis=1) / scale**2)
        J = whitening @ jacobians
        weighted = (J * weights[:, None, None]).reshape(-1, 6)
        normal = weighted.T @ J.reshape(-1, 6)
        if not np.linalg.cond(normal) < 1e12:
            return None
        step = -np.linalg.solve(normal, weighted.T @ white.ravel())
        motion = RigidTransform(rotation_from_vector(step[:3]), step[3:]) @ motion
        if iteration >= _SCALED_STEPS and np.abs(step).max() < _CONVERGED:
            at_last, _, _ = _linearise(views, motion)
            before, after = (_cost(residuals, whitening, scale) for residuals in (at_first, at_last))
            return motion if after < before else None
    return None


@dataclass(frozen=True, eq=False)
class _View:
    """One camera and the pairs it saw."""

    camera: RigCamera
    pairs: PointPairs

    def reproject(self, points_body: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) of body points and their derivative (n, 2, 3) by the body coordinates."""
        mount = self.camera.T_body_camera
        points_camera = (points_body - mount.translation) @ mount.rotation
        derivative = self.camera.camera.jacobian(points_camera) @ mount.rotation.T
        return self.camera.camera.project(points_camera), derivative


def _linearise(views: list[_View], motion: RigidTransform) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (m, 2) in pixels, their derivatives (m, 2, 6) by a left increment (rotation, translation), and the
    derivatives (m, 2) by the logarithm of each point's depth: its parallax."""
    residuals, jacobians, parallaxes = [], [], []
    back = motion.inverse()
    for view in views:
        pairs, centre = view.pairs, view.camera.T_body_camera.translation

        # From t+1 to t: X = T P_F, and an increment (w, v) moves X by w x X + v.
        moved = motion.apply(pairs.current)
        pixels, by_point = view.reproject(moved)
        residuals.append(pixels - pairs.pixels_previous)
        jacobians.append(np.concatenate([np.cross(moved[:, None], by_point), by_point], axis=2))
        parallaxes.append(_times(by_point @ motion.rotation, pairs.current - centre))

        # From t to t+1: Y = T^-1 P_C, and the increment moves Y by -R'(w x P_C + v).
        pixels, by_point = view.reproject(back.apply(pairs.previous))
        residuals.append(pixels - pairs.pixels_current)
        by_point = by_point @ back.rotation
        jacobians.append(-np.concatenate([np.cross(pairs.previous[:, None], by_point), by_point], axis=2))
        parallaxes.append(_times(by_point, pairs.previous - centre))
    residual, jacobian, parallax = (np.concatenate(parts) for parts in (residuals, jacobians, parallaxes))
    unseen = ~np.isfinite(residual[:, 0])
    residual[unseen], jacobian[unseen], parallax[unseen] = _UNSEEN_PX, 0.0, 0.0
    return residual, jacobian, parallax


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    product: FloatArray = (matrices @ vectors[:, :, None])[:, :, 0]
    return product


def _whitening(parallax: FloatArray) -> FloatArray:
    """(m, 2, 2) inverse square roots of the residuals' covariances ``flow^2 I + depth^2 p p'``."""
    length = np.linalg.norm(parallax, axis=1)
    direction = parallax / np.maximum(length, 1e-12)[:, None]
    discount = 1.0 - _FLOW_SIGMA_PX / np.hypot(_FLOW_SIGMA_PX, _DEPTH_SIGMA * length)
    along = direction[:, :, None] * direction[:, None, :]
    whitening: FloatArray = (np.eye(2) - discount[:, None, None] * along) / _FLOW_SIGMA_PX
    return whitening


def _sigma(white: FloatArray) -> float:
    """Standard deviation of whitened residuals, each axis, from their median: outliers under a half do not matter."""
    return max(float(np.median(np.linalg.norm(white, axis=1))) / _RAYLEIGH_MEDIAN, 1e-3)


def _cost(residuals: FloatArray, whitening: FloatArray, scale: float) -> float:
    white = _times(whitening, residuals)
    return float(np.log1p((white**2).sum(axis=1) / scale**2).sum())
