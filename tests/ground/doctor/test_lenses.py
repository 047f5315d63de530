"""Calibrations that cannot be true, and rigs that do not see all around."""

from __future__ import annotations

import pytest

from flockd.core.config import load_drone
from flockd.core.config.rig import CameraConfig, IntrinsicsConfig, RigConfig
from flockd.core.data import data_path
from flockd.ground.doctor import Level
from flockd.ground.doctor.camera_checks import coverage, lens_problems, width_deg

QUADROTOR = load_drone(data_path("config") / "quadrotor.yaml").rig
SIMULATOR = load_drone(data_path("config") / "simulator.yaml").rig


def _camera(**lens: object) -> CameraConfig:
    values = {"fx": 320.0, "fy": 320.0, "cx": 320.0, "cy": 240.0, **lens}
    return CameraConfig(name="front", size_px=(640, 480), intrinsics=IntrinsicsConfig.model_validate(values))


def test_how_wide_a_camera_sees() -> None:
    assert width_deg(_camera()) == pytest.approx(90.0)  # the pinhole: 2 atan(320 / 320)
    assert width_deg(QUADROTOR.cameras[0]) == pytest.approx(97.5, abs=0.05)  # the equidistant: 480 / 282.1 rad
    assert width_deg(_camera(model="wide_angle", fx=203.7, fy=203.7)) == pytest.approx(180.0, abs=0.05)


@pytest.mark.parametrize("camera", [*QUADROTOR.cameras, *SIMULATOR.cameras], ids=lambda camera: camera.name)
def test_the_shipped_calibrations_can_be_true(camera: CameraConfig) -> None:
    assert not list(lens_problems(camera))


@pytest.mark.parametrize(
    ("lens", "level", "told"),
    [
        ({"fx": 640.0, "fy": 640.0, "cx": 608.0, "cy": 456.0}, Level.FAILURE, "principal point 608, 456 is 45%"),
        ({"cx": 385.0}, Level.WARNING, "principal point 385, 240 is 10%"),
        ({"fx": 240.0}, Level.FAILURE, "fx 240 and fy 320 differ by 25%"),
        ({"fx": 337.0}, Level.WARNING, "fx 337 and fy 320 differ by 5%"),
        ({"fx": 130.0, "fy": 130.0}, Level.FAILURE, "the pinhole calibration sees 136 degrees from left to right"),
        ({"fx": 1100.0, "fy": 1100.0}, Level.WARNING, "32 degrees from left to right see few neighbours"),
        ({"distortion": (0.1,)}, Level.FAILURE, "its calibration is unusable (PinholeCamera takes"),
        # Turns back at r = 0.82 of the focal length (1 - 3 * 0.5 r^2 = 0), where it images 0.54; the border is at 1.
        ({"distortion": (-0.5, 0.0, 0.0, 0.0)}, Level.FAILURE, "sees no direction at its border"),
    ],
)
def test_a_calibration_of_another_size_or_lens_is_reported(lens: dict[str, object], level: Level, told: str) -> None:
    (problem,) = lens_problems(_camera(**lens))
    assert (problem.level, problem.about) == (level, "camera front")
    assert told in problem.measured
    assert "calibrate this camera" in problem.fix


def test_four_cameras_see_all_around_and_three_do_not() -> None:
    assert coverage(QUADROTOR).level is Level.PASS
    assert coverage(SIMULATOR).level is Level.PASS
    three = RigConfig(cameras=tuple(camera for camera in QUADROTOR.cameras if camera.name != "back"))
    found = coverage(three)
    assert found.level is Level.WARNING
    # The right camera ends 48.75 degrees behind 90, the left one begins 48.75 before 270.
    assert "from 139 to 221 degrees" in found.measured
    ahead_is_blind = RigConfig(cameras=tuple(camera for camera in QUADROTOR.cameras if camera.name != "front"))
    assert "from 319 to 41 degrees" in coverage(ahead_is_blind).measured


def test_it_says_how_far_up_and_down_they_see_all_around() -> None:
    """Between two pinholes, 45 degrees off each axis, an edge at 320 of 222 px is at atan(320 / 222 * cos 45)."""
    assert "all around to 45 degrees off it" in coverage(SIMULATOR).measured


def test_cameras_that_face_the_ground_see_no_horizon() -> None:
    down = [
        camera.model_copy(update={"extrinsics": camera.extrinsics.model_copy(update={"pitch_deg": -90.0})})
        for camera in SIMULATOR.cameras
    ]
    assert coverage(RigConfig(cameras=tuple(down[:1]))).level is Level.FAILURE
