"""Where a camera turns so far that flow loses its way, one shift of the whole image is a start."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flockd.core.messages import UInt8Array
from flockd.flight.perception import DisFlow
from flockd.flight.perception.flow.cross_correlation import flow_correlation, global_translation
from tests.flight.perception.conftest import WrongFlow, grey


def windows(right: int, down: int) -> tuple[UInt8Array, UInt8Array]:
    """Two windows of one blurred random picture: all of the first has moved by so much in the second."""
    coarse = np.random.default_rng(3).integers(0, 255, (60, 80, 3), np.uint8)
    large = np.asarray(cv2.resize(coarse, (1600, 1200), interpolation=cv2.INTER_CUBIC), np.uint8)
    top, left = 420, 480
    first = large[top : top + 360, left : left + 540]
    second = large[top - down : top - down + 360, left - right : left - right + 540]
    return np.ascontiguousarray(first), np.ascontiguousarray(second)


@pytest.mark.parametrize("true", [(0, 0), (232, -40), (-248, 64), (16, 160)])
def test_the_shift_of_a_whole_image_is_found_to_a_small_pixel(true: tuple[int, int]) -> None:
    first, second = windows(*true)
    found = global_translation(grey(first), grey(second))
    assert np.abs(np.array(found) - true).max() <= 8.0


def test_a_flow_is_likely_where_it_leads_to_the_same() -> None:
    first, second = (grey(image) for image in windows(64, -32))
    right = np.full((360, 540, 2), (64.0, -32.0), np.float32)
    assert flow_correlation(first, second, right) > 0.98
    assert flow_correlation(first, second, -right) < 0.3
    assert flow_correlation(first, second, np.full_like(right, 2000.0)) == 0.0


def test_dis_finds_a_large_turn_although_the_network_went_astray() -> None:
    first, second = windows(-240, 30)
    flow = DisFlow(WrongFlow()).flow(first, second)
    inside = np.s_[20:-60, 270:-20]
    assert np.abs(np.median(flow[inside], axis=(0, 1)) - [-240.0, 30.0]).max() < 0.2
