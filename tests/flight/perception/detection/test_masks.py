"""Pixels belong to the drone that both stages say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.data import data_path
from flockd.core.messages import UNCLASSED, BoolArray, Detection, Float32Array, FloatArray, UInt8Array
from flockd.flight.geometry import Rig, RigCamera, build_rig, virtual_crop
from flockd.flight.perception.detection.colour_model import reweight_by_colour
from flockd.flight.perception.detection.masks import CropMask, MaskRenderer
from flockd.sim.scenario import load_scenario
from tests import make

SIZE = 96
RIG: Rig = build_rig(load_scenario(data_path("config") / "paper_flight.yaml").drone.rig)
FRONT: RigCamera = RIG.cameras["front"]
WIDTH, HEIGHT = FRONT.camera.size
PLAIN = np.zeros((HEIGHT // 2, WIDTH // 2), np.float32)
GREY = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
AHEAD = np.array([4.0, 0.3, 0.2])
RADIUS = 0.06
"""Radius of a drone's disc, radians."""
COLOUR_WEIGHT = 4.0


def detection(label: int, position: FloatArray, *cameras: str) -> Detection:
    sigma = 0.1 / float(np.linalg.norm(position))
    return make.detection(position, sigma, 0.004, cameras=cameras or ("front",), label=label)


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
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    labels[box] = 3
    masks = {3: [mask_of(AHEAD, half_angle)]}
    drawn = MaskRenderer(FRONT, 2).render(labels, PLAIN, [detection(3, AHEAD)], masks).by_networks()
    assert overlap(drawn == 3, true) > 0.95
    corners = labels.astype(bool) & ~true
    assert np.mean(drawn[corners] == UNCLASSED) > 0.9, "what one stage took for a drone is not background yet"
    assert (drawn[(labels == 0) & (drawn != 3)] == 0).all()


