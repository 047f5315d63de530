"""The virtual crop: what is painted into the real cameras' images lands where geometry says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flockd.core.messages import BoolArray, FloatArray, UInt8Array
from flockd.flight.geometry import Rig, RigCamera, VirtualCrops, grid_pixels, virtual_crops
from flockd.flight.geometry.cameras import Camera, PinholeCamera, WideAngleCamera

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


def rays_of(crops: VirtualCrops) -> FloatArray:
    """(size^2, 3) of a single crop's pixels, in the body: those of a pinhole."""
    size = crops.size_px
    across = (grid_pixels((size, size), 1) - size / 2) / crops.focal_px
    return np.asarray(np.insert(across, 2, 1.0, axis=1) @ crops.R_body_virtual[0].T)


def crop_towards(direction: FloatArray, half_angle: float, size_px: int, rig: Rig = RIG) -> VirtualCrops:
    return virtual_crops(rig, direction[None], np.array([half_angle]), size_px)


def overlap(picture: UInt8Array, expected: BoolArray) -> float:
    """Intersection over union."""
    white = picture[:, :, 0] > 127
    return float((white & expected).sum() / (white | expected).sum())


def test_they_sit_in_the_best_camera_and_face_level_along_the_direction() -> None:
    directions = np.array([[0.9, 0.3, 0.2], [-0.1, -2.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    crops = virtual_crops(RIG, directions, np.array([0.2, 0.3, 0.2, 1.6]), 96)
    # No camera looks straight down, and no pinhole has half angles beyond 90 degrees.
    assert crops.main.tolist() == [*map(list(RIG.cameras).index, ("front", "left")), -1, -1]
    assert crops.centres[0].tolist() == RIG.cameras["front"].T_body_camera.translation.tolist()
    right, down, forward = crops.R_body_virtual[:2].transpose(2, 0, 1)
    assert np.allclose(forward, directions[:2] / np.linalg.norm(directions[:2], axis=1, keepdims=True))
    assert (right[:, 2] == 0.0).all() and (down[:, 2] > 0.0).all(), "x is horizontal, y points down"
    # The image's border is half_angle off the axis.
    border = crops.take(np.array([0, 1])).rays(np.array([[96.0, 48.0], [48.0, 0.0]]))
    assert (border * forward).sum(1) == pytest.approx(np.cos([0.2, 0.3]))


@pytest.mark.parametrize("lens", [PinholeCamera, WideAngleCamera])
def test_every_pixel_takes_the_colour_of_its_own_ray_to_a_fraction_of_a_pixel(lens: type[Camera]) -> None:
    # Red and green of the image are its u and v, so the crop's colours say which pixel they were taken from.
    rig = four_camera_rig((120, 160), focal=55.5)
    front = rig.cameras["front"]
    rig = Rig({"front": replace(front, camera=lens(front.camera.matrix, front.camera.size))})
    pixels = grid_pixels((120, 160), 1).reshape(160, 120, 2)
    image = np.zeros((160, 120, 3), dtype=np.uint8)
    image[:, :, :2] = np.rint(1.5 * pixels)
    crop = crop_towards(np.array([1.0, 0.15, -0.3]), 0.5, 80, rig)
    picture, valid = crop.sample({"front": image})
    assert valid.all()
    expected = 1.5 * rig.cameras["front"].pixels_of_directions(rays_of(crop)).reshape(80, 80, 2)
    difference = picture[0, :, :, :2] - expected
    assert np.abs(difference).max() < 1.5  # rounding twice, on a value of 1.5 a pixel
    assert np.abs(difference.mean(axis=(0, 1))).max() < 0.1  # half a pixel would be 0.75


def test_a_ball_across_two_cameras_is_seen_whole_and_its_range_closes_the_seam() -> None:
    centre = np.array([1.5, 1.6, 0.2])
    images = {name: picture_of_ball(camera, centre, 0.4) for name, camera in RIG.cameras.items()}
    crop = crop_towards(centre, 0.3, 96)
    main = list(RIG.cameras)[crop.main[0]]
    expected = sees_ball(crop.centres[0], rays_of(crop), centre, 0.4).reshape(96, 96)
    _, in_main = crop.sample({main: images[main]})
    assert 0.2 < (expected & ~in_main[0]).sum() / expected.sum() < 0.8  # the main camera has only a part of it
    with_range, valid = crop.sample(images, np.linalg.norm(centre - crop.centres, axis=1))
    without, _ = crop.sample(images)
    assert valid.all()
    assert overlap(with_range[0], expected) > 0.95
    assert overlap(without[0], expected) < 0.93  # 0.14 m between the cameras at 2.2 m: some 10 px of 96


def test_what_no_camera_sees_is_grey_and_marked() -> None:
    white = {name: np.full((640, 480, 3), 255, dtype=np.uint8) for name in RIG.cameras}
    crop = crop_towards(np.array([1.0, 0.0, 1.3]), 0.2, 64)  # 52 degrees down; the view ends at 55
    picture, valid = crop.sample(white)
    assert valid[0, :32].all()
    assert not valid[0, -16:].any()
    assert (picture[~valid] == 128).all()
    assert (picture[valid] == 255).all()
    nothing, none_valid = crop.sample({"back": white["back"]})
    assert not none_valid.any()
    assert (nothing == 128).all()


def test_crops_drawn_at_once_are_those_drawn_one_by_one() -> None:
    """Small and large, whole and across the seam: each as fine as it would be alone."""
    rng = np.random.default_rng(3)
    images = {name: rng.integers(0, 255, (640, 480, 3), dtype=np.uint8) for name in RIG.cameras}
    directions = np.array([[1.0, 0.1, 0.0], [1.0, 1.0, 0.2], [-1.0, 0.2, 0.1], [1.0, 0.0, 1.3], [1.0, 0.9, 0.0]])
    half_angles, ranges = np.array([0.05, 0.4, 0.9, 0.2, 0.3]), np.array([np.nan, 2.0, 5.0, np.nan, np.nan])
    pictures, _ = virtual_crops(RIG, directions, half_angles, 48).sample(images, ranges)
    for number in range(5):
        alone, _ = crop_towards(directions[number], half_angles[number], 48).sample(images, ranges[[number]])
        assert np.array_equal(pictures[number], alone[0])
