"""Cameras are found again in the body, from a board that neighbours share."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.config.rig import MeasurementConfig
from flockd.flight.geometry import Camera, PinholeCamera, RigidTransform, WideAngleCamera, rotation_angle_deg
from flockd.ground.calibration.board import BoardFinder, CalibrationError
from flockd.ground.calibration.fragment import extrinsics_of
from flockd.ground.calibration.rig import SharedBoard, SharedCollector, calibrate_rig
from tests.ground.calibration.darkroom import SPEC, WIDE, Lens, Place, facing, photograph

FORWARD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""From right, down, forward to forward, right, down."""
NOTE = MeasurementConfig(date="2026-11-20", camera="1", source="here", views=1)


def camera_of(lens: Lens) -> Camera:
    matrix = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
    return (PinholeCamera if lens.model == "pinhole" else WideAngleCamera)(matrix, lens.size, lens.k)


def mounted(yaw: float, pitch: float, roll: float, position: tuple[float, float, float]) -> RigidTransform:
    turn = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
    return RigidTransform(turn @ FORWARD, np.array(position))


MOUNTS = {
    "front": mounted(2.0, -10.0, 1.0, (0.10, 0.01, 0.02)),
    "right": mounted(88.0, 3.0, -2.0, (-0.01, 0.11, 0.0)),
    "left": mounted(-92.5, -4.0, 3.0, (0.02, -0.12, -0.01)),
}


def in_camera(board: RigidTransform, mount: RigidTransform) -> Place:
    """A board of the body in a camera."""
    T = mount.inverse() @ board
    return Place(T.rotation, T.translation)


def boards_between(first: str, second: str, count: int, seed: int) -> list[RigidTransform]:
    """In the body, about half-way between where two cameras look, tilted to both sides."""
    rng = np.random.default_rng(seed)
    ahead = MOUNTS[first].rotation[:, 2] + MOUNTS[second].rotation[:, 2]
    found = []
    for _ in range(count):
        towards = ahead / np.linalg.norm(ahead) + rng.uniform(-0.12, 0.12, 3)
        towards *= rng.uniform(0.3, 0.45) / np.linalg.norm(towards)
        place = facing(tuple(FORWARD.T @ towards), rng.uniform(0.0, 35.0), rng.uniform(0.0, 360.0))
        found.append(RigidTransform(FORWARD @ place.R, FORWARD @ place.t))
    return found


@cache
def shared_boards() -> list[SharedBoard]:
    collector = SharedCollector(BoardFinder(SPEC))
    boards = boards_between("front", "right", 7, 1) + boards_between("front", "left", 7, 2)
    for number, board in enumerate(boards):
        names = ("front", "right") if number < 7 else ("front", "left")
        greys = {
            name: photograph(WIDE, in_camera(board, MOUNTS[name]), seed=10 * number + k)[..., 0]
            for k, name in enumerate(names)
        }
        collector.offer(f"{number}", greys, moving=False)
    assert set(collector.links()) == {("front", "right"), ("front", "left")}
    return collector.boards


def test_cameras_are_found_beside_each_other() -> None:
    cameras = {name: camera_of(WIDE) for name in MOUNTS}
    boards = shared_boards()
    fit = calibrate_rig(cameras, boards, "front", MOUNTS["front"])
    assert fit["front"].T_body_camera is MOUNTS["front"]
    for name in ("right", "left"):
        found, true = fit[name], MOUNTS[name]
        assert rotation_angle_deg(found.T_body_camera.rotation.T @ true.rotation) < min(0.3, 3 * found.sigma_deg)
        assert np.linalg.norm(found.T_body_camera.translation - true.translation) < min(0.002, 3 * found.sigma_m)
        assert found.sigma_deg < 0.3
        assert found.sigma_m < 0.003
    with pytest.raises(CalibrationError, match=r"^camera 'left' shares 0 boards with front, right, and needs 3; show"):
        calibrate_rig(cameras, [one for one in boards if "right" in one.seen], "front", MOUNTS["front"])


def test_a_board_that_moved_between_the_cameras_is_dropped() -> None:
    cameras = {name: camera_of(WIDE) for name in ("front", "right")}
    boards = [one for one in shared_boards() if "right" in one.seen]
    shaken = boards[2].seen["right"]
    moved = type(shaken)(shaken.ids, shaken.pixels + np.array([6.0, 0.0]), shaken.points)
    boards[2] = SharedBoard("shaken", {**boards[2].seen, "right": moved})
    fit = calibrate_rig(cameras, boards, "front", MOUNTS["front"])
    assert [name for name, _ in fit["right"].dropped] == ["shaken"]
    error = fit["right"].T_body_camera.rotation.T @ MOUNTS["right"].rotation
    assert rotation_angle_deg(error) < 0.2


def test_a_mounting_is_written_as_it_is_read() -> None:
    written = extrinsics_of(MOUNTS["left"], NOTE)
    assert (written.yaw_deg, written.pitch_deg, written.roll_deg) == pytest.approx((-92.5, -4.0, 3.0), abs=1e-4)
    assert written.position_m == (0.02, -0.12, -0.01)
