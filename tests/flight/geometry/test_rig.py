"""The rig: where cameras look, from the configuration's angles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.core.config import load_drone
from flockd.core.config.rig import CameraConfig, ExtrinsicsConfig, IntrinsicsConfig, RigConfig
from flockd.core.data import data_path
from flockd.flight.geometry import PinholeCamera, Rig, RigCamera, RigidTransform, WideAngleCamera, build_rig

from .synthetic_world import four_camera_rig

INTRINSICS = IntrinsicsConfig(fx=222.0, fy=222.0, cx=240.0, cy=320.0)


def mounted(**extrinsics: float) -> RigCamera:
    config = CameraConfig(
        name="one",
        size_px=(480, 640),
        intrinsics=INTRINSICS,
        extrinsics=ExtrinsicsConfig.model_validate({"position_m": (0.1, 0.2, 0.3), **extrinsics}),
    )
    return build_rig(RigConfig(cameras=(config,))).cameras["one"]


@pytest.mark.parametrize(
    ("extrinsics", "right", "down", "ahead"),
    [
        ({}, (0, 1, 0), (0, 0, 1), (1, 0, 0)),
        ({"yaw_deg": 90.0}, (-1, 0, 0), (0, 0, 1), (0, 1, 0)),
        ({"pitch_deg": 90.0}, (0, 1, 0), (1, 0, 0), (0, 0, -1)),
        ({"roll_deg": 90.0}, (0, 0, 1), (0, -1, 0), (1, 0, 0)),
    ],
)
def test_a_camera_faces_where_its_angles_say(
    extrinsics: dict[str, float], right: tuple[int, ...], down: tuple[int, ...], ahead: tuple[int, ...]
) -> None:
    mount = mounted(**extrinsics).T_body_camera
    assert np.allclose(mount.rotation.T, [right, down, ahead], atol=1e-12)
    assert mount.translation.tolist() == [0.1, 0.2, 0.3]


def test_all_three_angles_turn_in_aerospace_order() -> None:
    mount = mounted(yaw_deg=40.0, pitch_deg=-25.0, roll_deg=10.0).T_body_camera
    turn = Rotation.from_euler("ZYX", [40.0, -25.0, 10.0], degrees=True)
    assert np.allclose(mount.rotation[:, 2], turn.apply([1.0, 0.0, 0.0]))
    assert np.allclose(mount.rotation[:, 0], turn.apply([0.0, 1.0, 0.0]))


def test_the_configuration_chooses_the_projection() -> None:
    def camera(name: str, model: str, lens: tuple[float, ...]) -> CameraConfig:
        fields = {**INTRINSICS.model_dump(), "model": model, "distortion": lens}
        return CameraConfig(name=name, size_px=(480, 640), intrinsics=IntrinsicsConfig(**fields))

    rig = build_rig(RigConfig(cameras=(camera("a", "pinhole", (0.1, 0, 0, 0)), camera("b", "wide_angle", ()))))
    assert list(rig.cameras) == ["a", "b"]
    assert isinstance(rig.cameras["a"].camera, PinholeCamera)
    assert isinstance(rig.cameras["b"].camera, WideAngleCamera)
    assert rig.cameras["a"].camera.distortion == (0.1, 0, 0, 0)
    with pytest.raises(ValueError, match="coefficients"):
        build_rig(RigConfig(cameras=(camera("a", "pinhole", (0.1,)),)))


def test_four_upright_cameras_see_all_around_but_not_straight_down() -> None:
    rig = four_camera_rig()
    bearings = np.radians(np.arange(0.0, 360.0, 5.0))
    level = np.stack([np.cos(bearings), np.sin(bearings), np.zeros_like(bearings)], axis=1)
    assert rig.covers(level).all()
    assert not rig.covers(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])).any()
    # 640 rows at f = 222 reach atan(320 / 222) = 55.2 degrees down.
    for degrees, seen in ((55.0, True), (55.5, False)):
        direction = [[np.cos(np.radians(degrees)), 0.0, np.sin(np.radians(degrees))]]
        assert rig.covers(np.array(direction))[0] == seen


def test_a_point_lands_in_the_cameras_that_see_it_with_their_lever_arms() -> None:
    rig = four_camera_rig()
    pixels = rig.pixels_of(np.array([[2.1, 1.0, 0.5], [-2.1, 0.0, 0.0]]))
    # The front camera sits 0.1 m ahead: 2 m in front of it, 1 m right and 0.5 m down.
    assert pixels["front"][0] == pytest.approx([240.0 + 111.0, 320.0 + 55.5])
    assert pixels["back"][1] == pytest.approx([240.0, 320.0])
    assert np.isnan(pixels["front"][1]).all()
    assert np.isnan(pixels["back"][0]).all()
    assert np.isnan(pixels["left"]).all()
    assert np.isnan(pixels["right"][0]).all()  # ahead of that camera, but outside its image


def test_all_of_a_drone_is_shown_where_one_camera_images_all_of_it() -> None:
    """The front camera's image ends 47.2 degrees to the right of ahead and the right one's begins at 42.8; a drone of
    0.3 m radius 3 m away is 11.5 degrees wide.
    """
    rig = four_camera_rig()

    def shown(right_deg: float, down_deg: float, radius_m: float, without: frozenset[str] = frozenset()) -> bool:
        right, down = np.radians([right_deg, down_deg])
        there = [[np.cos(down) * np.cos(right), np.cos(down) * np.sin(right), np.sin(down)]]
        return bool(rig.shows(3.0 * np.array(there), radius_m, without)[0])

    assert shown(30.0, 0.0, 0.3)
    assert shown(45.0, 0.0, 0.0)
    assert not shown(45.0, 0.0, 0.3), "each of two cameras shows a part of it"
    assert shown(0.0, 47.0, 0.3)
    assert not shown(0.0, 53.0, 0.3)
    assert shown(0.0, 53.0, 0.0)
    assert not shown(30.0, 0.0, 0.0, frozenset({"front"}))
    assert shown(45.0, 0.0, 0.0, frozenset({"front"}))


def test_a_rig_without_cameras_or_with_a_misfiled_one_is_refused() -> None:
    camera = four_camera_rig().cameras["front"]
    with pytest.raises(ValueError, match="at least one"):
        Rig({})
    with pytest.raises(ValueError, match="'front' is filed under the name 'back'"):
        Rig({"back": camera})
    assert RigCamera("x", camera.camera, RigidTransform.identity()).name == "x"


def test_the_simulators_rig_has_no_blind_sector_for_neighbours() -> None:
    """Every direction from 45 degrees below to 45 degrees above the horizon is in some camera's view."""
    rig = build_rig(load_drone(data_path("config") / "simulator.yaml").rig)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0.0, 360.0, 0.5)), np.radians(np.arange(-45.0, 45.1, 0.5)))
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)], axis=-1
    )
    assert rig.covers(directions.reshape(-1, 3)).all()
