"""The cameras against OpenCV's, which counts pixels from their centres: its pixel 0 is our 0.5."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flockd.core.messages import FloatArray
from flockd.flight.geometry import Camera, PinholeCamera, WideAngleCamera

MATRIX = np.array([[300.0, 0.0, 322.5], [0.0, 310.0, 236.5], [0.0, 0.0, 1.0]])
OPENCV_MATRIX = MATRIX - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
SIZE = (640, 480)
NOTHING = np.zeros(3)
PINHOLE_LENSES = [(), (-0.25, 0.08, 0.002, -0.001), (-0.3, 0.12, -0.001, 0.002, -0.02), (0.1, 0.02, 0.0, 0.0)]
WIDE_LENSES = [(), (-0.02, 0.003, -0.001, 0.0001), (0.05, -0.01, 0.002, -0.0002)]


def points_ahead(count: int = 200) -> FloatArray:
    random = np.random.default_rng(3)
    z = random.uniform(0.5, 20.0, count)
    return np.stack([random.uniform(-0.9, 0.9, count) * z, random.uniform(-0.7, 0.7, count) * z, z], axis=1)


@pytest.mark.parametrize("lens", PINHOLE_LENSES)
def test_pinhole_projects_as_opencv_does(lens: tuple[float, ...]) -> None:
    points = points_ahead()
    expected, derivative = cv2.projectPoints(points, NOTHING, NOTHING, OPENCV_MATRIX, np.array(lens or (0.0,) * 4))
    camera = PinholeCamera(MATRIX, SIZE, lens)
    assert np.allclose(camera.project(points), expected[:, 0] + 0.5, atol=1e-9)
    # OpenCV's derivative by the translation is, without a rotation, the one by the point.
    assert np.allclose(camera.jacobian(points), derivative[:, 3:6].reshape(-1, 2, 3), atol=1e-6)


@pytest.mark.parametrize("lens", WIDE_LENSES)
def test_wide_angle_projects_as_opencv_does_ahead(lens: tuple[float, ...]) -> None:
    points = points_ahead()
    expected, derivative = cv2.fisheye.projectPoints(
        points[:, None], NOTHING, NOTHING, OPENCV_MATRIX, np.array(lens or (0.0,) * 4)
    )
    camera = WideAngleCamera(MATRIX, SIZE, lens)
    assert np.allclose(camera.project(points), expected[:, 0] + 0.5, atol=1e-9)
    # OpenCV's columns: focal lengths 2, centre 2, distortion 4, rotation 3, translation 3, skew 1.
    assert np.allclose(camera.jacobian(points), derivative[:, 11:14].reshape(-1, 2, 3), atol=1e-6)


@pytest.mark.parametrize(
    "camera",
    [
        *(PinholeCamera(MATRIX, SIZE, k) for k in PINHOLE_LENSES),
        *(WideAngleCamera(MATRIX, SIZE, k) for k in WIDE_LENSES),
    ],
)
def test_every_lens_lifts_a_pixel_to_a_range_along_its_ray(camera: Camera) -> None:
    points = points_ahead()
    lifted = camera.unproject(camera.project(points), np.linalg.norm(points, axis=1))
    assert np.allclose(lifted, points, atol=1e-8)


@pytest.mark.parametrize("camera", [PinholeCamera(MATRIX, SIZE), WideAngleCamera(MATRIX, SIZE)])
def test_the_angle_of_a_pixel_is_what_the_jacobian_says_of_its_longer_way(camera: Camera) -> None:
    points = points_ahead()
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    # Across the ray, the singular values of the derivative are pixels per radian along the ellipse's axes.
    singular = np.linalg.svd(camera.jacobian(rays), compute_uv=False)
    # Both focal lengths of the matrix are near, not equal; the mean of both is what is said.
    np.testing.assert_allclose(camera.pixel_angle(rays), 1.0 / singular[:, 1], rtol=0.02)


def test_wide_angle_sees_behind_its_own_plane() -> None:
    camera = WideAngleCamera(np.array([[100.0, 0.0, 300.0], [0.0, 100.0, 300.0], [0.0, 0.0, 1.0]]), (600, 600))
    theta = np.radians(110.0)
    point = 7.0 * np.array([[np.sin(theta), 0.0, np.cos(theta)]])  # z is negative
    pixel = camera.project(point)
    assert pixel[0] == pytest.approx([300.0 + 100.0 * theta, 300.0])  # equidistant: f theta
    assert camera.in_image(pixel).all()
    assert np.allclose(camera.unproject(pixel, np.array([7.0])), point)


def test_wide_angle_is_smooth_on_its_axis() -> None:
    camera = WideAngleCamera(MATRIX, SIZE, WIDE_LENSES[1])
    assert np.allclose(camera.project(np.array([[0.0, 0.0, 4.0]])), [[322.5, 236.5]])
    assert np.allclose(camera.rays(np.array([[322.5, 236.5]])), [[0.0, 0.0, 1.0]])
    assert np.allclose(camera.jacobian(np.array([[0.0, 0.0, 4.0]]))[0], [[75.0, 0, 0], [0, 77.5, 0]], atol=1e-6)


def test_what_lies_behind_a_pinhole_has_no_pixel() -> None:
    camera = PinholeCamera(MATRIX, SIZE)
    pixels = camera.project(np.array([[0.0, 0.0, 5.0], [0.0, 0.0, -5.0], [1.0, 1.0, 0.0], [np.nan, 0.0, 1.0]]))
    assert pixels[0] == pytest.approx([322.5, 236.5])
    assert np.isnan(pixels[1:3]).all()
    assert np.isnan(pixels[3, 0])
    assert camera.in_image(pixels).tolist() == [True, False, False, False]


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


def test_image_borders_are_half_open() -> None:
    camera = PinholeCamera(MATRIX, SIZE)
    pixels = np.array([[0.0, 0.0], [639.99, 479.99], [640.0, 10.0], [10.0, 480.0], [-0.01, 10.0]])
    assert camera.in_image(pixels).tolist() == [True, True, False, False, False]


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
