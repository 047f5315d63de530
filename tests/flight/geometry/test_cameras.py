"""The cameras against OpenCV's, which counts pixels from their centres: its pixel 0 is our 0.5; and rigs of them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from flockd.core.config import load_drone
from flockd.core.config.rig import RigConfig
from flockd.core.data import data_path
from flockd.core.messages import FloatArray
from flockd.flight.geometry import (
    Camera,
    PinholeCamera,
    RigidTransform,
    WideAngleCamera,
    ZMap,
    build_rig,
    range_map,
)
from tests.make import camera as camera_config

from .synthetic_world import four_camera_rig

MATRIX = np.array([[300.0, 0.0, 322.5], [0.0, 310.0, 236.5], [0.0, 0.0, 1.0]])
OPENCV_MATRIX = MATRIX - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
SIZE = (640, 480)
NOTHING = np.zeros(3)
PINHOLES = [
    PinholeCamera(MATRIX, SIZE, lens)
    for lens in ((), (-0.25, 0.08, 0.002, -0.001), (-0.3, 0.12, -0.001, 0.002, -0.02), (0.1, 0.02, 0.0, 0.0))
]
WIDE_ANGLES = [
    WideAngleCamera(MATRIX, SIZE, lens) for lens in ((), (-0.02, 0.003, -0.001, 0.0001), (0.05, -0.01, 0.002, -0.0002))
]
ALL = pytest.mark.parametrize("camera", [*PINHOLES, *WIDE_ANGLES])


def points_ahead(count: int = 200) -> FloatArray:
    random = np.random.default_rng(3)
    z = random.uniform(0.5, 20.0, count)
    return np.stack([random.uniform(-0.9, 0.9, count) * z, random.uniform(-0.7, 0.7, count) * z, z], axis=1)


@ALL
def test_it_projects_as_opencv_does_and_lifts_a_pixel_to_a_range_along_its_ray(camera: Camera) -> None:
    points, lens = points_ahead(), np.array(camera.distortion or (0.0,) * 4)
    if isinstance(camera, PinholeCamera):
        expected, derivative = cv2.projectPoints(points, NOTHING, NOTHING, OPENCV_MATRIX, lens)
        by_point = derivative[:, 3:6]  # by the translation, which without a rotation is by the point
    else:
        expected, derivative = cv2.fisheye.projectPoints(points[:, None], NOTHING, NOTHING, OPENCV_MATRIX, lens)
        by_point = derivative[:, 11:14]  # behind focal lengths 2, centre 2, distortion 4, rotation 3
    assert np.allclose(camera.project(points), expected[:, 0] + 0.5, atol=1e-9)
    assert np.allclose(camera.jacobian(points), by_point.reshape(-1, 2, 3), atol=1e-6)
    lifted = camera.unproject(camera.project(points), np.linalg.norm(points, axis=1))
    assert np.allclose(lifted, points, atol=1e-8)


@ALL
def test_a_map_of_z_lifts_a_pixel_to_where_it_is(camera: Camera) -> None:
    """A wall across the optical axis: its z is the same everywhere."""
    wall = ZMap(np.full(SIZE[::-1], 5.0, np.float32))
    ranges = range_map(wall, camera)
    for off_axis_deg in (0.0, 15.0, 30.0):
        point = 5.0 * np.array([[0.0, np.tan(np.radians(off_axis_deg)), 1.0]])
        pixel = camera.project(point)
        column, row = pixel[0].astype(int)
        lifted = camera.unproject(pixel, np.array([ranges[row, column]], np.float64))
        np.testing.assert_allclose(lifted, point, atol=0.02)  # half a pixel off


def test_wide_angle_sees_behind_its_own_plane() -> None:
    camera = WideAngleCamera(np.array([[100.0, 0.0, 300.0], [0.0, 100.0, 300.0], [0.0, 0.0, 1.0]]), (600, 600))
    theta = np.radians(110.0)
    point = 7.0 * np.array([[np.sin(theta), 0.0, np.cos(theta)]])  # z is negative
    pixel = camera.project(point)
    assert pixel[0] == pytest.approx([300.0 + 100.0 * theta, 300.0])  # equidistant: f theta
    assert camera.in_image(pixel).all()
    assert np.allclose(camera.unproject(pixel, np.array([7.0])), point)


def test_a_lens_whose_circle_is_wider_than_its_angle_has_rays_to_its_edge() -> None:
    """Newton's method alone begins such a pixel at the turning point, where the slope is 0."""
    lens = (0.118, -0.080, 0.082, -0.024)
    theta = np.radians(np.linspace(1.0, 89.5, 60))  # turns at 90.2 degrees
    radius = theta * (1 + sum(k * theta ** (2 * power) for power, k in enumerate(lens, start=1)))
    assert radius.max() > np.radians(100.0)
    pixels = MATRIX[:2, 2] + np.stack([300.0 * radius, np.zeros(60)], axis=1)
    np.testing.assert_allclose(np.arccos(WideAngleCamera(MATRIX, SIZE, lens).rays(pixels)[:, 2]), theta, atol=1e-6)


def test_what_lies_behind_a_pinhole_has_no_pixel_and_image_borders_are_half_open() -> None:
    camera = PINHOLES[0]
    pixels = camera.project(np.array([[0.0, 0.0, 5.0], [0.0, 0.0, -5.0], [1.0, 1.0, 0.0], [np.nan, 0.0, 1.0]]))
    assert pixels[0] == pytest.approx([322.5, 236.5])
    assert np.isnan(pixels[1:3]).all()
    assert np.isnan(pixels[3, 0])
    assert camera.in_image(pixels).tolist() == [True, False, False, False]
    pixels = np.array([[0.0, 0.0], [639.99, 479.99], [640.0, 10.0], [10.0, 480.0], [-0.01, 10.0]])
    assert camera.in_image(pixels).tolist() == [True, True, False, False, False]


