"""How far a camera turned between two images of whatever lay before it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np

from flockd.core.messages import BoolArray, Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry import Camera
from flockd.flight.geometry.robust.kernels import Cauchy
from flockd.flight.geometry.robust.reweighting import robust_rotation
from flockd.flight.geometry.robust.solver import GaussNewton, NormalEquations, Problem
from flockd.flight.geometry.rotations import rotation_from_vector

_MAX_POINTS = 400
_QUALITY = 0.01
"""Least quality of a point, as a share of the best one's (Shi & Tomasi 1994)."""
_MIN_DISTANCE = 1 / 60
"""Least distance of two points, in widths of the image."""
_WINDOW_PX, _PYRAMID_LEVELS = 21, 4
_FORWARD_BACKWARD_PX = 0.5
"""A point is kept that, followed back, ends nearer than this to where it began (Kalal et al. 2010)."""
_MIN_POINTS = 40
_MAX_INTERVAL_S = 1.5
"""Images farther apart are not compared."""
_ROTATION_ROUNDS = 6
_PURE_ROTATION_PX = 0.35
"""Where a turn alone leaves no more than this, by the median, the camera's own shift does not show."""
_FIVE_POINT_MIN_COSINE = 0.3
"""From the optical axis, of the points that five-point solutions are made from."""
_FIVE_POINT_TOLERANCE = 0.003
"""Radians."""
_OPTIMIZER = GaussNewton(max_steps=12, tolerance=1e-8)
"""Tolerance in radians."""
_MAX_RESIDUAL_PX = 2.0
"""A turn that leaves more than this, by the median, is none."""


@dataclass(frozen=True, eq=False)
class Turn:
    """The camera at the second image, in its own axes at the first."""

    rotation: FloatArray
    """(3, 3) ``x_first = rotation @ x_second``"""
    residual_px: float
    """Median of what is left over."""
    points: int


@dataclass(frozen=True, eq=False)
class CameraTurn:
    """How a camera turned from one of its images to the next."""

    start_s: float
    end_s: float
    rotation: FloatArray
    """(3, 3) ``x_start = rotation @ x_end``, in the camera's axes."""


class Follower:
    """Takes one camera's images one after the other, and keeps how it turned meanwhile."""

    def __init__(self, camera: Camera, R_body_camera: FloatArray) -> None:
        """``R_body_camera`` (3, 3): about how it is mounted, as a first guess after a large turn."""
        self._camera, self._R_body_camera = camera, R_body_camera
        self._before: tuple[float, UInt8Array, FloatArray] | None = None
        self.turns: list[CameraTurn] = []
        self.lost: Counter[str] = Counter()
        """How often there was no turn, by reason."""

    def add(self, time_s: float, grey: UInt8Array, R_ned_body: FloatArray) -> None:
        """The next (h, w) image, and about the attitude (3, 3) it was taken in."""
        before, self._before = self._before, (time_s, grey, R_ned_body)
        if before is None or not 0.0 < time_s - before[0] < _MAX_INTERVAL_S:
            return
        expected = self._R_body_camera.T @ before[2].T @ R_ned_body @ self._R_body_camera
        found = turn_between(self._camera, before[1], grey, (np.eye(3), expected))
        if isinstance(found, str):
            self.lost[found] += 1
        else:
            self.turns.append(CameraTurn(before[0], time_s, found.rotation))


def turn_between(camera: Camera, first: UInt8Array, second: UInt8Array, guesses: Sequence[FloatArray]) -> Turn | str:
    """The turn from one (h, w) grey image to the next, or the reason why there is none.

    ``guesses`` (3, 3) are rough turns to start from; the best is taken.
    """
    corners = cv2.goodFeaturesToTrack(first, _MAX_POINTS, _QUALITY, _MIN_DISTANCE * camera.size[0])
    if corners is None or len(corners) < _MIN_POINTS:
        return "too few details in the image"
    start = np.asarray(corners, np.float32).reshape(-1, 2)
    best: tuple[Float32Array, BoolArray] | None = None
    for guess in guesses:
        found = _followed(camera, first, second, start, guess)
        if best is None or found[1].sum() > best[1].sum():
            best = found
    if best is None or best[1].sum() < _MIN_POINTS:
        return "the image could not be followed"
    end, kept = best
    # OpenCV has pixel centres at whole numbers.
    before, after = (camera.rays(points[kept].astype(np.float64) + 0.5) for points in (start, end))
    imaged = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    return _turn(before[imaged], after[imaged], camera.focal_px)


