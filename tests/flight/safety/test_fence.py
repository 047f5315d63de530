"""The fence, against angles and distances worked out another way."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest

from flockd.core.messages import FloatArray, Wanted
from flockd.flight.safety import (
    Action,
    Gate,
    GateParameters,
    Permission,
    Request,
    Surroundings,
    outside_fence,
    outside_heights,
)
from flockd.flight.safety.fence import towards_fence

SQUARE = ((-10.0, -10.0), (-10.0, 10.0), (10.0, 10.0), (10.0, -10.0))
L_SHAPE = ((0.0, 0.0), (40.0, 0.0), (40.0, 10.0), (10.0, 10.0), (10.0, 40.0), (0.0, 40.0))
NOWHERE = np.full(2, math.nan)


def _speed(left_m: float) -> float:
    """From which a drone stops within it with the defaults' 0.5 s and 1.5 m/s^2, by the quadratic formula."""
    return -0.75 + math.sqrt(0.5625 + 3.0 * left_m)


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
    for position, most_m_s in (([36.0, 48.0], 0.0), ([29.7, 39.6], 0.0), ([27.0, 36.0], _speed(5.0 - 0.6))):
        directions, limits = towards_fence(fence, np.array(position))
        np.testing.assert_allclose(directions, [[0.6, 0.8]])
        assert limits == pytest.approx([most_m_s])
    assert len(towards_fence(fence, np.zeros(2))[1]) == 0  # home, from where no direction is the nearest


def test_without_a_fence_nothing_is_outside_not_even_the_unknown() -> None:
    nothing = GateParameters(fence_radius_m=None)
    assert outside_fence(nothing, np.array([1e6, 1e6])) is False
    assert not outside_fence(nothing, NOWHERE)
    assert len(towards_fence(nothing, np.array([1e6, 1e6]))[1]) == 0


@pytest.mark.parametrize(
    "fence", [GateParameters(fence_radius_m=50.0), GateParameters(fence_radius_m=None, fence_corners_m=SQUARE)]
)
def test_where_the_drone_is_not_known_it_counts_as_outside_but_in_no_direction(fence: GateParameters) -> None:
    for position in (NOWHERE, np.array([0.0, math.nan]), np.array([math.inf, 0.0])):
        assert outside_fence(fence, position)
        assert towards_fence(fence, position)[0].shape == (0, 2)


@pytest.mark.parametrize("corners", [SQUARE, L_SHAPE, L_SHAPE[::-1]])
def test_a_fence_of_any_shape(corners: tuple[tuple[float, float], ...]) -> None:
    fence = GateParameters(fence_radius_m=None, fence_corners_m=corners)
    outline = _outline(corners)
    for point in np.random.default_rng(0).uniform(-20.0, 50.0, (200, 2)):
        directions, limits = towards_fence(fence, point)
        nearest = outline[np.argmin(np.linalg.norm(outline - point, axis=1))]
        range_m = float(np.linalg.norm(nearest - point))
        outside = not _is_inside(point, corners)
        assert outside_fence(fence, point) is outside
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
        if outside:
            (direction,) = directions
            np.testing.assert_array_equal(limits, [0.0])
            np.testing.assert_allclose(range_m * direction, point - nearest, atol=0.06)
        else:
            assert len(directions) == len(corners)
            np.testing.assert_allclose(range_m * directions[np.argmin(limits)], nearest - point, atol=0.06)
            assert limits.min() == pytest.approx(_speed(max(range_m - 0.6, 0.0)), abs=0.01)


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
    for position, outward in (
        ([11.0, 0.0], [[1.0, 0.0]]),
        ([-14.0, 0.0], [[-1.0, 0.0], [-1.0, 0.0]]),
        ([9.6, 9.6], [[math.sqrt(0.5), math.sqrt(0.5)], [0.0, 1.0], [1.0, 0.0]]),
    ):
        directions, limits = towards_fence(fence, np.array(position))
        np.testing.assert_allclose(directions[limits == 0.0], outward, atol=1e-12)


@pytest.mark.parametrize("asked", [(3.0, 0.0), (-2.0, 2.0), (1.0, -2.5)])
@pytest.mark.parametrize(
    "fence",
    [
        GateParameters(fence_radius_m=12.0),
        GateParameters(fence_radius_m=None, fence_corners_m=SQUARE),
        GateParameters(fence_radius_m=None, fence_corners_m=tuple((n - 5.0, e - 5.0) for n, e in L_SHAPE)),
    ],
)
def test_who_flies_at_a_fence_stops_before_it(fence: GateParameters, asked: tuple[float, float]) -> None:
    """In the closed loop: a drone that follows its setpoints as PX4's does, with 0.45 s after a dead time of 0.2 s."""
    setpoints = deque([np.zeros(2)] * 4)
    gate, position, velocity, nearest_m = Gate(fence), np.zeros(2), np.zeros(2), math.inf
    outline = _outline(fence.fence_corners_m) if fence.fence_corners_m else None
    for now_s in np.arange(0.0, 30.0, 0.05):
        around = Surroundings(position, velocity, 0.0, np.empty((0, 3)), np.empty((0, 2)), 5.0)
        request = Request(Permission(Action.FLY, now_s), Wanted(np.array(asked), np.zeros(2), 0.0), now_s, 5.0, around)
        setpoint = gate.step(now_s, request).setpoint
        assert setpoint is not None
        setpoints.append(setpoint.velocity)
        velocity = velocity + 0.05 / 0.45 * (setpoints.popleft() - velocity)
        position = position + 0.05 * velocity
        assert not outside_fence(fence, position)
        left_m = 12.0 - np.hypot(*position) if outline is None else np.linalg.norm(outline - position, axis=1).min()
        nearest_m = min(nearest_m, float(left_m))
    assert 0.3 < nearest_m < 1.0


def test_the_heights_are_a_band_and_an_unknown_height_is_outside() -> None:
    band = GateParameters(min_height_m=2.0, max_height_m=20.0)
    assert [outside_heights(band, height) for height in (1.99, 2.0, 20.0, 20.01)] == [True, False, False, True]
    assert outside_heights(band, math.nan)
    assert outside_heights(band, math.inf)
