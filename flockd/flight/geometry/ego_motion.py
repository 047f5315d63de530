"""The drone's own motion, from the background in all its cameras (Eq. 7-21, Algorithm 1).

It is refined by its reprojection error: metric scale from the depths, accuracy from the flow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flockd.core.config.geometry import GeometryParameters
from flockd.core.messages import BoolArray, EgoMotion, FloatArray
from flockd.flight.geometry.pairs import PointPairs
from flockd.flight.geometry.rig import Rig, RigCamera
from flockd.flight.geometry.robust.kernels import cauchy, median
from flockd.flight.geometry.robust.ransac import ransac_rigid
from flockd.flight.geometry.rotations import crossed, rotation_from_vector
from flockd.flight.geometry.sightlines import products, times, whitening
from flockd.flight.geometry.transform import RigidTransform

_EXPLAINED_PX = 3.0
"""A motion explains a match if it moves it to within this distance."""
_MIN_EXPLAINED = 0.08
"""Least share of all matches that a motion explains. On real images true motions explain at least 15 %. Motions found
in false matches only, some of which always agree within metres, explain less than 6 %."""
_MIN_KEPT = 0.9
"""Least share of the explained matches that the refinement keeps; if it loses more, it has followed false matches."""
_MAX_PAIRS = 800
"""Number of pairs used, drawn at random; each has two residuals."""
_FLOW_SIGMA_PX = 0.3
_DEPTH_SIGMA = 0.05
"""Relative error of depth. Only its ratio to the flow's error matters: residuals show the common scale."""
_CAUCHY_SIGMAS = 1.2
"""Scale of Cauchy's kernel in standard deviations, half of the 2.385 for Gaussian errors: the depth of a whole object
is wrong together. It halved the error at depth errors of 15 %, and costs 5 % if all errors are Gaussian."""
_UNSEEN_PX = 1e3
"""Residual, px, of a point that a motion moves out of the lens's image."""
_MOST_STEPS, _SETTLED = 20, 1e-4
"""Largest number of Gauss-Newton steps, and size of a step, in radians and metres, at which they end."""
_OBSERVABLE = 1e-12
"""Least singular value of the normal equations, relative to the largest; in other directions the motion stays."""


def estimate_ego_motion(pairs: PointPairs, rig: Rig, interval_s: float, parameters: GeometryParameters) -> EgoMotion:
    """``P_C = R_FC P_F + T_FC`` (Eq. 7) from the background pairs of all cameras together.

    By Algorithm 1. With ``parameters.refine`` its reprojection error is then minimised; if that loses matches, the
    result of Algorithm 1 is kept. ``inliers`` and ``threshold_m`` are Algorithm 1's. Raises ValueError with the
    reason if there is no estimate, or if it explains too few of its matches.
    """
    found = ransac_rigid(
        pairs.current,
        pairs.previous,
        threshold=parameters.initial_threshold_m,
        min_inlier_ratio=parameters.min_inlier_ratio,
        hypotheses=parameters.hypotheses,
        max_threshold=parameters.max_threshold_m,
    )
    motion = found.transform
    by_camera = [(camera, pairs[pairs.camera_names == name]) for name, camera in rig.cameras.items()]
    explained = _explained(by_camera, motion) / len(pairs)
    if parameters.refine:
        refined = refine_ego_motion(pairs, rig, motion, found.inliers)
        still = _explained(by_camera, refined) / len(pairs)
        if still >= _MIN_KEPT * explained:
            motion, explained = refined, still
    if explained < _MIN_EXPLAINED:
        raise ValueError(
            f"the best motion explains only {explained:.1%} of {len(pairs)} matches within {_EXPLAINED_PX:g} px"
        )
    return EgoMotion(
        rotation=motion.rotation,
        translation=motion.translation,
        interval_s=interval_s,
        pairs=len(pairs),
        inliers=int(found.inliers.sum()),
        threshold_m=found.threshold,
    )


