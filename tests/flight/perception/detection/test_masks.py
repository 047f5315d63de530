"""Pixels belong to the drone that both stages say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.messages import UNCLASSED, BoolArray, Detection, Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry import RangeMap, Rig, RigCamera, build_rig, virtual_crop
from flockd.flight.perception.detection.colour_model import reweight_by_colour
from flockd.flight.perception.detection.masks import CropMask, DroneMasks, MaskRenderer, depth_of_drones
from tests import make

SIZE = 96
RIG: Rig = build_rig(make.scenario().drone.rig)
FRONT: RigCamera = RIG.cameras["front"]
WIDTH, HEIGHT = FRONT.camera.size
PLAIN = np.zeros((HEIGHT // 2, WIDTH // 2), np.float32)
NOTHING = np.zeros((HEIGHT, WIDTH), np.uint8)
GREY = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
AHEAD = np.array([4.0, 0.3, 0.2])
RADIUS = 0.06
"""Radius of a drone's disc, radians."""
COLOUR_WEIGHT = 4.0


def detection(label: int, position: FloatArray, *cameras: str) -> Detection:
    sigma = 0.1 / float(np.linalg.norm(position))
    return make.detection(position, sigma, 0.004, cameras=cameras or ("front",), label=label)


def drawn(
    *seen: tuple[Detection, list[CropMask]], labels: UInt8Array = NOTHING, logit: Float32Array = PLAIN
) -> DroneMasks:
    """Of these detections, each with the masks of its crops."""
    masks = {one.label: of for one, of in seen}
    return MaskRenderer(FRONT, 2).render(labels, logit, [one for one, _ in seen], masks)


def mask_of(position: FloatArray, half_angle: float, *, radius: float = RADIUS, height: float = 5.0) -> CropMask:
    """A disc about a place: so high inside, a little lower than that outside, for no pixel between both to be at 0."""
    crop = virtual_crop(RIG, position, half_angle, SIZE)
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    reach = crop.camera.focal_px * math.tan(radius)
    inside = np.hypot(u - SIZE / 2, v - SIZE / 2) < reach
    return CropMask(crop, np.where(inside, height, -1.1 * height).astype(np.float32), half_angle)


