"""The virtual crop: what is painted into the real cameras' images lands where geometry says."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.messages import BoolArray, FloatArray, UInt8Array
from flockd.flight.geometry import RigCamera, VirtualCrop, grid_pixels, virtual_crop

from .synthetic_world import four_camera_rig

RIG = four_camera_rig()


def sees_ball(start: FloatArray, rays: FloatArray, centre: FloatArray, radius: float) -> BoolArray:
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    along = unit @ (centre - start)
    closest = start + along[:, None] * unit
    hit: BoolArray = (np.linalg.norm(centre - closest, axis=1) < radius) & (along > 0.0)
    return hit


def picture_of_ball(camera: RigCamera, centre: FloatArray, radius: float) -> UInt8Array:
    """White ball on black, cast pixel by pixel."""
    pixels = grid_pixels(camera.camera.size, 1)
    rays = camera.camera.rays(pixels) @ camera.T_body_camera.rotation.T
    hit = sees_ball(camera.T_body_camera.translation, rays, centre, radius)
    return np.repeat((255 * hit).astype(np.uint8), 3).reshape(640, 480, 3)


def ball_in_crop(crop: VirtualCrop, centre: FloatArray, radius: float) -> BoolArray:
    size = crop.camera.size[0]
    rays = crop.camera.rays(grid_pixels(crop.camera.size, 1)) @ crop.T_body_virtual.rotation.T
    return sees_ball(crop.T_body_virtual.translation, rays, centre, radius).reshape(size, size)


def overlap(picture: UInt8Array, expected: BoolArray) -> float:
    """Intersection over union."""
    white = picture[:, :, 0] > 127
    return float((white & expected).sum() / (white | expected).sum())


def test_it_sits_in_the_best_camera_and_faces_level_along_the_direction() -> None:
    direction = np.array([0.9, 0.3, 0.2])
    crop = virtual_crop(RIG, direction, 0.2, 96)
    assert crop.main == "front"
    assert crop.T_body_virtual.translation.tolist() == RIG.cameras["front"].T_body_camera.translation.tolist()
    assert np.allclose(crop.T_body_virtual.rotation[:, 2], direction / np.linalg.norm(direction))
    assert crop.T_body_virtual.rotation[2, 0] == 0.0  # x is horizontal
    assert crop.T_body_virtual.rotation[2, 1] > 0.0  # y points down
    # The image's border is half_angle off the axis.
    assert np.allclose(crop.camera.project(np.array([[np.tan(0.2), 0.0, 1.0]])), [[96.0, 48.0]])
    assert virtual_crop(RIG, np.array([-0.1, -2.0, 0.0]), 0.2, 96).main == "left"


def test_every_pixel_takes_the_colour_of_its_own_ray_to_a_fraction_of_a_pixel() -> None:
    # Red and green of the image are its u and v, so the crop's colours say which pixel they were taken from.
    rig = four_camera_rig((120, 160), focal=55.5)
    pixels = grid_pixels((120, 160), 1).reshape(160, 120, 2)
    image = np.zeros((160, 120, 3), dtype=np.uint8)
    image[:, :, :2] = np.rint(1.5 * pixels)
    crop = virtual_crop(rig, np.array([1.0, 0.15, -0.3]), 0.5, 80)
    picture, valid = crop.sample({"front": image})
    assert valid.all()
    directions = crop.camera.rays(grid_pixels((80, 80), 1)) @ crop.T_body_virtual.rotation.T
    expected = 1.5 * rig.cameras["front"].pixels_of_directions(directions).reshape(80, 80, 2)
    difference = picture[:, :, :2] - expected
    assert np.abs(difference).max() < 1.5  # rounding twice, on a value of 1.5 a pixel
    assert np.abs(difference.mean(axis=(0, 1))).max() < 0.1  # half a pixel would be 0.75


def test_a_ball_across_two_cameras_is_seen_whole_and_its_range_closes_the_seam() -> None:
    centre = np.array([1.5, 1.6, 0.2])
    images = {name: picture_of_ball(camera, centre, 0.4) for name, camera in RIG.cameras.items()}
    crop = virtual_crop(RIG, centre, 0.3, 96)
    expected = ball_in_crop(crop, centre, 0.4)
    _, in_main = crop.sample({crop.main: images[crop.main]})
    assert 0.2 < (expected & ~in_main).sum() / expected.sum() < 0.8  # the main camera has only a part of it
    distance = float(np.linalg.norm(centre - crop.T_body_virtual.translation))
    with_range, valid = crop.sample(images, range_m=distance)
    without, _ = crop.sample(images)
    assert valid.all()
    assert overlap(with_range, expected) > 0.95
    assert overlap(without, expected) < 0.93  # 0.14 m between the cameras at 2.2 m: some 10 px of 96


def test_what_no_camera_sees_is_grey_and_marked() -> None:
    white = {name: np.full((640, 480, 3), 255, dtype=np.uint8) for name in RIG.cameras}
    crop = virtual_crop(RIG, np.array([1.0, 0.0, 1.3]), 0.2, 64)  # 52 degrees down; the view ends at 55
    picture, valid = crop.sample(white)
    assert valid[:32].all()
    assert not valid[-16:].any()
    assert (picture[~valid] == 128).all()
    assert (picture[valid] == 255).all()
    nothing, none_valid = crop.sample({"back": white["back"]})
    assert not none_valid.any()
    assert (nothing == 128).all()


def test_a_direction_nobody_sees_and_an_impossible_angle_are_refused() -> None:
    with pytest.raises(ValueError, match="no camera sees"):
        virtual_crop(RIG, np.array([0.0, 0.0, 1.0]), 0.2, 96)
    with pytest.raises(ValueError, match="half angle"):
        virtual_crop(RIG, np.array([1.0, 0.0, 0.0]), 1.6, 96)
