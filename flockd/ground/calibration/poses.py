"""Where a board stands before a camera that is known."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from flockd.core.messages import FloatArray
from flockd.flight.geometry import Camera, RigidTransform
from flockd.flight.geometry.robust.solver import LevenbergMarquardt, NormalEquations, Problem
from flockd.flight.geometry.rotations import rotation_from_vector
from flockd.ground.calibration.board import BoardDetection

_NEAREST_ANGLE = 0.15
"""Cosine of the largest angle from the board's middle at which a corner still helps to find a first pose."""


def pose_of_board(camera: Camera, seen: BoardDetection) -> RigidTransform | None:
    """``T_camera_board`` with the least squared error in pixels; None where the corners fit no pose at all."""
    best: tuple[float, RigidTransform] | None = None
    for start in first_poses(camera, seen):
        found = LevenbergMarquardt().minimise(_PoseProblem(camera, seen), start)
        if found.equations.solvable and (best is None or found.equations.cost < best[0]):
            best = found.equations.cost, found.state
    return None if best is None else best[1]


def first_poses(camera: Camera, seen: BoardDetection) -> list[RigidTransform]:
    """Both poses that a flat board may have by its outline (IPPE), likelier first; none where it fits none."""
    rays = camera.rays(seen.pixels)
    usable = np.isfinite(rays).all(axis=1)
    if not usable.any():
        return []
    # Through a pinhole whose axis points straight at the board: so a lens may see the board beside or behind itself.
    R_virtual_camera = _turn_to_axis(rays[usable].mean(axis=0))
    turned = rays @ R_virtual_camera.T
    usable &= turned[:, 2] > _NEAREST_ANGLE
    if usable.sum() < 4:
        return []
    flat = turned[usable, :2] / turned[usable, 2:]
    try:
        _, turns, places, _ = cv2.solvePnPGeneric(
            seen.points[usable], flat, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # corners in one line
        return []
    virtual = RigidTransform(R_virtual_camera.T, np.zeros(3))
    poses = []
    for turn, place in zip(turns, places, strict=True):
        if np.isfinite(turn).all() and np.isfinite(place).all():
            poses.append(virtual @ RigidTransform(rotation_from_vector(np.ravel(turn)), np.ravel(place)))
    return poses


def moved(pose: RigidTransform, step: FloatArray) -> RigidTransform:
    """A pose turned by ``step[:3]`` radians about its own origin and shifted by ``step[3:]`` metres."""
    return RigidTransform(rotation_from_vector(step[:3]) @ pose.rotation, pose.translation + step[3:])


def jacobian_of_move(pose: RigidTransform, points: FloatArray) -> FloatArray:
    """(n, 3, 6) how a step of `moved` moves the points (n, 3) that the pose is applied to."""
    x, y, z = (points @ pose.rotation.T).T
    derivative = np.zeros((len(points), 3, 6))
    derivative[:, 0, 1], derivative[:, 0, 2] = z, -y
    derivative[:, 1, 0], derivative[:, 1, 2] = -z, x
    derivative[:, 2, 0], derivative[:, 2, 1] = y, -x
    derivative[:, :, 3:] = np.eye(3)
    return derivative


@dataclass(frozen=True, eq=False)
class _PoseProblem(Problem[RigidTransform]):
    camera: Camera
    seen: BoardDetection

    def linearise(self, state: RigidTransform) -> NormalEquations:
        points = state.apply(self.seen.points)
        residuals = (self.camera.project(points) - self.seen.pixels).ravel()
        jacobian = (self.camera.jacobian(points) @ jacobian_of_move(state, self.seen.points)).reshape(-1, 6)
        return NormalEquations.of(residuals, jacobian)

    def move(self, state: RigidTransform, step: FloatArray) -> RigidTransform:
        return moved(state, step)


def _turn_to_axis(direction: FloatArray) -> FloatArray:
    """(3, 3) the shortest rotation that takes a direction to the optical axis."""
    unit = direction / max(float(np.linalg.norm(direction)), 1e-12)
    across = np.cross(unit, (0.0, 0.0, 1.0))
    sine = float(np.linalg.norm(across))
    if sine < 1e-9:
        return np.eye(3) if unit[2] > 0.0 else np.diag([1.0, -1.0, -1.0])
    return rotation_from_vector(across / sine * np.arctan2(sine, unit[2]))
