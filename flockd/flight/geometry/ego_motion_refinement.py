"""The ego-motion refined by its reprojection error: metric scale from the depths, accuracy from the flow."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry.pairs import PointPairs
from flockd.flight.geometry.rig import Rig, RigCamera
from flockd.flight.geometry.robust.kernels import Cauchy
from flockd.flight.geometry.robust.solver import GaussNewton, NormalEquations, Problem
from flockd.flight.geometry.rotations import rotation_from_vector
from flockd.flight.geometry.transform import RigidTransform

_MAX_PAIRS = 800
"""Drawn of more: each costs two residuals a step."""
_FLOW_SIGMA_PX = 0.3
_DEPTH_SIGMA = 0.05
"""Relative error of depth. Only its ratio to the flow's error matters: their common size is found from the
residuals."""
_CAUCHY_SIGMAS = 1.2
"""Cauchy's scale in standard deviations. Half of the 2.385 that Gaussian errors ask for: the depth of a whole
object is wrong together, and the stricter scale halved the error where that is 15 %, for 5 % where all errors are
Gaussian."""
_UNSEEN_PX = 1e3
"""Residual of a point that a motion moves out of the lens's reach."""
_ROUGH_SOLVER = GaussNewton(max_steps=3, tolerance=0.0, max_condition=1e12)
"""While the motion is still rough, so are the size of the residuals and the direction of the parallax: they are
found anew at each step."""
_FINE_SOLVER = GaussNewton(max_steps=17, tolerance=1e-4, min_steps=2, max_condition=1e12)
"""Then they stay; until a step is under so many radians and metres."""


def refine_ego_motion(
    pairs: PointPairs,
    rig: Rig,
    initial: RigidTransform,
    *,
    agreeing: BoolArray | None = None,
    seed: int = 0,
) -> RigidTransform | None:
    """The motion near ``initial`` (F to C) that best reprojects the pairs, or None where there is no better one.

    Both ways over all cameras: the point lifted at t must fall on its pixel at t+1 and the point lifted at t+1 on its
    pixel at t. Gauss-Newton on the six parameters with Cauchy weights. A residual along the point's parallax is
    discounted by what the depth's own error makes of it. Across it only the flow's error counts. So far points fix the
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
    # As `_Reprojection` puts them: camera by camera, there and back.
    typical = np.concatenate([np.tile(agreeing[which], 2) for which in mine.values()])
    if not typical.any():
        return None
    start = _Reprojection(views, initial)
    rough = _ROUGH_SOLVER.minimise(_Refinement(typical), start)
    if not rough.equations.solvable:
        return None
    weighting = _Weighting.learned(rough.state, typical)
    fine = _FINE_SOLVER.minimise(_Refinement(typical, weighting), rough.state)
    if not fine.converged:
        return None
    before, after = (weighting.loss(state) for state in (start, fine.state))
    return fine.state.motion if after < before else None


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


@dataclass(frozen=True, eq=False)
class _Linearisation:
    residuals: FloatArray
    """(m, 2) pixels"""
    jacobians: FloatArray
    """(m, 2, 6) by a left increment (rotation, translation) of the motion"""
    parallaxes: FloatArray
    """(m, 2) derivatives by the logarithm of each point's depth"""


@dataclass(frozen=True, eq=False)
class _Reprojection:
    """All pairs, reprojected both ways by one motion."""

    views: list[_View]
    motion: RigidTransform

    @cached_property
    def linearised(self) -> _Linearisation:
        parts = [part for view in self.views for part in self._both_ways(view)]
        residuals, jacobians, parallaxes = (np.concatenate(part) for part in zip(*parts, strict=True))
        unseen = ~np.isfinite(residuals[:, 0])
        residuals[unseen], jacobians[unseen], parallaxes[unseen] = _UNSEEN_PX, 0.0, 0.0
        return _Linearisation(residuals, jacobians, parallaxes)

    def _both_ways(self, view: _View) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        pairs, centre = view.pairs, view.camera.T_body_camera.translation
        back = self.motion.inverse()

        # From t+1 to t: X = T P_F, and an increment (w, v) moves X by w x X + v.
        moved = self.motion.apply(pairs.current)
        pixels, by_point = view.reproject(moved)
        jacobian = _by_increment(moved, by_point)
        parallax = _times(by_point @ self.motion.rotation, pairs.current - centre)
        backward = (pixels - pairs.pixels_previous, jacobian, parallax)

        # From t to t+1: Y = T^-1 P_C, and the increment moves Y by -R'(w x P_C + v).
        pixels, by_point = view.reproject(back.apply(pairs.previous))
        by_point = by_point @ back.rotation
        jacobian = -_by_increment(pairs.previous, by_point)
        parallax = _times(by_point, pairs.previous - centre)
        return [backward, (pixels - pairs.pixels_current, jacobian, parallax)]


