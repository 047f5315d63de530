"""Cameras are found again in the body: from a board that neighbours share, and from how the drone turned."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.config.rig import MeasurementConfig
from flockd.core.messages import FloatArray
from flockd.flight.geometry import Camera, PinholeCamera, RigidTransform, WideAngleCamera, rotation_angle_deg
from flockd.ground.calibration.alignment import Attitudes, align
from flockd.ground.calibration.board import BoardFinder
from flockd.ground.calibration.errors import CalibrationError
from flockd.ground.calibration.extrinsics import SharedBoard, calibrate_rig
from flockd.ground.calibration.fragment import extrinsics_of
from flockd.ground.calibration.shared import SharedCollector
from flockd.ground.calibration.turns import CameraTurn, Follower
from tests.ground.calibration import darkroom
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
    assert fit.rms_px < 0.15
    assert fit.mountings["front"].T_body_camera is MOUNTS["front"]
    for name in ("right", "left"):
        found, true = fit.mountings[name], MOUNTS[name]
        assert rotation_angle_deg(found.T_body_camera.rotation.T @ true.rotation) < 0.2
        assert np.linalg.norm(found.T_body_camera.translation - true.translation) < 0.001
        assert found.sigma_deg < 0.1
        assert found.sigma_m < 0.001
    with pytest.raises(CalibrationError, match=r"^camera 'left' shares 0 boards with front, right, and needs 3; show"):
        calibrate_rig(cameras, [one for one in boards if "right" in one.seen], "front", MOUNTS["front"])


def test_a_board_that_moved_between_the_cameras_is_dropped() -> None:
    cameras = {name: camera_of(WIDE) for name in ("front", "right")}
    boards = [one for one in shared_boards() if "right" in one.seen]
    shaken = boards[2].seen["right"]
    moved = type(shaken)(shaken.ids, shaken.pixels + np.array([6.0, 0.0]), shaken.points)
    boards[2] = SharedBoard("shaken", {**boards[2].seen, "right": moved})
    fit = calibrate_rig(cameras, boards, "front", MOUNTS["front"])
    assert [name for name, _ in fit.dropped] == ["shaken"]
    error = fit.mountings["right"].T_body_camera.rotation.T @ MOUNTS["right"].rotation
    assert rotation_angle_deg(error) < 0.2


def test_a_mounting_is_written_as_it_is_read() -> None:
    written = extrinsics_of(MOUNTS["left"], NOTE)
    assert (written.yaw_deg, written.pitch_deg, written.roll_deg) == pytest.approx((-92.5, -4.0, 3.0), abs=1e-4)
    assert written.position_m == (0.02, -0.12, -0.01)


RATE_HZ, OFFSET_S = 20.0, 0.0437
"""The autopilot's clock is ahead of the frames' stamps by less than a frame period, and by no multiple of it."""


def attitude(time_s: FloatArray | float, axes: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Rotation:
    """The attitude of a drone that somebody turns about in their hands, on the autopilot's clock."""
    t = np.asarray(time_s)
    roll, pitch, yaw = 0.5 * np.sin(2.1 * t), 0.4 * np.sin(1.3 * t + 1.0), 0.8 * np.sin(0.9 * t) + 0.2 * np.sin(3.7 * t)
    return Rotation.from_euler("ZYX", np.stack([axes[2] * yaw, axes[1] * pitch, axes[0] * roll], axis=-1))


def said(times_s: FloatArray, noise_deg: float = 0.0, axes: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Attitudes:
    noise = np.radians(noise_deg) * np.random.default_rng(4).normal(size=(len(times_s), 3))
    return Attitudes(times_s, (attitude(times_s, axes) * Rotation.from_rotvec(noise)).as_matrix())


def turned(
    times_s: FloatArray, noise_deg: float = 0.0, axes: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> list[CameraTurn]:
    """What the left camera sees of it; its frames' stamps are behind."""
    rng = np.random.default_rng(5)
    poses = attitude(times_s + OFFSET_S, axes).as_matrix() @ MOUNTS["left"].rotation
    found = []
    for k in range(len(times_s) - 1):
        noise = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=3)).as_matrix()
        found.append(CameraTurn(times_s[k], times_s[k + 1], poses[k].T @ poses[k + 1] @ noise))
    return found


