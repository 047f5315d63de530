"""A lens that is covered, dirty, fogged or in the sun is told by the ground that it showed before; a turn is none."""

from __future__ import annotations

import functools
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from flockd.core.config import load_drone
from flockd.core.config.perception import NoiseParameters
from flockd.core.data import data_path
from flockd.core.messages import FloatArray, UInt8Array
from flockd.flight.geometry import build_rig, rotation_from_euler
from flockd.flight.perception.lens import LensMonitor
from tests.flight.perception.test_image_noise import scene

pytestmark = pytest.mark.fault("lens-covered")

RIG = build_rig(load_drone(data_path("config") / "quadrotor.yaml").rig)
CAMERAS = tuple(RIG.cameras)
FIRST, *OTHERS = CAMERAS
SIZE = RIG.cameras[FIRST].camera.size
STEP_S = 0.5
LEVEL = np.eye(3)
Spoil = Callable[[UInt8Array], UInt8Array]


@functools.cache
def texture(number: int) -> UInt8Array:
    return scene(1.0, 25.0, seed=number, size=(SIZE[1], SIZE[0]))


def ground(number: int) -> UInt8Array:
    """Sky above, ground of photographs' spectrum below, other ground in each image of a camera in turn."""
    image = np.roll(texture(number % 9), 37 * number, axis=1)
    image[: SIZE[1] // 2] = 190
    return image


def as_it_is(image: UInt8Array) -> UInt8Array:
    return image


def covered(image: UInt8Array) -> UInt8Array:
    """By a leaf: nearly one colour."""
    return np.full_like(image, 60)


def fogged(image: UInt8Array) -> UInt8Array:
    """Droplets: a blur, and a veil that leaves a fifth of the contrast."""
    soft = cv2.GaussianBlur(image, (0, 0), 3.0)
    return np.asarray(np.clip(0.2 * soft + 0.8 * 180, 0, 255), np.uint8)


def dirty(image: UInt8Array) -> UInt8Array:
    """Grease: a strong blur, at full contrast."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 4.0), np.uint8)


def in_the_sun(image: UInt8Array) -> UInt8Array:
    """Stray light: a quarter of the contrast is left, near white."""
    return np.asarray(np.clip(0.25 * image.astype(np.float32) + 215.0, 0, 255), np.uint8)


def in_dusk(image: UInt8Array) -> UInt8Array:
    return np.asarray(0.2 * image, np.uint8)


class Drone:
    """Four cameras, a step apart, over ground that changes with each image."""

    def __init__(self, parameters: NoiseParameters | None = None) -> None:
        self._monitor = LensMonitor(RIG.cameras, parameters or NoiseParameters())
        self._number, self._time_s = 0, 100.0

    def flies(
        self, steps: int, spoil: Spoil = as_it_is, others: Spoil = as_it_is, R_ned_body: FloatArray = LEVEL
    ) -> list[bool]:
        """Whether the first camera is not used, step by step; no other ever is."""
        found = []
        for _ in range(steps):
            self._time_s += STEP_S
            images = {}
            for name in CAMERAS:
                self._number += 1
                images[name] = (spoil if name == FIRST else others)(ground(self._number))
            faults = self._monitor.bad(images, self._time_s, R_ned_body)
            assert not set(faults) & set(OTHERS), faults
            found.append(FIRST in faults)
        return found


@pytest.mark.parametrize("spoil", [covered, fogged, dirty, in_the_sun])
def test_what_takes_contrast_or_sharpness_from_one_camera_makes_it_blind_until_it_is_clear(spoil: Spoil) -> None:
    """After two seconds, and as long until it counts again."""
    drone = Drone()
    assert drone.flies(10) == [False] * 10
    assert drone.flies(12, spoil) == [False] * 4 + [True] * 8
    assert drone.flies(12) == [True] * 4 + [False] * 8


@pytest.mark.parametrize("spoil", [in_dusk, fogged, dirty])
def test_what_all_cameras_see_is_no_lens(spoil: Spoil) -> None:
    """Dusk, mist, and ground without texture."""
    drone = Drone()
    drone.flies(10)
    assert not any(drone.flies(20, spoil, others=spoil))


def test_a_camera_that_looks_at_the_sky_is_not_judged() -> None:
    """The drone leans by 70 degrees: the first camera, which looks ahead, sees the sky alone."""
    drone = Drone()
    drone.flies(10)
    up = rotation_from_euler(0.0, np.deg2rad(70.0), 0.0)
    assert not any(drone.flies(10, covered, R_ned_body=up))


def test_what_was_there_from_the_start_is_the_cameras_own_and_the_check_can_be_left_out() -> None:
    assert not any(Drone().flies(20, fogged))
    drone = Drone(NoiseParameters(min_clarity=0.0))
    drone.flies(10)
    assert not any(drone.flies(20, covered))
