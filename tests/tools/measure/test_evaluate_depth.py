"""The table of real depth says of a network what is wrong with it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tools.measure.evaluate_depth import DepthOf, measured
from tools.training.moving_cameras import Clip

HEIGHT, WIDTH = 288, 384


def saying(near: float) -> DepthOf:
    """A network that says the depth of a slope, and of what is near that it is so many times as far."""

    def depth_of(_: NDArray[np.uint8], planes: NDArray[np.float32]) -> NDArray[np.float32]:
        right = planes[0]  # tangents of the rays
        return np.asarray(np.where(right < np.quantile(right, 0.25), near, 1.0) * 7.0 * np.exp(2.0 * right), np.float32)

    return depth_of


@pytest.mark.parametrize(("near", "said"), [(1.0, 0.0), (1.5, 0.5)])
def test_what_is_near_and_said_to_be_far_is_in_its_column(near: float, said: float) -> None:
    right = np.broadcast_to((np.arange(WIDTH) + 0.5 - WIDTH / 2) / 300.0, (HEIGHT, WIDTH))
    depth = np.exp(2.0 * right)[None].astype(np.float16)
    depth[0, :40] = np.nan
    clip = Clip(np.zeros((1, HEIGHT, WIDTH, 3), np.uint8), depth, 300.0)
    row = measured(saying(near), clip)
    assert row.near == pytest.approx(said, abs=0.02)
    assert row.far == pytest.approx(0.0, abs=0.02)
    assert row.off == pytest.approx(0.0, abs=0.02), "of most pixels, up to the scale"
    assert np.isnan(row.off_told_height), "a slope to the side is no ground"


@pytest.mark.parametrize(("factor", "off"), [(1.0, 0.0), (2.0, 1.0)])
def test_who_is_told_the_height_is_judged_in_metres_of_what_stands_there(factor: float, off: float) -> None:
    """A post before flat ground under a level camera, 1.5 m away where the camera is 2 m above the ground."""
    row = np.arange(HEIGHT) + 0.5 - HEIGHT / 2
    depth = np.broadcast_to((0.7 * 300.0 / np.maximum(row, 20.0))[:, None], (HEIGHT, WIDTH)).copy()
    depth[row < 30] = np.nan
    depth[60:200, 170:210] = 1.5 * 0.7 / 2.0
    clip = Clip(np.zeros((1, HEIGHT, WIDTH, 3), np.uint8), depth[None].astype(np.float16), 300.0)

    def depth_of(_: NDArray[np.uint8], planes: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.full_like(planes[0], 1.5 * factor if planes[2].any() else 0.525)

    assert measured(depth_of, clip).off_told_height == pytest.approx(off, abs=0.05)
