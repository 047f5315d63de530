"""The fence, against angles and distances worked out another way."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.messages import FloatArray
from flockd.flight.safety import GateParameters, outside_fence, outside_heights
from flockd.flight.safety.fence import offsets_outside

SQUARE = ((-10.0, -10.0), (-10.0, 10.0), (10.0, 10.0), (10.0, -10.0))
L_SHAPE = ((0.0, 0.0), (40.0, 0.0), (40.0, 10.0), (10.0, 10.0), (10.0, 40.0), (0.0, 40.0))
NOWHERE = np.full(2, math.nan)


def _is_inside(point: FloatArray, corners: tuple[tuple[float, float], ...]) -> bool:
    """By the winding number: seen from inside, the outline goes round once."""
    angles = [math.atan2(east - point[1], north - point[0]) for north, east in corners]
    turns = sum(math.remainder(b - a, math.tau) for a, b in zip(angles, angles[1:] + angles[:1], strict=True))
    return abs(turns) > math.pi


def _outline(corners: tuple[tuple[float, float], ...]) -> FloatArray:
    """Points of the outline, 5 cm apart at most."""
    ends = np.array(corners)
    sides = zip(ends, np.roll(ends, -1, axis=0), strict=True)
    steps = np.linspace(0.0, 1.0, 801)[:, None]
    return np.concatenate([a + steps * (b - a) for a, b in sides])


def test_a_circle_around_home() -> None:
    fence = GateParameters(fence_radius_m=50.0)
    assert outside_fence(fence, np.array([30.0, 40.0])) is False
    assert outside_fence(fence, np.array([30.0, 40.01])) is True
    assert outside_fence(fence, np.array([-30.0, -40.01]))
    # 6, 8 outward of the point 30, 40 where the ray from home leaves the circle
    np.testing.assert_allclose(offsets_outside(fence, np.array([36.0, 48.0])), [[6.0, 8.0]])


def test_without_a_fence_nothing_is_outside_not_even_the_unknown() -> None:
    nothing = GateParameters(fence_radius_m=None)
    assert outside_fence(nothing, np.array([1e6, 1e6])) is False
    assert not outside_fence(nothing, NOWHERE)
    assert len(offsets_outside(nothing, np.array([1e6, 1e6]))) == 0


@pytest.mark.parametrize(
    "fence", [GateParameters(fence_radius_m=50.0), GateParameters(fence_radius_m=None, fence_corners_m=SQUARE)]
)
def test_where_the_drone_is_not_known_it_counts_as_outside_but_in_no_direction(fence: GateParameters) -> None:
    for position in (NOWHERE, np.array([0.0, math.nan]), np.array([math.inf, 0.0])):
        assert outside_fence(fence, position)
        assert offsets_outside(fence, position).shape == (0, 2)


@pytest.mark.parametrize("corners", [SQUARE, L_SHAPE, L_SHAPE[::-1]])
def test_a_fence_of_any_shape(corners: tuple[tuple[float, float], ...]) -> None:
    fence = GateParameters(fence_radius_m=None, fence_corners_m=corners)
    outline = _outline(corners)
    for point in np.random.default_rng(0).uniform(-20.0, 50.0, (200, 2)):
        offsets = offsets_outside(fence, point)
        if _is_inside(point, corners):
            assert len(offsets) == 0
            assert not outside_fence(fence, point)
        else:
            assert outside_fence(fence, point)
            (offset,) = offsets
            assert np.linalg.norm(offset) == pytest.approx(np.linalg.norm(outline - point, axis=1).min(), abs=0.03)
            assert np.linalg.norm(outline - (point - offset), axis=1).min() < 0.03  # it begins on the fence


def test_a_corner_beside_the_drone_does_not_count_twice() -> None:
    """The rays to the east through a corner: in a diamond, inside and outside."""
    diamond = GateParameters(
        fence_radius_m=None, fence_corners_m=((0.0, -10.0), (10.0, 0.0), (0.0, 10.0), (-10.0, 0.0))
    )
    assert not outside_fence(diamond, np.array([0.0, 0.0]))
    assert outside_fence(diamond, np.array([0.0, -11.0]))
    assert outside_fence(diamond, np.array([0.0, 11.0]))
    assert outside_fence(diamond, np.array([10.0, -5.0]))


def test_with_a_circle_and_corners_both_have_to_be_kept() -> None:
    fence = GateParameters(fence_radius_m=12.0, fence_corners_m=SQUARE)
    assert not outside_fence(fence, np.array([8.0, 8.0]))
    np.testing.assert_allclose(offsets_outside(fence, np.array([11.0, 0.0])), [[1.0, 0.0]])
    np.testing.assert_allclose(offsets_outside(fence, np.array([9.6, 9.6])), [np.full(2, 9.6 - 12.0 / math.sqrt(2))])
    np.testing.assert_allclose(offsets_outside(fence, np.array([14.0, 0.0])), [[2.0, 0.0], [4.0, 0.0]])


def test_the_heights_are_a_band_and_an_unknown_height_is_outside() -> None:
    band = GateParameters(min_height_m=2.0, max_height_m=20.0)
    assert [outside_heights(band, height) for height in (1.99, 2.0, 20.0, 20.01)] == [True, False, False, True]
    assert outside_heights(band, math.nan)
    assert outside_heights(band, math.inf)