def test_a_barrel_lens_does_not_fold_far_directions_back_into_the_image() -> None:
    # r (1 - 0.3 r^2) grows up to r = 1.054 and is back at 0 for r = 1.826: OpenCV shows that direction mid-image.
    lens = (-0.3, 0.0, 0.0, 0.0)
    camera = PinholeCamera(MATRIX, SIZE, lens)
    folded, _ = cv2.projectPoints(np.array([[1.826, 0.0, 1.0]]), NOTHING, NOTHING, OPENCV_MATRIX, np.array(lens))
    assert abs(folded[0, 0, 0] + 0.5 - 322.5) < 1.0
    assert np.isnan(camera.project(np.array([[1.826, 0.0, 1.0]]))).all()
    # And a pixel outside the largest imaged circle, 0.703 focal lengths, shows nothing.
    assert np.isfinite(camera.rays(np.array([[322.5 + 0.70 * 300.0, 236.5]]))).all()
    assert np.isnan(camera.rays(np.array([[322.5 + 0.71 * 300.0, 236.5]]))).all()


@pytest.mark.parametrize(
    ("matrix", "size", "lens", "reason"),
    [
        (np.eye(2), SIZE, (), r"\(3, 3\)"),
        (MATRIX * np.nan, SIZE, (), "finite"),
        (MATRIX * np.array([-1.0, 1.0, 1.0]), SIZE, (), "positive"),
        (MATRIX + np.array([[0.0, 1.0, 0.0], [0.0] * 3, [0.0] * 3]), SIZE, (), "fx"),
        (MATRIX, (0, 480), (), "size"),
        (MATRIX, SIZE, (0.1, 0.1), "coefficients"),
    ],
)
def test_what_is_no_camera_is_refused(
    matrix: FloatArray, size: tuple[int, int], lens: tuple[float, ...], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        PinholeCamera(matrix, size, lens)


# Rigs: where cameras look, from the configuration's angles.


def mounted(**extrinsics: Any) -> RigidTransform:
    config = camera_config("one", position_m=(0.1, 0.2, 0.3), **extrinsics)
    return build_rig(RigConfig(cameras=(config,))).cameras["one"].T_body_camera


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
    mount = mounted(**extrinsics)
    assert np.allclose(mount.rotation.T, [right, down, ahead], atol=1e-12)
    assert mount.translation.tolist() == [0.1, 0.2, 0.3]


def towards(azimuth_deg: FloatArray | float, down_deg: FloatArray | float = 0.0) -> FloatArray:
    """(n, 3) directions in body axes, from ahead to the right and down."""
    azimuth, down = np.meshgrid(np.radians(azimuth_deg), np.radians(down_deg))
    across = np.cos(down)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(down)], -1).reshape(-1, 3)


def test_four_upright_cameras_see_all_around_but_not_straight_down() -> None:
    rig = four_camera_rig()
    assert rig.covers(towards(np.arange(0.0, 360.0, 5.0))).all()
    assert not rig.covers(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])).any()
    # 640 rows at f = 222 reach atan(320 / 222) = 55.2 degrees down.
    assert rig.covers(towards(0.0, np.array([55.0, 55.5]))).tolist() == [True, False]


def test_a_point_lands_in_the_cameras_that_see_it_with_their_lever_arms() -> None:
    places = np.array([[2.1, 1.0, 0.5], [-2.1, 0.0, 0.0]])
    pixels = {name: camera.pixels_of_points(places) for name, camera in four_camera_rig().cameras.items()}
    # The front camera sits 0.1 m ahead: 2 m in front of it, 1 m right and 0.5 m down.
    assert pixels["front"][0] == pytest.approx([240.0 + 111.0, 320.0 + 55.5])
    assert pixels["back"][1] == pytest.approx([240.0, 320.0])
    for name, points in (("front", [1]), ("back", [0]), ("left", [0, 1]), ("right", [0])):
        assert np.isnan(pixels[name][points]).all()  # the first is ahead of the right one, but outside its image


@pytest.mark.parametrize(
    ("right_deg", "down_deg", "radius_m", "without", "shown"),
    [
        (30.0, 0.0, 0.3, (), True),
        (45.0, 0.0, 0.0, (), True),
        (45.0, 0.0, 0.3, (), False),  # each of two cameras shows a part of it
        (0.0, 47.0, 0.3, (), True),
        (0.0, 53.0, 0.3, (), False),
        (0.0, 53.0, 0.0, (), True),
        (30.0, 0.0, 0.0, ("front",), False),
        (45.0, 0.0, 0.0, ("front",), True),
    ],
)
def test_all_of_a_drone_is_shown_where_one_camera_images_all_of_it(
    right_deg: float, down_deg: float, radius_m: float, without: tuple[str, ...], shown: bool
) -> None:
    """The front camera's image ends 47.2 degrees to the right of ahead and the right one's begins at 42.8; a drone of
    0.3 m radius 3 m away is 11.5 degrees wide.
    """
    place = 3.0 * towards(right_deg, down_deg)
    assert four_camera_rig().shows(place, radius_m, frozenset(without)).tolist() == [shown]


def test_the_simulators_rig_has_no_blind_sector_for_neighbours() -> None:
    """Every direction from 45 degrees below to 45 degrees above the horizon is in some camera's view."""
    rig = build_rig(load_drone(data_path("config") / "simulator.yaml").rig)
    assert rig.covers(towards(np.arange(0.0, 360.0, 0.5), np.arange(-45.0, 45.1, 0.5))).all()
