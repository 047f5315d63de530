"""Where cameras sit beside each other, from a board that two or more of them see at the same time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from flockd.flight.geometry import Camera, RigidTransform, rotation_angle_deg
from flockd.ground.calibration.board import BoardDetection, CalibrationError
from flockd.ground.calibration.poses import MAX_DROPPED, first_pose, inliers, residuals_px, root_mean_square

MIN_SHARED = 3
"""Boards that two neighbours have to see together."""
_MARGIN_PX = 0.5
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
    sigma_deg: float = 0.0
    """Standard deviation of its turn about the worst axis, by how much the boards differ; 0 of the reference."""
    sigma_m: float = 0.0
    """Standard deviation of its place along the worst axis, likewise."""
    rms_px: float = 0.0
    """Of the board's corners, where the neighbour's view of it says that they are."""
    boards: int = 0
    """Those that it shares with that neighbour."""
    dropped: tuple[tuple[str, float], ...] = ()
    """Names of boards that did not fit the others, with their residuals in pixels."""


def calibrate_rig(
    cameras: Mapping[str, Camera], boards: Sequence[SharedBoard], reference: str, T_body_reference: RigidTransform
) -> dict[str, Mounting]:
    """Places every camera in the body, by way of the neighbour with which it shares most boards.

    Raises CalibrationError where a camera shares too few boards with those that are linked to the reference, or where
    the boards contradict each other.
    """
    poses = [
        {name: pose for name, seen in board.seen.items() if (pose := first_pose(cameras[name], seen)[1]) is not None}
        for board in boards
    ]
    mountings = {reference: Mounting(T_body_reference)}
    while len(mountings) < len(cameras):
        count, known, new = max(
            (sum(known in found and new in found for found in poses), known, new)
            for known in mountings
            for new in cameras.keys() - mountings.keys()
        )
        if count < MIN_SHARED:
            others = ", ".join(mountings)
            raise CalibrationError(
                f"camera {new!r} shares {count} boards with {others}, and needs {MIN_SHARED}; show the board where "
                "both see it, and hold it still"
            )
        shared = [
            (board, found[known], found[new])
            for board, found in zip(boards, poses, strict=True)
            if known in found and new in found
        ]
        mountings[new] = _beside(mountings[known].T_body_camera, new, cameras[new], shared)
    return mountings


def _beside(
    T_body_known: RigidTransform,
    name: str,
    camera: Camera,
    shared: Sequence[tuple[SharedBoard, RigidTransform, RigidTransform]],
) -> Mounting:
    """``shared``: each board with its pose in the known camera and in the new one."""

    def residual_px(T_known_new: RigidTransform, board: SharedBoard, T_known_board: RigidTransform) -> float:
        return root_mean_square(residuals_px(camera, board.seen[name], T_known_new.inverse() @ T_known_board))

    steps = [T_known_board @ T_new_board.inverse() for _, T_known_board, T_new_board in shared]
    middle = min(steps, key=lambda one: sum(_distance(one, other) for other in steps))  # no outlier moves it
    rms_px = np.array([residual_px(middle, board, T_known_board) for board, T_known_board, _ in shared])
    fits = inliers(rms_px, _MARGIN_PX)
    dropped = tuple((shared[k][0].name, float(rms_px[k])) for k in np.flatnonzero(~fits).tolist())
    kept = np.flatnonzero(fits).tolist()
    if len(dropped) > MAX_DROPPED * len(shared) or len(kept) < MIN_SHARED:
        raise CalibrationError(
            f"{len(dropped)} of {len(shared)} boards contradict the others; hold the board still, let every camera "
            "take its image at the same time, and check the cameras' intrinsics"
        )
    turns = Rotation.from_matrix([steps[k].rotation for k in kept])
    places = np.array([steps[k].translation for k in kept])
    mean = RigidTransform(turns.mean().as_matrix(), places.mean(axis=0))
    apart_deg = np.degrees((turns.mean().inv() * turns).as_rotvec())
    spread = np.sqrt(len(kept) * (len(kept) - 1))  # of a mean
    sigma_deg = float(np.linalg.norm(apart_deg, axis=0).max() / spread)
    sigma_m = float(np.linalg.norm(places - places.mean(axis=0), axis=0).max() / spread)
    if not (sigma_deg < _SIGMA_DEG and sigma_m < _SIGMA_M):
        raise CalibrationError(
            f"the boards leave the place of camera {name!r} uncertain by {sigma_deg:.2g} degrees and "
            f"{100 * sigma_m:.2g} cm; show the board nearer, tilted, and in more places that both see"
        )
    left_px = [residual_px(mean, shared[k][0], shared[k][1]) for k in kept]
    return Mounting(
        T_body_known @ mean, sigma_deg, sigma_m, float(np.sqrt(np.mean(np.square(left_px)))), len(kept), dropped
    )


def _distance(a: RigidTransform, b: RigidTransform) -> float:
    turn = rotation_angle_deg(a.rotation.T @ b.rotation)
    return turn * _METRES_A_DEGREE + float(np.linalg.norm(a.translation - b.translation))