def _explained(by_camera: list[tuple[RigCamera, PointPairs]], motion: RigidTransform) -> int:
    """Number of matches, by the camera that saw them, that the motion explains."""
    near = 0
    for camera, pairs in by_camera:
        u, v = (moved_pixels(camera, pairs.previous, motion) - pairs.pixels_current).T
        near += int(np.count_nonzero(u * u + v * v < _EXPLAINED_PX**2))  # NaN behind a camera compares false
    return near


def moved_pixels(camera: RigCamera, points: FloatArray, motion: RigidTransform) -> FloatArray:
    """(n, 2) where a camera of a body that moved, as in Eq. 7, sees points (n, 3) of C; NaN if not visible."""
    mount = camera.T_body_camera
    return camera.camera.project((motion.inverse().apply(points) - mount.translation) @ mount.rotation)


def refine_ego_motion(pairs: PointPairs, rig: Rig, initial: RigidTransform, agreeing: BoolArray) -> RigidTransform:
    """The motion near ``initial`` (F to C) that best reprojects the pairs.

    Both ways over all cameras: the point lifted at t must fall on its pixel at t+1, and the point lifted at t+1 on its
    pixel at t. Gauss-Newton on the six parameters with Cauchy weights. Along the point's parallax, a residual is
    whitened by the depth's error too, across it by the flow's error only. So distant points fix the rotation, near ones
    with good depth the translation's length, and all of them its direction. The scale of residuals is estimated from
    the pairs in ``agreeing`` (n,), which agree with ``initial`` in space: more than half of all pairs may be false.
    """
    if len(pairs) > _MAX_PAIRS:
        drawn = np.sort(np.random.default_rng(0).choice(len(pairs), _MAX_PAIRS, replace=False))
        pairs, agreeing = pairs[drawn], agreeing[drawn]
    typical = np.concatenate([agreeing, agreeing])  # both ways
    if not typical.any():
        return initial
    sights, rotation, translation = _Sights.of(pairs, rig), initial.rotation, initial.translation
    for _ in range(_MOST_STEPS):
        step = _step(_Reprojection(sights, rotation, translation), typical)
        turn = rotation_from_vector(step[:3])
        rotation, translation = turn @ rotation, turn @ translation + step[3:]
        if np.abs(step).max() < _SETTLED:
            break
    return RigidTransform(rotation, translation)


@dataclass(frozen=True, eq=False)
class _Sights:
    """n pairs, and m = 2 n sights: the points lifted at t+1, seen at t, then the points lifted at t, seen at t+1."""

    current: FloatArray
    """(3, n) body axes at t+1."""
    previous: FloatArray
    """(3, n) body axes at t."""
    centres: FloatArray
    """(3, m) of their cameras."""
    seen: FloatArray
    """(3, m) unit vectors towards the pixels, body axes."""
    across: FloatArray
    """(3, 2, m) directions in the body: derivatives of the pixels by the point, at a distance of 1 m."""

    @classmethod
    def of(cls, pairs: PointPairs, rig: Rig) -> _Sights:
        n = len(pairs)
        centres, seen, across = np.empty((3, 2, n)), np.empty((3, 2, n)), np.empty((3, 2, 2, n))
        for name, camera in rig.cameras.items():
            mine = (pairs.camera_names == name).nonzero()[0]
            R = camera.T_body_camera.rotation
            rays = camera.camera.rays(np.concatenate([pairs.pixels_previous[mine], pairs.pixels_current[mine]]))
            centres[:, :, mine] = camera.T_body_camera.translation[:, None, None]
            seen[:, :, mine] = (R @ rays.T).reshape(3, 2, -1)
            by_point = camera.camera.jacobian(rays).transpose(2, 1, 0).reshape(3, -1)
            across[:, :, :, mine] = (R @ by_point).reshape(3, 2, 2, -1)
        current, previous = (np.ascontiguousarray(points.T) for points in (pairs.current, pairs.previous))
        return cls(current, previous, centres.reshape(3, -1), seen.reshape(3, -1), across.reshape(3, 2, -1))