@dataclass(frozen=True, eq=False)
class _Weighting:
    """What a residual counts."""

    whitening: FloatArray
    """(m, 2, 2) inverse square roots of the residuals' covariances ``flow^2 I + depth^2 p p'``, p the parallax"""
    kernel: Cauchy
    """of whitened residuals"""

    @classmethod
    def learned(cls, state: _Reprojection, typical: BoolArray) -> _Weighting:
        """From the parallax of all residuals, and the size of the ``typical`` (m,) ones."""
        parallaxes, flow_px = state.linearised.parallaxes, _FLOW_SIGMA_PX
        length = np.linalg.norm(parallaxes, axis=1)
        direction = parallaxes / np.maximum(length, 1e-12)[:, None]
        discount = 1.0 - flow_px / np.hypot(flow_px, _DEPTH_SIGMA * length)
        along = direction[:, :, None] * direction[:, None, :]
        whitening = (np.eye(2) - discount[:, None, None] * along) / flow_px
        size = np.linalg.norm(_times(whitening[typical], state.linearised.residuals[typical]), axis=1)
        # Outliers under a half do not move the median, which for a Rayleigh distribution is sqrt(2 ln 2) sigma.
        sigma = max(float(np.median(size)) / np.sqrt(2.0 * np.log(2.0)), 1e-3)
        return cls(whitening, Cauchy(_CAUCHY_SIGMAS * sigma))

    def whitened(self, state: _Reprojection) -> FloatArray:
        """(m, 2)"""
        return _times(self.whitening, state.linearised.residuals)

    def loss(self, state: _Reprojection) -> float:
        """The robust cost of a motion."""
        return float(self.kernel.loss((self.whitened(state) ** 2).sum(axis=1)).sum())


@dataclass(frozen=True, eq=False)
class _Refinement(Problem[_Reprojection]):
    """Six parameters: rotation vector and translation that the motion is multiplied by from the left."""

    typical: BoolArray
    weighting: _Weighting | None = None
    """None: learned anew at each state."""

    def linearise(self, state: _Reprojection) -> NormalEquations:
        weighting = self.weighting or _Weighting.learned(state, self.typical)
        white = weighting.whitened(state)
        weights = weighting.kernel.weight((white**2).sum(axis=1))
        J = weighting.whitening @ state.linearised.jacobians
        return NormalEquations.of(white.ravel(), J.reshape(-1, 6), np.repeat(weights, 2))

    def move(self, state: _Reprojection, step: FloatArray) -> _Reprojection:
        increment = RigidTransform(rotation_from_vector(step[:3]), step[3:])
        return _Reprojection(state.views, increment @ state.motion)


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    product: FloatArray = (matrices @ vectors[:, :, None])[:, :, 0]
    return product


def _by_increment(points: FloatArray, by_point: FloatArray) -> FloatArray:
    """(n, 2, 6) derivatives by (w, v), which move ``points`` (n, 3) by w x p + v, of those (n, 2, 3) by the points.

    `np.cross`, written out: it takes most of its time to arrange its axes.
    """
    by_both = np.empty((*by_point.shape[:2], 6))
    x, y, z = points.T[:, :, None]
    dx, dy, dz = (by_point[:, :, axis] for axis in range(3))
    np.subtract(y * dz, z * dy, out=by_both[:, :, 0])
    np.subtract(z * dx, x * dz, out=by_both[:, :, 1])
    np.subtract(x * dy, y * dx, out=by_both[:, :, 2])
    by_both[:, :, 3:] = by_point
    return by_both
