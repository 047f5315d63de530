"""Where cameras sit beside each other, from a board that two or more of them see at the same time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry import Camera, RigidTransform, rotation_angle_deg
from flockd.ground.calibration.board import BoardDetection, CalibrationError
from flockd.ground.calibration.least_squares import (
    OutlierRejection,
    Unknowns,
    first_pose,
    fitted,
    moved,
    residuals_px,
    root_mean_square,
    steps_from,
)

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
class _Placed:
    """Cameras and boards in the body."""

    boards: tuple[SharedBoard, ...]
    mounts: Mapping[str, RigidTransform]
    """``T_body_camera``"""
    places: tuple[RigidTransform, ...]
    """``T_body_board``"""

    def residuals(self, cameras: Mapping[str, Camera]) -> list[dict[str, FloatArray]]:
        """For each board and each camera that saw it (n, 2) pixels, seen less predicted."""
        return [
            {
                name: residuals_px(cameras[name], seen, self.mounts[name].inverse() @ place)
                for name, seen in board.seen.items()
            }
            for board, place in zip(self.boards, self.places, strict=True)
        ]


def calibrate_rig(
    cameras: Mapping[str, Camera], boards: Sequence[SharedBoard], reference: str, T_body_reference: RigidTransform
) -> RigFit:
    """Places every camera in the body from boards that it shares with its neighbours.

    Raises CalibrationError where a camera shares too few boards with those that are linked to the reference, or where
    the boards contradict each other.
    """
    placed = _begin(cameras, boards, reference, T_body_reference)
    given, dropped = len(placed.boards), list[tuple[str, float]]()
    for _ in range(_REJECTION.max_rounds):
        placed, sigma = _fitted(cameras, placed, reference)
        residuals = placed.residuals(cameras)
        rms = np.array([root_mean_square(np.concatenate(list(one.values()))) for one in residuals])
        fits = _REJECTION.inliers(rms)
        if fits.all():
            break
        dropped += [(placed.boards[index].name, float(rms[index])) for index in np.flatnonzero(~fits)]
        placed = replace(
            placed, boards=tuple(compress(placed.boards, fits)), places=tuple(compress(placed.places, fits))
        )
        if len(dropped) > _REJECTION.max_dropped * given:
            raise CalibrationError(
                f"{len(dropped)} of {given} boards contradict the others; hold the board still, let every camera take "
                "its image at the same time, and check the cameras' intrinsics"
            )
    mountings = {name: _mounting(name, placed.mounts[name], sigma.get(name), residuals) for name in cameras}
    rms_px = root_mean_square(np.concatenate([r for one in residuals for r in one.values()]))
    return RigFit(reference, mountings, rms_px, tuple(dropped))


def _begin(
    cameras: Mapping[str, Camera], boards: Sequence[SharedBoard], reference: str, T_body_reference: RigidTransform
) -> _Placed:
    """Each camera by way of the neighbour with which it shares most boards."""
    all_poses = [
        {name: pose for name, seen in board.seen.items() if (pose := first_pose(cameras[name], seen)[1]) is not None}
        for board in boards
    ]
    shared = [(board, found) for board, found in zip(boards, all_poses, strict=True) if len(found) > 1]
    poses = [found for _, found in shared]
    mounts = {reference: T_body_reference}
    while len(mounts) < len(cameras):
        links = [
            (sum(known in found and new in found for found in poses), known, new)
            for known in mounts
            for new in cameras
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
    kept = tuple(SharedBoard(board.name, {name: board.seen[name] for name in found}) for board, found in shared)
    places = []
    for board, found in zip(kept, poses, strict=True):
        best = max(found, key=lambda name: len(board.seen[name].ids))
        places.append(mounts[best] @ found[best])
    return _Placed(kept, mounts, tuple(places))


def _middle(transforms: Sequence[RigidTransform]) -> RigidTransform:
    """The one that is nearest to all the others: no outlier moves it."""

    def distance(a: RigidTransform, b: RigidTransform) -> float:
        turn = rotation_angle_deg(a.rotation.T @ b.rotation)
        return turn * _METRES_A_DEGREE + float(np.linalg.norm(a.translation - b.translation))

    return min(transforms, key=lambda one: sum(distance(one, other) for other in transforms))


def _fitted(cameras: Mapping[str, Camera], start: _Placed, reference: str) -> tuple[_Placed, Mapping[str, FloatArray]]:
    """With the least squares; and by camera but the reference the deviations (6,) of its turn and place."""
    free = [name for name in cameras if name != reference]
    mounts = [start.mounts[name] for name in free]
    seen = [(number, name, 2 * len(s.ids)) for number, one in enumerate(start.boards) for name, s in one.seen.items()]
    counts = [count for _, _, count in seen]
    of_mount = np.repeat([free.index(name) if name in free else -1 for _, name, _ in seen], counts)
    of_board = np.repeat([number for number, _, _ in seen], counts)

    def placed(numbers: Sequence[FloatArray]) -> _Placed:
        moved_mounts = dict(zip(free, moved(mounts, numbers[0]), strict=True))
        return replace(start, mounts={**start.mounts, **moved_mounts}, places=tuple(moved(start.places, numbers[1])))

    def residuals(numbers: Sequence[FloatArray]) -> FloatArray:
        return np.concatenate([r.ravel() for one in placed(numbers).residuals(cameras) for r in one.values()])

    unknowns = Unknowns(steps_from(mounts), of_mount), Unknowns(steps_from(start.places), of_board)
    found = fitted(residuals, unknowns)
    return placed(found.numbers), dict(zip(free, found.sigma[0], strict=True))


def _mounting(
    name: str, T_body_camera: RigidTransform, sigma: FloatArray | None, residuals: Sequence[Mapping[str, FloatArray]]
) -> Mounting:
    """``sigma``: of its turn and place; None of the reference."""
    sigma = np.zeros(6) if sigma is None else sigma
    own = [one[name] for one in residuals if name in one]
    sigma_deg, sigma_m = math.degrees(float(sigma[:3].max())), float(sigma[3:].max())
    if not (sigma_deg < _SIGMA_DEG and sigma_m < _SIGMA_M):
        raise CalibrationError(
            f"the boards leave the place of camera {name!r} uncertain by {sigma_deg:.2g} degrees and "
            f"{100 * sigma_m:.2g} cm; show the board nearer, tilted, and in more places that both see"
        )
    return Mounting(T_body_camera, sigma_deg, sigma_m, root_mean_square(np.concatenate(own)) if own else 0.0, len(own))
