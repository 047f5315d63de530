"""Where cameras sit beside each other, from a board that two or more of them see at the same time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry import Camera, RigidTransform, rotation_angle_deg
from flockd.flight.geometry.robust.solver import LevenbergMarquardt, NormalEquations, Problem, Solution
from flockd.ground.calibration.board import BoardDetection
from flockd.ground.calibration.errors import CalibrationError
from flockd.ground.calibration.poses import jacobian_of_move, moved, pose_of_board
from flockd.ground.calibration.rejection import OutlierRejection, root_mean_square

MIN_SHARED = 3
"""Boards that two neighbours have to see together."""
_REJECTION = OutlierRejection(margin_px=0.2)
_SIGMA_DEG, _SIGMA_M = 0.5, 0.02
"""A camera whose place the boards leave more uncertain than this is not known."""
_METRES_A_DEGREE = 0.01
"""How turns and shifts are weighed where only one number can be compared."""


@dataclass(frozen=True, eq=False)
class SharedBoard:
    """The board at one time, as seen by each camera that saw it."""

    name: str
    seen: Mapping[str, BoardDetection]


@dataclass(frozen=True, eq=False)
class Mounting:
    """Where one camera sits, and how sure that is."""

    T_body_camera: RigidTransform
    sigma_deg: float
    """Standard deviation of its turn about the worst of the body's axes: what noise alone leaves open."""
    sigma_m: float
    """Standard deviation of its place along the worst of the body's axes."""
    rms_px: float
    boards: int
    """Boards that it saw together with another camera."""


@dataclass(frozen=True, eq=False)
class RigFit:
    """The cameras in the body, with the reference camera where it was said to be."""

    reference: str
    mountings: Mapping[str, Mounting]
    rms_px: float
    dropped: tuple[tuple[str, float], ...]
    """Names of boards that did not fit the others, with their residuals in pixels."""


@dataclass(frozen=True, eq=False)
class _State:
    mounts: tuple[RigidTransform, ...]
    """``T_body_camera``, in the order of the cameras."""
    boards: tuple[RigidTransform, ...]
    """``T_body_board``"""


def calibrate_rig(
    cameras: Mapping[str, Camera], boards: Sequence[SharedBoard], reference: str, T_body_reference: RigidTransform
) -> RigFit:
    """Places every camera in the body from boards that it shares with its neighbours.

    Raises CalibrationError where a camera shares too few boards with those that are linked to the reference, or where
    the boards contradict each other.
    """
    names = tuple(cameras)
    poses = [_poses(cameras, board) for board in boards]
    shared = [index for index, found in enumerate(poses) if len(found) > 1]
    kept, poses = [boards[index] for index in shared], [poses[index] for index in shared]
    state = _begin(names, kept, poses, reference, T_body_reference)
    given, dropped = len(kept), list[tuple[str, float]]()
    fixed = names.index(reference)
    for _ in range(_REJECTION.max_rounds):
        problem = _RigProblem(tuple(cameras.values()), names, kept, fixed)
        solution = LevenbergMarquardt().minimise(problem, state)
        state = solution.state
        rms = np.array([root_mean_square(np.concatenate(list(one.values()))) for one in problem.residuals(state)])
        fits = _REJECTION.inliers(rms)
        if fits.all():
            break
        dropped += [(kept[index].name, float(rms[index])) for index in np.flatnonzero(~fits)]
        state = _State(state.mounts, tuple(compress(state.boards, fits)))
        kept = list(compress(kept, fits))
        if len(dropped) > _REJECTION.max_dropped * given:
            raise CalibrationError(
                f"{len(dropped)} of {given} boards contradict the others; hold the board still, let every camera take "
                "its image at the same time, and check the cameras' intrinsics"
            )
    return _result(names, problem, solution, reference, tuple(dropped))


def _poses(cameras: Mapping[str, Camera], board: SharedBoard) -> dict[str, RigidTransform]:
    found = {name: pose_of_board(cameras[name], seen) for name, seen in board.seen.items()}
    return {name: pose for name, pose in found.items() if pose is not None}


def _begin(
    names: Sequence[str],
    boards: Sequence[SharedBoard],
    poses: Sequence[Mapping[str, RigidTransform]],
    reference: str,
    T_body_reference: RigidTransform,
) -> _State:
    """Each camera by way of the neighbour with which it shares most boards."""
    mounts = {reference: T_body_reference}
    while len(mounts) < len(names):
        links = [
            (sum(known in found and new in found for found in poses), known, new)
            for known in mounts
            for new in names
            if new not in mounts
        ]
        count, known, new = max(links)
        if count < MIN_SHARED:
            others = ", ".join(mounts)
            raise CalibrationError(
                f"camera {new!r} shares {count} boards with {others}, and needs {MIN_SHARED}; show the board where "
                "both see it, and hold it still"
            )
        steps = [found[known] @ found[new].inverse() for found in poses if known in found and new in found]
        mounts[new] = mounts[known] @ _middle(steps)
    in_body = []
    for board, found in zip(boards, poses, strict=True):
        best = max(found, key=lambda name: len(board.seen[name].ids))
        in_body.append(mounts[best] @ found[best])
    return _State(tuple(mounts[name] for name in names), tuple(in_body))


