"""Cameras that do not move as the autopilot says, and those that show nothing, or show it badly."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from flockd.flight.geometry import PointPairs, RigidTransform, moved_pixels, rotation_from_euler
from flockd.flight.pilot.camera_agreement import CameraAgreement
from tests.flight.geometry.wrong_rigs import AS_CONFIGURED, CONFIGURED, STEP_S, STRAIGHT, Way, Wrong, lively, looks

pytestmark = pytest.mark.fault("camera-elsewhere")

UPSIDE_DOWN, OTHER_SIDE, ON_ITS_SIDE = (math.pi, 0.0, 0.0), (0.0, 0.0, math.pi), (0.0, -math.pi / 2, 0.0)
"""Rotation vectors in body axes; of the left camera the last."""
LIVELY = lively(np.random.default_rng(3))
CIRCLE = Way(lambda t: rotation_from_euler(0.0, 0.0, 0.1 * t), lively(np.random.default_rng(0)).position)
Seen = Callable[[PointPairs, np.random.Generator], PointPairs]


def flown_without(
    wrong: Wrong, way: Way, steps: int = 16, said: Way | None = None, seen: Seen = lambda pairs, _: pairs
) -> tuple[str, ...]:
    random, agreement = np.random.default_rng(3), CameraAgreement(CONFIGURED)
    for before, after, pairs in looks(way, wrong, random, steps, said=said):
        agreement.see(before, after, STEP_S, seen(pairs, random))
    return agreement.elsewhere()


@pytest.mark.parametrize(
    ("turned", "way", "named"),
    [
        ({}, LIVELY, ()),
        ({"front": (math.radians(20.0), 0.0, 0.0)}, LIVELY, ()),
        ({"front": UPSIDE_DOWN}, LIVELY, ("front",)),
        ({"left": ON_ITS_SIDE}, LIVELY, ("left",)),
        ({"front": OTHER_SIDE, "back": OTHER_SIDE}, CIRCLE, ("front", "back")),
        (dict.fromkeys(("front", "left", "back"), UPSIDE_DOWN), CIRCLE, ()),
    ],
    ids=["as configured", "20 degrees off", "upside down", "on its side", "two swapped", "most contradict"],
)
def test_a_camera_that_moves_otherwise_is_flown_without(
    turned: Mapping[str, tuple[float, ...]], way: Way, named: tuple[str, ...]
) -> None:
    assert flown_without(Wrong.turned(turned), way) == named


def test_four_seconds_are_needed() -> None:
    wrong = Wrong.turned({"front": UPSIDE_DOWN})
    assert flown_without(wrong, CIRCLE, steps=8) == ()
    assert flown_without(wrong, CIRCLE, steps=9) == ("front",)


def of_front(change: Callable[[PointPairs, np.random.Generator], PointPairs]) -> Seen:
    def seen(pairs: PointPairs, random: np.random.Generator) -> PointPairs:
        front = pairs.camera_names == "front"
        return PointPairs.concatenate([pairs[~front], change(pairs[front], random)])

    return seen


def moved_at_random(pairs: PointPairs, random: np.random.Generator) -> PointPairs:
    return replace(pairs, pixels_current=pairs.pixels_previous + random.normal(0.0, 20.0, (len(pairs), 2)))


def beside_a_mate(pairs: PointPairs, random: np.random.Generator) -> PointPairs:
    """That fills the image, and flies alongside."""
    return replace(pairs, pixels_current=pairs.pixels_previous + random.normal(0.0, 0.5, (len(pairs), 2)))


def before_a_wall(pairs: PointPairs, random: np.random.Generator) -> PointPairs:
    """A metre away, that is taken to be four times as far."""
    camera = CONFIGURED.cameras["front"]
    near, far = (
        camera.T_body_camera.apply(camera.camera.unproject(pairs.pixels_previous, np.full(len(pairs), range_m)))
        for range_m in (1.0, 4.0)
    )
    current = moved_pixels(camera, near, RigidTransform(np.eye(3), np.array([STEP_S, 0.0, 0.0])))
    return replace(pairs, previous=far, pixels_current=current)[camera.camera.in_image(current)]


@pytest.mark.parametrize(
    ("seen", "way"),
    [
        (moved_at_random, CIRCLE),
        (beside_a_mate, CIRCLE),
        (before_a_wall, STRAIGHT),
        (lambda pairs, _: pairs[np.arange(10)], CIRCLE),
    ],
    ids=["wrong flow", "a mate", "a wall", "sky"],
)
def test_what_shows_nothing_or_is_near_is_no_other_camera(seen: Seen, way: Way) -> None:
    assert flown_without(AS_CONFIGURED, way, 20, seen=of_front(seen)) == ()
