"""The background's flow made exact, also where the images do not tell it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.perception.flow import grid_flow

HEIGHT, WIDTH = 320, 400
MOVED = (6.0, -4.0)
SKY = np.s_[36:84, 66:174]
"""The inner part: at its border one sees how it moves."""
GROUND = np.s_[120:300, 20:380]


def images(seed: int = 0) -> tuple[UInt8Array, UInt8Array]:
    """A plain piece of sky in the midst of texture, all of it moved by so much."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(20, 235, (60, 75, 3), np.uint8)
    large = np.asarray(cv2.resize(coarse, (WIDTH + 80, HEIGHT + 80), interpolation=cv2.INTER_CUBIC), np.uint8)
    large[50:150, 80:240] = (130, 160, 210)
    top, left = 40, 40
    right, down = (int(step) for step in MOVED)
    second = large[top - down : top - down + HEIGHT, left - right : left - right + WIDTH]
    return large[top : top + HEIGHT, left : left + WIDTH].copy(), second.copy()


def told(sky: tuple[float, float]) -> Float32Array:
    """Right where there is texture, something else in the sky."""
    flow = np.full((HEIGHT, WIDTH, 2), MOVED, np.float32)
    flow[SKY] = sky
    return flow


def off(flow: Float32Array, where: tuple[slice, ...] | slice) -> float:
    return float(np.median(np.linalg.norm(flow[where] - np.array(MOVED), axis=-1)))


NO_DRONES = np.zeros((HEIGHT, WIDTH), np.uint8)


def test_a_plain_sky_moves_as_its_surroundings_say() -> None:
    first, second = images()
    settled = grid_flow(told((-9.0, 15.0)), first, second, NO_DRONES)
    assert off(settled, SKY) < 0.3
    assert off(settled, GROUND) < 0.01


def test_it_makes_a_flow_exact_that_is_some_pixels_off() -> None:
    first, second = images()
    rough = told(MOVED) + np.array([5.0, -6.0], np.float32)
    assert off(rough, GROUND) > 7.0
    assert off(grid_flow(rough, first, second, NO_DRONES), GROUND) < 0.1


def test_a_thin_trunk_before_the_ground_keeps_its_own_flow_that_nothing_told() -> None:
    """One column of points has it, and all points around them move otherwise."""
    first, second = images()
    rng = np.random.default_rng(5)
    trunk = np.asarray(cv2.resize(rng.integers(0, 90, (50, 4, 3), np.uint8), (16, 200), interpolation=cv2.INTER_CUBIC))
    first[100:300, 192:208] = trunk
    second[96:296, 218:234] = trunk
    settled = grid_flow(told(MOVED), first, second, NO_DRONES)
    assert np.abs(np.median(settled[130:270, 199:201], axis=(0, 1)) - [26.0, -4.0]).max() < 1.0
    assert off(settled, np.s_[120:300, 20:170]) < 0.05


def test_beside_a_drone_the_background_does_not_move_with_it() -> None:
    first, second = images()
    flow, labels = told(MOVED), NO_DRONES.copy()
    labels[200:230, 180:220] = 1
    flow[190:240, 170:230] = (25.0, 20.0)  # as flow does: the drone's own leaks out
    beside = np.zeros((HEIGHT, WIDTH), np.bool_)
    beside[190:240, 170:230] = True
    beside &= labels == 0
    settled = grid_flow(flow, first, second, labels)
    assert np.median(np.linalg.norm(settled[beside] - MOVED, axis=1)) < 0.5
    assert (settled[labels == 1] == flow[labels == 1]).all()


@pytest.mark.parametrize("size", [(480, 640), (120, 161), (37, 50), (12, 9), (1, 2)])
def test_images_of_any_size_have_a_flow_of_theirs(size: tuple[int, int]) -> None:
    image = np.random.default_rng(4).integers(0, 256, (*size, 3), np.uint8)
    found = grid_flow(np.zeros((*size, 2), np.float32), image, image, np.zeros(size, np.uint8))
    assert found.shape == (*size, 2)
    assert np.abs(found).max() < 0.1


@pytest.mark.parametrize("of", [(0.0, 0.0), (7.0, 3.0)])
def test_where_nothing_is_to_be_seen_the_flow_stays_about_the_same(of: tuple[float, float]) -> None:
    empty = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    flow = np.full((HEIGHT, WIDTH, 2), of, np.float32)
    np.testing.assert_allclose(grid_flow(flow, empty, empty, NO_DRONES), flow, atol=0.01)