def _middle(transforms: Sequence[RigidTransform]) -> RigidTransform:
    """The one that is nearest to all the others: no outlier moves it."""

    def distance(a: RigidTransform, b: RigidTransform) -> float:
        turn = rotation_angle_deg(a.rotation.T @ b.rotation)
        return turn * _METRES_A_DEGREE + float(np.linalg.norm(a.translation - b.translation))

    return min(transforms, key=lambda one: sum(distance(one, other) for other in transforms))


@dataclass(frozen=True, eq=False)
class _RigProblem(Problem[_State]):
    """Blocks of six: the cameras but the reference, then the boards."""

    cameras: tuple[Camera, ...]
    names: tuple[str, ...]
    boards: Sequence[SharedBoard]
    fixed: int

    def linearise(self, state: _State) -> NormalEquations:
        size = 6 * (len(state.mounts) + len(state.boards))
        gradient, hessian, cost = np.zeros(size), np.zeros((size, size)), 0.0
        for board, camera, residuals, jacobian in self._terms(state):
            block = NormalEquations.of(residuals, jacobian)
            if not block.solvable:
                return NormalEquations.unsolvable(size - 6)
            start = 6 * (len(state.mounts) + board)
            own = np.r_[6 * camera : 6 * camera + 6, start : start + 6]
            cost += block.cost
            gradient[own] += block.gradient
            hessian[np.ix_(own, own)] += block.hessian
        free = np.delete(np.arange(size), slice(6 * self.fixed, 6 * self.fixed + 6))
        return NormalEquations(cost, gradient[free], hessian[np.ix_(free, free)])

    def move(self, state: _State, step: FloatArray) -> _State:
        free = [one for index, one in enumerate((*state.mounts, *state.boards)) if index != self.fixed]
        transforms = [moved(one, own) for one, own in zip(free, step.reshape(-1, 6), strict=True)]
        transforms.insert(self.fixed, state.mounts[self.fixed])
        return _State(tuple(transforms[: len(state.mounts)]), tuple(transforms[len(state.mounts) :]))

    def residuals(self, state: _State) -> list[dict[str, FloatArray]]:
        """For each board and each camera that saw it (n, 2) pixels, seen less predicted."""
        found: list[dict[str, FloatArray]] = [{} for _ in self.boards]
        for board, camera, r, _ in self._terms(state):
            found[board][self.names[camera]] = -r.reshape(-1, 2)
        return found

    def _terms(self, state: _State) -> Iterator[tuple[int, int, FloatArray, FloatArray]]:
        """Board, camera, residuals (2 n,), and their derivatives (2 n, 12) by the camera's mounting and the board."""
        for index, (board, T_body_board) in enumerate(zip(self.boards, state.boards, strict=True)):
            for name, seen in board.seen.items():
                camera = self.names.index(name)
                mount = state.mounts[camera]
                in_body = T_body_board.apply(seen.points)
                in_camera = (in_body - mount.translation) @ mount.rotation
                residuals = self.cameras[camera].project(in_camera) - seen.pixels
                by_body = self.cameras[camera].jacobian(in_camera) @ mount.rotation.T
                # A camera that turns about its own place moves what it sees the other way.
                by_mount = -jacobian_of_move(RigidTransform.identity(), in_body - mount.translation)
                by_board = jacobian_of_move(T_body_board, seen.points)
                jacobian = by_body @ np.concatenate([by_mount, by_board], axis=2)
                yield index, camera, residuals.ravel(), jacobian.reshape(-1, 12)


def _result(
    names: Sequence[str],
    problem: _RigProblem,
    solution: Solution[_State],
    reference: str,
    dropped: tuple[tuple[str, float], ...],
) -> RigFit:
    residuals = problem.residuals(solution.state)
    numbers = sum(r.size for one in residuals for r in one.values())
    sigma = solution.sigma(numbers, len(solution.equations.gradient)).reshape(-1, 6)
    sigma = np.insert(sigma, problem.fixed, 0.0, axis=0)
    mountings = {}
    for index, name in enumerate(names):
        own = [one[name] for one in residuals if name in one]
        mounting = Mounting(
            T_body_camera=solution.state.mounts[index],
            sigma_deg=math.degrees(float(sigma[index, :3].max())),
            sigma_m=float(sigma[index, 3:].max()),
            rms_px=root_mean_square(np.concatenate(own)) if own else 0.0,
            boards=len(own),
        )
        if not (mounting.sigma_deg < _SIGMA_DEG and mounting.sigma_m < _SIGMA_M):
            raise CalibrationError(
                f"the boards leave the place of camera {name!r} uncertain by {mounting.sigma_deg:.2g} degrees and "
                f"{100 * mounting.sigma_m:.2g} cm; show the board nearer, tilted, and in more places that both see"
            )
        mountings[name] = mounting
    return RigFit(
        reference, mountings, root_mean_square(np.concatenate([r for one in residuals for r in one.values()])), dropped
    )