def _followed(
    camera: Camera, first: UInt8Array, second: UInt8Array, start: Float32Array, guess: FloatArray
) -> tuple[Float32Array, BoolArray]:
    expected = camera.project(camera.rays(start.astype(np.float64) + 0.5) @ guess) - 0.5
    lost = ~(np.isfinite(expected).all(axis=1) & camera.in_image(expected))
    expected[lost] = start[lost]
    follow = partial(
        cv2.calcOpticalFlowPyrLK,
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_PYRAMID_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    end, there, _ = follow(first, second, start, expected.astype(np.float32))
    back, again, _ = follow(second, first, end, start.copy())
    kept = (there.ravel() == 1) & (again.ravel() == 1) & ~lost
    kept &= np.linalg.norm(np.asarray(back) - start, axis=1) < _FORWARD_BACKWARD_PX
    return np.asarray(end, np.float32), np.asarray(kept, np.bool_)


def _turn(before: FloatArray, after: FloatArray, focal_px: float) -> Turn | str:
    rotation, left, _ = robust_rotation(after, before, _cauchy, rounds=_ROTATION_ROUNDS)
    if np.median(left) * focal_px > _PURE_ROTATION_PX:
        starts = [rotation, *_essential_turn(before, after, rotation)]
        rotation, left = min(
            (_turn_beside_a_shift(before, after, start) for start in starts),
            key=lambda found: float(np.median(found[1])),
        )
    residual_px = float(np.median(left)) * focal_px
    if not residual_px < _MAX_RESIDUAL_PX:
        return "what is seen does not move as one"
    return Turn(rotation, residual_px, len(before))


def _essential_turn(before: FloatArray, after: FloatArray, near: FloatArray) -> list[FloatArray]:
    """Where to begin when the shift is large: from five points at a time; of its two rotations the one like ``near``.

    None where too little is seen within a pinhole's reach.
    """
    ahead = np.minimum(before[:, 2], after[:, 2]) > _FIVE_POINT_MIN_COSINE
    if ahead.sum() < _MIN_POINTS:
        return []
    first, second = (rays[ahead, :2] / rays[ahead, 2:] for rays in (after, before))
    essential = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.999, _FIVE_POINT_TOLERANCE)[0]
    if essential is None or essential.shape != (3, 3):
        return []
    rotations = [np.asarray(one, np.float64) for one in cv2.decomposeEssentialMat(essential)[:2]]
    return [max(rotations, key=lambda rotation: float(np.trace(near.T @ rotation)))]


@dataclass(frozen=True, eq=False)
class _Epipolar:
    """Directions seen from two places, one turned by ``rotation``: all planes of a pair share the camera's shift.

    The shift drops out: it is the least eigenvector of the planes' normals (Kneip and Lynen 2013).
    """

    before: FloatArray
    """(n, 3)"""
    after: FloatArray
    """(n, 3)"""
    rotation: FloatArray
    weights: FloatArray
    """(n,) that the shift is found with."""

    @cached_property
    def turned(self) -> FloatArray:
        """(n, 3) ``after`` in the first camera's axes."""
        return self.after @ self.rotation.T

    @cached_property
    def normals(self) -> FloatArray:
        """(n, 3) of the planes of both directions."""
        return np.cross(self.before, self.turned)

    @cached_property
    def shift(self) -> FloatArray:
        """(3,) unit vector along which the camera moved."""
        least: FloatArray = np.linalg.eigh((self.normals * self.weights[:, None]).T @ self.normals)[1][:, 0]
        return least

    @cached_property
    def sines(self) -> FloatArray:
        """(n,) of the angle between direction and shift; where they are near no plane is well known."""
        sines: FloatArray = np.maximum(np.linalg.norm(np.cross(self.before, self.shift), axis=1), 0.05)
        return sines

    @cached_property
    def residuals(self) -> FloatArray:
        """(n,) how far each point lies off its epipolar plane, as an angle."""
        off: FloatArray = self.normals @ self.shift / self.sines
        return off


class _TurnBesideAShift(Problem[_Epipolar]):
    """Five parameters: the rotation vector, and the shift's two, which follow the turn and are found anew each time."""

    def linearise(self, state: _Epipolar) -> NormalEquations:
        # d (before x R after) . shift / d turn, with R' = exp(turn) R: before x (turn x turned) . shift
        by_turn = np.cross(state.turned, np.cross(state.shift, state.before))
        along, across = _tangents(state.shift)
        by_shift = np.stack([state.normals @ along, state.normals @ across], axis=1)
        jacobian = np.concatenate([by_turn, by_shift], axis=1) / state.sines[:, None]
        weights = _cauchy(state.residuals).weight(state.residuals**2)
        equations = NormalEquations.of(state.residuals, jacobian, weights)
        return equations.damped(np.full(5, 1e-9 * np.trace(equations.hessian)))

    def move(self, state: _Epipolar, step: FloatArray) -> _Epipolar:
        weights = _cauchy(state.residuals).weight(state.residuals**2)
        return replace(state, rotation=rotation_from_vector(step[:3]) @ state.rotation, weights=weights)

    def step_size(self, step: FloatArray) -> float:
        """Radians."""
        return float(np.linalg.norm(step[:3]))


def _turn_beside_a_shift(before: FloatArray, after: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rotation for which both directions and one shift lie in a plane, at whatever distance each point is."""
    state = _Epipolar(before, after, start, np.ones(len(before)))
    found = _OPTIMIZER.minimise(_TurnBesideAShift(), state).state
    return found.rotation, np.abs(found.residuals)


def _tangents(unit: FloatArray) -> tuple[FloatArray, FloatArray]:
    helper = np.eye(3)[int(np.argmin(np.abs(unit)))]
    along = np.cross(unit, helper)
    along /= np.linalg.norm(along)
    return along, np.cross(unit, along)


def _cauchy(left: FloatArray) -> Cauchy:
    """For residuals (n,): two median deviations are 1.35 standard deviations, stricter than Gaussian errors ask for."""
    return Cauchy(max(2.0 * float(np.median(np.abs(left))), math.radians(0.005)))