def test_both_stages_count_and_all_images() -> None:
    left = np.zeros((HEIGHT // 2, WIDTH // 2), np.float32)
    u = int(np.nonzero(disc(AHEAD))[1].mean())
    left[:, : u // 2] = -7.0  # outweighs 5, not 5 and 15 by their mean
    renderer, true = MaskRenderer(FRONT, 2), disc(AHEAD)
    nothing = np.zeros((HEIGHT, WIDTH), np.uint8)
    one = renderer.render(nothing, left, [detection(1, AHEAD)], {1: [mask_of(AHEAD, 0.2)]}).by_networks() == 1
    assert overlap(one, true & (np.arange(WIDTH) >= u)) > 0.9
    several = [mask_of(AHEAD, 0.2), mask_of(AHEAD, 0.15, height=15.0)]
    assert overlap(renderer.render(nothing, left, [detection(1, AHEAD)], {1: several}).by_networks() == 1, true) > 0.9


def test_a_pixel_that_two_drones_claim_is_the_surer_ones() -> None:
    beside = AHEAD + np.array([0.0, 0.3, 0.0])  # their discs overlap
    masks = {1: [mask_of(AHEAD, 0.2)], 2: [mask_of(beside, 0.2, height=9.0)]}
    both = [detection(1, AHEAD), detection(2, beside)]
    for order in (both, both[::-1]):
        drawn = MaskRenderer(FRONT, 2).render(np.zeros((HEIGHT, WIDTH), np.uint8), PLAIN, order, masks).by_networks()
        assert overlap(drawn == 2, disc(beside)) > 0.9
        assert overlap(drawn == 1, disc(AHEAD) & ~disc(beside)) > 0.9


def test_where_the_second_stage_does_not_tell_the_labels_stay() -> None:
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    labels[300:320, 200:240] = 1
    renderer, mask = MaskRenderer(FRONT, 2), mask_of(AHEAD, 0.2)
    for seen, masks in ((detection(1, AHEAD), []), (detection(1, AHEAD, "left"), [mask])):
        assert (renderer.render(labels, PLAIN, [seen], {1: masks}).by_networks() == labels).all()
    behind = np.array([-4.0, 0.0, 0.0])
    drawn = renderer.render(labels, PLAIN, [detection(1, behind)], {1: [mask_of(behind, 0.2)]}).by_networks()
    assert (drawn == labels).all()


def test_what_lies_beyond_a_drones_crop_is_not_known_to_be_its_own() -> None:
    labels = disc(AHEAD, 0.3).astype(np.uint8)
    drawn = (
        MaskRenderer(FRONT, 2).render(labels, PLAIN, [detection(1, AHEAD)], {1: [mask_of(AHEAD, 0.1)]}).by_networks()
    )
    far: Float32Array = np.asarray(disc(AHEAD, 0.3) & ~disc(AHEAD, 0.16), np.float32)
    assert (drawn[far > 0] == UNCLASSED).all()
    assert (drawn == 1).any()
    assert overlap(drawn[disc(AHEAD, 0.09)] == 1, disc(AHEAD)[disc(AHEAD, 0.09)]) > 0.95


def painted(
    *discs: tuple[BoolArray, tuple[int, int, int]], background: tuple[int, int, int] = (90, 120, 60)
) -> UInt8Array:
    """An image of coloured discs, each pixel a little lighter or darker than it should be."""
    image = np.tile(np.array(background, np.float64), (HEIGHT, WIDTH, 1))
    for where, colour in discs:
        image[where] = colour
    return np.clip(image + np.random.default_rng(0).normal(0, 6, image.shape), 0, 255).astype(np.uint8)


def test_colours_refine_the_outline_that_networks_see_too_coarsely() -> None:
    true, nothing = disc(AHEAD), np.zeros((HEIGHT, WIDTH), np.uint8)
    aside = AHEAD + np.array([0.0, 0.05, -0.03])  # a quarter of the disc's radius
    coarse = {1: [mask_of(aside, 0.2, height=3.0)]}
    masks_drawn = MaskRenderer(FRONT, 2).render(nothing, PLAIN, [detection(1, aside)], coarse)
    assert overlap(masks_drawn.by_networks() == 1, true) < 0.8
    assert overlap(masks_drawn.by_colours(painted((true, (150, 60, 40))), COLOUR_WEIGHT) == 1, true) > 0.95
    assert (masks_drawn.by_colours(GREY, COLOUR_WEIGHT) == masks_drawn.by_networks()).all()


def test_a_camouflaged_drone_is_drawn_as_the_networks_see_it() -> None:
    nothing, masks = np.zeros((HEIGHT, WIDTH), np.uint8), {1: [mask_of(AHEAD, 0.2, height=3.0)]}
    masks_drawn = MaskRenderer(FRONT, 2).render(nothing, PLAIN, [detection(1, AHEAD)], masks)
    assert overlap(masks_drawn.by_colours(painted(), COLOUR_WEIGHT) == 1, disc(AHEAD)) > 0.9


def test_what_both_stages_surely_deny_is_no_drones_whatever_its_colour() -> None:
    red, far = (150, 60, 40), AHEAD + np.array([0.0, 0.7, 0.0])
    image = painted((disc(AHEAD), red), (disc(far), red))
    masks = {1: [mask_of(AHEAD, 0.2, height=8.0)]}
    nothing = np.zeros((HEIGHT, WIDTH), np.uint8)
    rendered = MaskRenderer(FRONT, 2).render(nothing, PLAIN, [detection(1, AHEAD)], masks)
    drawn = rendered.by_colours(image, COLOUR_WEIGHT)
    assert overlap(drawn == 1, disc(AHEAD)) > 0.95
    assert not (drawn[disc(far)] == 1).any()


# A pixel is a drone's where its colour is.


WEIGHT = 4.0
OWN, AROUND = (100, 100, 100), (200, 200, 200)


def reweighted(*pixels: tuple[float, tuple[int, int, int]]) -> list[float]:
    """What becomes of these, among 50 pixels of the drone and 200 around it."""
    everything = [*pixels, *[(5.0, OWN)] * 50, *[(-5.0, AROUND)] * 200]
    logits = np.array([[logit for logit, _ in everything]], np.float32)
    image = np.array([[colour for _, colour in everything]], np.uint8)
    return [float(value) for value in reweight_by_colour(logits, image, WEIGHT)[0, : len(pixels)]]


def test_what_has_the_drones_colours_becomes_the_drones_and_what_has_those_around_it_does_not() -> None:
    own, around = reweighted((-1.0, OWN), (1.0, AROUND))
    assert own > 3.0
    assert around < -3.0


def test_a_little_more_red_green_or_blue_is_still_the_drones_colour() -> None:
    red, green, blue = reweighted((0.0, (112, 100, 100)), (0.0, (100, 112, 100)), (0.0, (100, 100, 112)))
    assert red > 3.0
    assert [green, blue] == pytest.approx([red, red], rel=0.05)


def test_what_lies_far_from_a_drone_is_left_alone_and_counts_for_nothing() -> None:
    without = reweighted((0.5, (150, 150, 150)))
    far = [(-9.0, OWN)] * 300
    assert reweighted((0.5, (150, 150, 150)), *far) == pytest.approx([*without, *[-9.0] * 300])


def test_numbers_stay_finite_however_sure_the_networks_are() -> None:
    sure = reweight_by_colour(np.full((4, 4), 60.0, np.float32), np.zeros((4, 4, 3), np.uint8), WEIGHT)
    assert np.isfinite(sure).all()
    unsure = reweight_by_colour(np.full((4, 4), -60.0, np.float32), np.zeros((4, 4, 3), np.uint8), WEIGHT)
    assert (unsure == -60.0).all()