def disc(position: FloatArray, radius: float = RADIUS) -> BoolArray:
    """The image's pixels that look so nearly that way."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = FRONT.camera.rays(np.stack([u.ravel(), v.ravel()], 1)) @ FRONT.T_body_camera.rotation.T
    return np.asarray((rays @ (position / np.linalg.norm(position)) > math.cos(radius)).reshape(HEIGHT, WIDTH))


def overlap(one: BoolArray, other: BoolArray) -> float:
    return float((one & other).sum() / (one | other).sum())


@pytest.mark.parametrize("half_angle", [0.1, 0.2])
def test_the_second_stage_draws_what_the_first_only_boxed(half_angle: float) -> None:
    true = disc(AHEAD)
    rows, columns = np.nonzero(true)
    labels = NOTHING.copy()
    labels[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = 3
    found = drawn((detection(3, AHEAD), [mask_of(AHEAD, half_angle)]), labels=labels).by_networks()
    assert overlap(found == 3, true) > 0.95
    corners = labels.astype(bool) & ~true
    assert np.mean(found[corners] == UNCLASSED) > 0.9, "what one stage took for a drone is not background yet"
    assert (found[(labels == 0) & (found != 3)] == 0).all()


def test_both_stages_count_and_all_images() -> None:
    left, true = np.zeros((HEIGHT // 2, WIDTH // 2), np.float32), disc(AHEAD)
    u = int(np.nonzero(true)[1].mean())
    left[:, : u // 2] = -7.0  # outweighs 5, not 5 and 15 by their mean
    one, another = mask_of(AHEAD, 0.2), mask_of(AHEAD, 0.15, height=15.0)
    for masks, expected in (([one], true & (np.arange(WIDTH) >= u)), ([one, another], true)):
        found = drawn((detection(1, AHEAD), masks), logit=left).by_networks()
        assert overlap(found == 1, expected) > 0.9


def test_a_pixel_that_two_drones_claim_is_the_surer_ones() -> None:
    beside = AHEAD + np.array([0.0, 0.3, 0.0])  # their discs overlap
    both = (detection(1, AHEAD), [mask_of(AHEAD, 0.2)]), (detection(2, beside), [mask_of(beside, 0.2, height=9.0)])
    for order in (both, both[::-1]):
        found = drawn(*order).by_networks()
        assert overlap(found == 2, disc(beside)) > 0.9
        assert overlap(found == 1, disc(AHEAD) & ~disc(beside)) > 0.9


def test_a_detected_drone_stands_at_its_range_in_the_map_whichever_way_it_is() -> None:
    place = FRONT.T_body_camera.translation + 5.0 * np.array([math.cos(0.8), 0.0, math.sin(0.8)])
    column, row = FRONT.pixels_of_points(place[None])[0].astype(int)
    labels, flat = NOTHING.copy(), RangeMap(np.full((HEIGHT, WIDTH), 5.0, np.float32))
    labels[row - 3 : row + 4, column - 3 : column + 4] = 1
    moved = depth_of_drones(flat, labels, FRONT, [detection(1, place)])
    lifted = FRONT.camera.unproject(np.array([[column + 0.5, row + 0.5]]), moved[row, [column]].astype(np.float64))
    np.testing.assert_allclose(FRONT.T_body_camera.apply(lifted)[0], place, atol=0.02)


def painted(
    *discs: tuple[BoolArray, tuple[int, int, int]], background: tuple[int, int, int] = (90, 120, 60)
) -> UInt8Array:
    """An image of coloured discs, each pixel a little lighter or darker than it should be."""
    image = np.tile(np.array(background, np.float64), (HEIGHT, WIDTH, 1))
    for where, colour in discs:
        image[where] = colour
    return np.clip(image + np.random.default_rng(0).normal(0, 6, image.shape), 0, 255).astype(np.uint8)


def test_colours_refine_the_outline_that_networks_see_too_coarsely() -> None:
    true, aside = disc(AHEAD), AHEAD + np.array([0.0, 0.05, -0.03])  # a quarter of the disc's radius
    masks = drawn((detection(1, aside), [mask_of(aside, 0.2, height=3.0)]))
    assert overlap(masks.by_networks() == 1, true) < 0.8
    assert overlap(masks.by_colours(painted((true, (150, 60, 40))), COLOUR_WEIGHT) == 1, true) > 0.95
    assert (masks.by_colours(GREY, COLOUR_WEIGHT) == masks.by_networks()).all()


def test_what_both_stages_surely_deny_is_no_drones_whatever_its_colour() -> None:
    red, far = (150, 60, 40), AHEAD + np.array([0.0, 0.7, 0.0])
    image = painted((disc(AHEAD), red), (disc(far), red))
    found = drawn((detection(1, AHEAD), [mask_of(AHEAD, 0.2, height=8.0)])).by_colours(image, COLOUR_WEIGHT)
    assert overlap(found == 1, disc(AHEAD)) > 0.95
    assert not (found[disc(far)] == 1).any()


def test_what_has_about_the_drones_colours_becomes_the_drones_and_what_has_those_around_it_does_not() -> None:
    """Among 50 pixels of the drone and 50 around it."""
    own, around = (100, 100, 100), (200, 200, 200)
    logits = np.array([[-1.0, 0.0, 0.0, 0.0, 1.0, *[5.0] * 50, *[-5.0] * 50]], np.float32)
    colours = [own, (112, 100, 100), (100, 112, 100), (100, 100, 112), around, *[own] * 50, *[around] * 50]
    found = reweight_by_colour(logits, np.array([colours], np.uint8), COLOUR_WEIGHT)[0]
    assert found[:4].min() > 3.0, "a little more red, green or blue is still its colour"
    assert found[2:4] == pytest.approx(found[1], rel=0.05)
    assert found[4] < -3.0
