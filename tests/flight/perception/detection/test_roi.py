"""Regions of interest: how wide, and which are alike."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.flight.geometry import Rig, RigCamera, WideAngleCamera
from flockd.flight.perception import Instance
from flockd.flight.perception.detection.roi import Roi, angle_between, roi_of_instance, take_crop
from tests.flight.perception.shipped import SECOND_STAGE
from tests.make import rig_camera

RULES = SECOND_STAGE.rules
CAMERA = rig_camera(320.0, (640, 480))


def test_of_a_drone_that_the_images_border_cuts_a_wider_region_is_taken() -> None:
    def half_angle(left: float) -> float:
        box = np.array([left, 220.0, left + 60.0, 260.0])
        roi = roi_of_instance(CAMERA, Instance(1, np.array([left + 30.0, 240.0]), box, 900.0), RULES)
        assert roi is not None
        return roi.half_angle

    assert half_angle(0.0) > 1.3 * half_angle(10.0)
    assert half_angle(640 - 60.0) > 1.3 * half_angle(640 - 70.0)
    assert half_angle(2.0) < 1.1 * half_angle(10.0), "the first stage's maps have two image pixels a pixel"


def test_where_a_lens_images_nothing_the_rest_of_a_box_counts() -> None:
    """A lens of 60 degrees in a circle of 160 px radius; a corner of the box lies outside it, or all of it does."""
    matrix = np.array([[160.0 / (math.pi / 3), 0.0, 320.0], [0.0, 160.0 / (math.pi / 3), 240.0], [0.0, 0.0, 1.0]])
    lens = WideAngleCamera(matrix, (640, 480), (-1.0 / (3.0 * (math.pi / 3) ** 2), 0.0, 0.0, 0.0))
    camera = RigCamera("front", lens, CAMERA.T_body_camera)
    radius = 160.0 * (1.0 - 1.0 / 3.0)  # where the polynomial turns
    assert np.isnan(lens.rays(np.array([[320.0 + 1.01 * radius, 240.0]]))).all()

    def roi(left: float, top: float) -> Roi | None:
        box = np.array([left, top, left + 40.0, top + 40.0])
        return roi_of_instance(camera, Instance(1, box[:2] + 20.0, box, 900.0), RULES)

    partly = roi(320.0 + 50.0, 240.0 + 50.0)
    assert partly is not None
    assert math.isfinite(partly.half_angle)
    assert np.isfinite(partly.direction).all()
    assert roi(600.0, 440.0) is None


def test_a_region_suits_a_drones_size_and_stays_near_the_last_one() -> None:
    assert RULES.half_angle(0.5, 4.0, 0.003) == pytest.approx(math.atan(0.68 * 0.125))
    assert RULES.half_angle(0.5, 4.0, 0.003, before=0.4) == pytest.approx(0.4 / 1.7)
    assert RULES.half_angle(0.5, 400.0, 0.003) == pytest.approx(0.012), "4 px of the image"
    assert RULES.half_angle(50.0, 1.0, 0.003) == pytest.approx(math.radians(35.0))


@pytest.mark.parametrize("fov_deg", [25.0, 40.0, 60.0, 90.0])
def test_the_crop_of_a_small_drone_shows_the_same_pixels_whatever_the_lens_is_said_to_be(fov_deg: float) -> None:
    """A drone 8 px wide; before the crop was at least 2 degrees wide, 32 px of a lens of 40 degrees."""
    camera = rig_camera(320.0 / math.tan(math.radians(fov_deg / 2)), (640, 480))
    drone = Instance(1, np.array([320.0, 240.0]), np.array([316.0, 237.0, 324.0, 243.0]), 40.0)
    roi = roi_of_instance(camera, drone, RULES)
    assert roi is not None
    assert math.tan(roi.half_angle) * camera.camera.focal_px == pytest.approx(0.95 * math.hypot(4, 3), rel=0.001)


@pytest.mark.parametrize(
    ("moved", "factor", "alike"), [(0.0, 1.0, True), (0.004, 1.0, False), (0.002, 1.04, True), (0.0, 1.06, False)]
)
def test_a_crop_would_repeat_when_it_is_hardly_moved_or_resized(moved: float, factor: float, alike: bool) -> None:
    ahead = Roi(np.array([0.0, 0.0, 1.0]), 0.1)
    further = Roi(np.array([math.sin(moved), 0.0, math.cos(moved)]), 0.1 * factor)
    assert ahead.resembles(further, shift=0.03, resize=1.05) is alike


def test_a_crop_shows_what_lies_in_its_direction() -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    image[230:250, 470:490] = 255  # 160 px right of the centre: half a focal length
    direction = np.array([0.5, 0.0, 1.0]) / math.hypot(0.5, 1.0)
    crop, view = take_crop(Rig({"front": CAMERA}), {"front": image}, Roi(direction, 0.1), 96)
    assert crop.image.shape == (96, 96, 3)
    assert angle_between(view.T_body_virtual.rotation[:, 2], direction) < 1e-9
    assert crop.image[48, 48].min() == 255
    assert crop.image[5, 5].max() == 0
    assert crop.camera.focal_px == pytest.approx(48 / math.tan(0.1))