@pytest.mark.parametrize(
    ("noise_deg", "outliers", "within_deg", "within_s"),
    [(0.0, 0, 1e-4, 1e-6), (0.1, 0, 0.5, 2e-3), (0.1, 20, 0.5, 2e-3)],
)
def test_turns_tell_mounting_and_time(noise_deg: float, outliers: int, within_deg: float, within_s: float) -> None:
    frames = 10.0 + np.arange(200) / RATE_HZ
    states = 9.5 + np.arange(460) / 40.0 + 0.011  # the autopilot sends at its own times
    turns = turned(frames, noise_deg)
    for k in range(outliers):
        wrong = Rotation.from_euler("Y", 20.0, degrees=True).as_matrix()
        turns[9 * k] = CameraTurn(turns[9 * k].start_s, turns[9 * k].end_s, wrong)
    found = align(turns, said(states, noise_deg / 2), max_offset_s=0.3)
    assert rotation_angle_deg(found.R_body_camera.T @ MOUNTS["left"].rotation) < within_deg
    assert found.time_offset_s == pytest.approx(OFFSET_S, abs=within_s)
    assert found.turns <= len(turns) - outliers
    assert found.sigma_deg < within_deg
    assert found.sigma_s < within_s


def test_a_drone_that_only_yaws_does_not_tell_the_mounting() -> None:
    frames, states = 10.0 + np.arange(200) / RATE_HZ, 9.5 + np.arange(460) / 40.0
    only = (0.0, 0.0, 1.0)
    with pytest.raises(
        CalibrationError, match=r"known to \d+\.\d degrees only, as the drone mostly yawed; roll and pitch it"
    ):
        align(turned(frames, 0.05, only), said(states, 0.02, only), max_offset_s=0.3)


def test_turns_of_something_else_are_refused() -> None:
    frames, states = 10.0 + np.arange(200) / RATE_HZ, 9.5 + np.arange(460) / 40.0
    with pytest.raises(CalibrationError, match="nothing to do with each other"):
        align(turned(frames), Attitudes(states, said(states + 47.0).rotations), max_offset_s=0.3)
    with pytest.raises(
        CalibrationError, match=r"^12 turns with attitudes are too few, 30 are needed; record for longer"
    ):
        align(turned(frames[:13]), said(states), max_offset_s=0.3)


@pytest.mark.parametrize("sway_m", [0.0, 0.25], ids=["turning", "swaying"])
def test_turns_are_seen_in_images_of_a_room(sway_m: float) -> None:
    """Whether or not the camera also moves among things at all distances."""
    lens = Lens("wide_angle", (240, 180), 86.0, 86.0, 118.0, 92.0, (0.028, -0.011, 0.004, -0.0012))
    frames = 10.0 + np.arange(60) / 10.0
    follower = Follower(camera_of(lens), mounted(-90.0, 0.0, 0.0, (0.0, 0.0, 0.0)).rotation)
    for number, time_s in enumerate(frames):
        R_ned_body = attitude(time_s + OFFSET_S).as_matrix()
        at = sway_m * np.array([math.sin(1.1 * time_s), math.cos(1.7 * time_s), math.sin(0.7 * time_s)])
        image = darkroom.photograph_room(lens, R_ned_body @ MOUNTS["left"].rotation, at, seed=number)
        follower.add(time_s, image[..., 0], R_ned_body)
    true = turned(frames)
    errors = [
        rotation_angle_deg(one.rotation.T @ real.rotation) for one, real in zip(follower.turns, true, strict=True)
    ]
    assert np.median(errors) < 0.15
    found = align(follower.turns, said(9.5 + np.arange(180) / 25.0), max_offset_s=0.3)
    assert rotation_angle_deg(found.R_body_camera.T @ MOUNTS["left"].rotation) < 0.2
    assert found.time_offset_s == pytest.approx(OFFSET_S, abs=3e-3)
