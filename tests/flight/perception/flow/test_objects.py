"""A drone that moves otherwise than all behind it is followed by itself."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flockd.core.messages import UNCLASSED, Float32Array, FloatArray, UInt8Array
from flockd.flight.perception.flow import object_flow

HEIGHT, WIDTH = 320, 400
BEHIND = (3.0, -2.0)


def pattern(seed: int, cell_px: float) -> UInt8Array:
    """A blurred random picture, with pixels of noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(20, 235, (int(HEIGHT / cell_px) + 2, int(WIDTH / cell_px) + 2, 3), np.uint8)
    smooth = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).astype(np.float64)
    return np.clip(smooth + rng.normal(0, 2, smooth.shape), 0, 255).astype(np.uint8)


def moved(image: UInt8Array, motion: FloatArray) -> UInt8Array:
    return np.asarray(cv2.warpAffine(image, motion, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC), np.uint8)


def motion(shift: tuple[float, float], turn_deg: float, zoom: float, middle: tuple[float, float]) -> FloatArray:
    """(2, 3) of the drone about its middle."""
    affine = np.asarray(cv2.getRotationMatrix2D(middle, turn_deg, zoom), np.float64)
    affine[:, 2] += shift
    return affine


class Scene:
    """A cross with a hole before a pattern; each moves its own way, and what is known is the background's flow."""

    def __init__(self, affine: FloatArray, middle: tuple[int, int] = (200, 160)) -> None:
        u, v = middle
        self.mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.line(self.mask, (u - 28, v - 16), (u + 28, v + 16), 1, 9)
        cv2.line(self.mask, (u - 28, v + 16), (u + 28, v - 16), 1, 9)
        cv2.circle(self.mask, (u, v), 5, 0, -1)
        drone, behind = pattern(2, 7.0), pattern(1, 30.0)
        shift = np.array([[1.0, 0.0, BEHIND[0]], [0.0, 1.0, BEHIND[1]]])
        self.first = np.where(self.mask[..., None] > 0, drone, behind)
        there = moved(self.mask * np.uint8(255), affine)[..., None] > 127
        self.second = np.where(there, moved(drone, affine), moved(behind, shift))
        self.flow = np.full((HEIGHT, WIDTH, 2), BEHIND, np.float32)
        rows, columns = np.nonzero(self.mask)
        places = np.stack([columns, rows, np.ones_like(rows)], 1)
        self.true = places @ affine.T - places[:, :2]

    def off(self, found: Float32Array) -> FloatArray:
        """End-point errors on the drone."""
        return np.asarray(np.linalg.norm(found[self.mask > 0] - self.true, axis=1))


@pytest.mark.parametrize(
    ("shift", "turn_deg", "zoom"),
    [((5.0, -3.5), 0.0, 1.0), ((30.3, 12.6), 0.0, 1.0), ((-61.0, 24.0), 8.0, 1.1), ((-20.0, -55.0), -10.0, 0.9)],
)
def test_a_drone_is_followed_far_from_where_its_background_went(
    shift: tuple[float, float], turn_deg: float, zoom: float
) -> None:
    scene = Scene(motion(shift, turn_deg, zoom, (200, 160)))
    found = object_flow(scene.flow, scene.first, scene.second, scene.mask)
    assert np.median(scene.off(found)) < 0.15
    assert np.quantile(scene.off(found), 0.9) < 0.5
    assert (found[scene.mask == 0] == scene.flow[scene.mask == 0]).all(), "the background is not its business"


def test_a_drone_that_has_grown_brighter_is_followed_too() -> None:
    scene = Scene(motion((25.0, -14.0), 4.0, 1.05, (200, 160)))
    brighter = np.clip(scene.second * 1.15 + 12.0, 0, 255).astype(np.uint8)
    assert np.median(scene.off(object_flow(scene.flow, scene.first, brighter, scene.mask))) < 0.2


def test_a_drone_that_half_leaves_the_image_is_followed() -> None:
    scene = Scene(motion((-36.0, 0.0), 0.0, 1.0, (40, 160)), (40, 160))
    found = object_flow(scene.flow, scene.first, scene.second, scene.mask)
    stays = scene.true[:, 0] + np.nonzero(scene.mask)[1] > 2
    assert np.median(scene.off(found)[stays]) < 0.6


def test_two_drones_are_separated() -> None:
    near = Scene(motion((18.0, 5.0), 0.0, 1.0, (120, 160)), (120, 160))
    far = Scene(motion((-14.0, 9.0), 0.0, 1.0, (290, 150)), (290, 150))
    labels = near.mask + 2 * far.mask
    first = np.where(far.mask[..., None] > 0, far.first, near.first)
    changed = (far.second != Scene(np.array([[1.0, 0.0, 1e4], [0.0, 1.0, 0.0]]), (290, 150)).second).any(2)
    second = np.where(changed[..., None], far.second, near.second)
    found = object_flow(near.flow, first, second, labels)
    assert np.median(near.off(found)) < 0.15
    assert np.median(far.off(found)) < 0.15


@pytest.mark.parametrize("why", ["gone", "too small", "not to be used", "nothing to see"])
def test_what_cannot_be_followed_keeps_its_flow(why: str) -> None:
    scene = Scene(motion((30.0, 12.0), 0.0, 1.0, (200, 160)))
    first, second, labels = scene.first, scene.second, scene.mask
    if why == "gone":
        second = moved(pattern(1, 30.0), np.array([[1.0, 0.0, BEHIND[0]], [0.0, 1.0, BEHIND[1]]]))
    elif why == "too small":
        labels = np.zeros_like(scene.mask)
        labels[160, 195:205] = 1
    elif why == "not to be used":
        labels = scene.mask * np.uint8(UNCLASSED)
    else:
        first = second = np.full_like(scene.first, 90)
    assert (object_flow(scene.flow, first, second, labels) == scene.flow).all()


def test_a_drone_of_stripes_is_followed_across_them() -> None:
    first = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    first[140:180, 180:220] = 6 * np.arange(40, dtype=np.uint8)[:, None, None]
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    labels[140:180, 180:220] = 1
    flow = object_flow(np.zeros((HEIGHT, WIDTH, 2), np.float32), first, np.roll(first, 3, axis=0), labels)
    assert np.median(flow[145:175, 185:215, 1]) == pytest.approx(3.0, abs=0.05)
    assert np.isfinite(flow).all()