@dataclass(frozen=True, eq=False)
class _Reprojection:
    """All pairs, reprojected both ways by one motion.

    First order in the distance of a point from its pixel: at a few pixels, higher orders are far below a pixel.
    """

    sights: _Sights
    rotation: FloatArray
    translation: FloatArray

    @cached_property
    def moved(self) -> FloatArray:
        """(3, m) the points in body axes at the time of the sight."""
        R, t = self.rotation, self.translation[:, None]
        return np.concatenate([R @ self.sights.current + t, R.T @ (self.sights.previous - t)], axis=1)

    @cached_property
    def from_camera(self) -> FloatArray:
        """(3, m) the same, from the camera that sees them."""
        return self.moved - self.sights.centres

    @cached_property
    def depths(self) -> FloatArray:
        """(m,) metres along the sights; NaN for points behind the camera."""
        depths = (self.sights.seen * self.from_camera).sum(0)
        return np.where(depths > 0.0, depths, np.nan)

    @cached_property
    def residuals(self) -> FloatArray:
        """(2, m) pixels"""
        residuals: FloatArray = products(self.sights.across, self.from_camera) / self.depths
        return np.where(np.isnan(residuals), _UNSEEN_PX, residuals)

    @property
    def parallaxes(self) -> FloatArray:
        """(2, m) derivatives by the logarithm of each point's depth in the camera that lifted it."""
        R, t = self.rotation, self.translation[:, None]
        centres = self.sights.centres[:, : self.sights.current.shape[1]]
        between = np.concatenate([R @ centres + t, R.T @ (centres - t)], axis=1) - self.sights.centres
        along = (self.sights.seen * between).sum(0)
        changes = (self.residuals * along - products(self.sights.across, between)) / self.depths
        return np.where(np.isnan(changes), 0.0, changes)

    def jacobian(self, white_by: FloatArray) -> FloatArray:
        """(6, 2, m) of the residuals by a left increment (rotation, translation) of the motion, whitened by matrices
        (2, 2, m)."""
        sights, n = self.sights, self.sights.current.shape[1]
        by_point = times(white_by, sights.across)
        by_point -= times(white_by, self.residuals) * sights.seen[:, None]
        by_point /= self.depths
        by_point[..., np.isnan(self.depths)] = 0.0
        # An increment (w, v) moves X = T P_F by w x X + v, and Y = T^-1 P_C by -R'(w x P_C + v).
        by_point[..., n:] = -(self.rotation @ by_point[..., n:].reshape(3, -1)).reshape(3, 2, n)
        turned = np.concatenate([self.moved[:, :n], sights.previous], axis=1)
        return np.concatenate([-crossed(by_point, turned[:, None]), by_point])


def _step(state: _Reprojection, typical: BoolArray) -> FloatArray:
    """(6,) rotation vector and translation of the left increment of the motion that solves the normal equations.

    Residuals are whitened by their covariances ``flow^2 I + depth^2 p p'``, p the parallax. The scale of Cauchy's
    kernel follows from the median size of the ``typical`` (m,) ones.
    """
    white_by = whitening(state.parallaxes, _FLOW_SIGMA_PX, _DEPTH_SIGMA)
    white = times(white_by, state.residuals)
    squared = (white**2).sum(axis=0)
    # Fewer than half outliers do not move the median, which is sqrt(2 ln 2) sigma of a Rayleigh distribution.
    sigma = max(math.sqrt(median(squared[typical]) / (2.0 * math.log(2.0))), 1e-3)
    weights = cauchy(squared, _CAUCHY_SIGMAS * sigma)
    jacobian = state.jacobian(white_by).reshape(6, -1).T
    weighted = jacobian * np.concatenate([weights, weights])[:, None]
    found = np.linalg.lstsq(weighted.T @ jacobian, -(weighted.T @ white.ravel()), rcond=_OBSERVABLE)
    return np.asarray(found[0], np.float64)
