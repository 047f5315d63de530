"""The ground's inverse depth against geometry done by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flockd.flight.geometry import RigCamera, RigidTransform, WideAngleCamera, ground_inverse_depth

from .synthetic_world import four_camera_rig

RIG = four_camera_rig()
LEVEL = np.eye(3)


def test_a_level_camera_sees_the_ground_under_45_degrees_as_far_ahead_as_it_is_high() -> None:
    inverse = ground_inverse_depth(RIG.cameras["front"], LEVEL, 4.0)
    assert inverse.shape == (640, 480)
    assert inverse.dtype == np.float32
    # Row 541 has its centre 221.5 px below the principal point: z = 4 m * 222 / 221.5, in every column.
    assert np.allclose(inverse[541], 221.5 / 222.0 / 4.0, rtol=1e-5)
    assert (inverse[:320] == 0.0).all()  # the sky
    assert (inverse[320:] > 0.0).all()


def test_random_attitudes_agree_with_rays_cast_in_the_world() -> None:
    random = np.random.default_rng(0)
    for camera in RIG.cameras.values():
        attitude = Rotation.from_euler("ZYX", random.uniform(-1.0, 1.0, 3) * [180.0, 20.0, 20.0], degrees=True)
        inverse = ground_inverse_depth(camera, attitude.as_matrix(), 3.3)
        for row, column in random.integers(0, [640, 480], (40, 2)):
            through_pixel = np.array([(column + 0.5 - 240.0) / 222.0, (row + 0.5 - 320.0) / 222.0, 1.0])
            start = attitude.apply(camera.T_body_camera.translation)
            ray = attitude.apply(camera.T_body_camera.rotation @ through_pixel)
            z = (3.3 - start[2]) / ray[2]  # where down reaches 3.3 m
            assert inverse[row, column] == pytest.approx(max(1.0 / z, 0.0), abs=1e-6)


def test_a_strided_map_is_the_ground_at_the_blocks_centres() -> None:
    camera = RIG.cameras["left"]
    attitude = Rotation.from_euler("ZYX", [20.0, 5.0, -8.0], degrees=True).as_matrix()
    full = ground_inverse_depth(camera, attitude, 5.0).astype(np.float64)
    strided = ground_inverse_depth(camera, attitude, 5.0, stride=4)
    assert strided.shape == (160, 120)
    blocks = full.reshape(160, 4, 120, 4).mean(axis=(1, 3))
    below = full.reshape(160, 4, 120, 4).min(axis=(1, 3)) > 0.0
    assert below.any()
    assert np.allclose(strided[below], blocks[below], atol=1e-6)  # linear in the image, so the mean is the centre


def test_a_wide_angle_camera_gets_the_inverse_of_z_too() -> None:
    matrix = np.array([[100.0, 0.0, 200.0], [0.0, 100.0, 200.0], [0.0, 0.0, 1.0]])
    front = RIG.cameras["front"]
    camera = RigCamera(
        "fisheye", WideAngleCamera(matrix, (400, 400)), RigidTransform(front.T_body_camera.rotation, np.zeros(3))
    )
    inverse = ground_inverse_depth(camera, LEVEL, 2.0)
    theta = (300.5 - 200.0) / 100.0  # equidistant, straight below the axis
    assert inverse[300, 199:201].mean() == pytest.approx(np.tan(theta) / 2.0, rel=1e-4)


@pytest.mark.fault("ground-reached")
def test_a_camera_on_the_ground_and_a_stride_that_does_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="'front' is not above the ground"):
        ground_inverse_depth(RIG.cameras["front"], LEVEL, 0.0)
    with pytest.raises(ValueError, match="stride of 7 does not divide an image of 480x640"):
        ground_inverse_depth(RIG.cameras["front"], LEVEL, 4.0, stride=7)


def test_a_slope_is_ground_that_rises_by_so_much_for_each_metre() -> None:
    """Against points of a hillside 4 m below the drone that rises by 10 % to the north and falls by 5 % to the east."""
    attitude = Rotation.from_euler("ZYX", [50.0, 4.0, -7.0], degrees=True)
    random, slope = np.random.default_rng(2), (0.1, -0.05)
    for camera in RIG.cameras.values():
        inverse = ground_inverse_depth(camera, attitude.as_matrix(), 4.0, slope=slope)
        level = random.uniform(-12.0, 12.0, (300, 2))
        points = np.column_stack([level, 4.0 - level @ np.array(slope)])  # NED, from the drone
        seen = camera.T_body_camera.inverse().apply(attitude.inv().apply(points))
        pixels = 222.0 * seen[:, :2] / seen[:, 2:] + np.array([240.0, 320.0])
        shown = (seen[:, 2] > 0.5) & (pixels >= 1.0).all(axis=1) & (pixels < [479.0, 639.0]).all(axis=1)
        assert shown.sum() > 10
        column, row = pixels[shown].astype(int).T
        np.testing.assert_allclose(inverse[row, column], 1.0 / seen[shown, 2], atol=0.003)  # half a pixel off
