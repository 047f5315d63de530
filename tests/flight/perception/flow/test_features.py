"""Where the whole picture turns and grows so much that no flow finds its way, corners that look alike do."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.perception import DisFlow
from flockd.flight.perception.flow.features import feature_flow
from tests.flight.perception.conftest import WrongFlow, grey

HEIGHT, WIDTH = 360, 540


def pattern(seed: int, height: int = HEIGHT, width: int = WIDTH) -> UInt8Array:
    """Random spots of many sizes, RGB."""
    random = np.random.default_rng(seed)
    spots = np.zeros((height, width, 3), np.float32)
    for size in (4, 8, 16, 32, 64):
        coarse = random.normal(0, 1, (height // size + 2, width // size + 2, 3)).astype(np.float32)
        spots += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(128 + 25 * spots, 0, 255), np.uint8)


def moved(image: UInt8Array, motion: Float32Array) -> tuple[UInt8Array, Float32Array]:
    """The image after a motion of its plane (3, 3), and the true flow (h, w, 2) to there."""
    height, width = image.shape[:2]
    second = cv2.warpPerspective(image, motion, (width, height), borderMode=cv2.BORDER_REFLECT)
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    places = np.stack([u, v], 2)
    return np.asarray(second, np.uint8), np.asarray(cv2.perspectiveTransform(places, motion) - places, np.float32)


def turn(degrees: float, zoom: float, right: float, down: float) -> Float32Array:
    motion = np.eye(3)
    motion[:2] = cv2.getRotationMatrix2D((WIDTH / 2, HEIGHT / 2), degrees, zoom)
    motion[:2, 2] += right, down
    return motion.astype(np.float32)


def errors(flow: Float32Array, true: Float32Array) -> Float32Array:
    """End-point errors where the truth leads to the inside of the image."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    end = np.stack([u, v], 2) + true
    inside = ((end > 20) & (end < (WIDTH - 20, HEIGHT - 20))).all(2)
    return np.asarray(np.linalg.norm(flow - true, axis=2)[inside], np.float32)


@pytest.mark.parametrize(
    "motion", [turn(25, 1.3, 60, -30), turn(-15, 0.8, -150, 40), turn(0, 1.6, 0, 0), turn(0, 1, -240, 30)]
)
def test_landmarks_tell_a_turn_with_a_zoom(motion: Float32Array) -> None:
    first = pattern(1)
    second, true = moved(first, motion)
    found = feature_flow(grey(first), grey(second))
    assert found is not None
    off = errors(found, true)
    assert np.median(off) < 2.0
    assert np.quantile(off, 0.9) < 8.0


def test_what_stands_before_the_plane_moves_its_own_way() -> None:
    behind, before = pattern(1), pattern(2, 120, 160)
    first, second = behind.copy(), np.roll(behind, (0, -60), axis=(0, 1))
    first[120:240, 300:460] = before
    second[120:240, 170:330] = before  # 130 px to the left, where all else goes 60
    found = feature_flow(grey(first), grey(second))
    assert found is not None
    assert np.abs(np.median(found[150:210, 340:420], axis=(0, 1)) - [-130.0, 0.0]).max() < 6.0
    assert np.abs(np.median(found[:, 80:200], axis=(0, 1)) - [-60.0, 0.0]).max() < 3.0


def test_nothing_alike_gives_no_flow() -> None:
    assert feature_flow(grey(pattern(1)), grey(pattern(2))) is None
    empty = np.full((HEIGHT, WIDTH), 90, np.uint8)
    assert feature_flow(empty, grey(pattern(2))) is None
    assert feature_flow(empty, empty) is None


def test_dis_finds_a_large_turn_about_the_optical_axis_although_the_network_went_astray() -> None:
    first = pattern(1)
    second, true = moved(first, turn(25, 1.3, 60, -30))
    assert np.median(errors(DisFlow(WrongFlow()).flow(first, second), true)) < 2.0  # as near as DIS gets at such a zoom
