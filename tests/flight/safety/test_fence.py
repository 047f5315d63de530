"""The fence, against angles and distances worked out another way."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest

from flockd.core.config.safety import GateParameters
from flockd.core.messages import FloatArray
from flockd.flight.safety import Gate, outside_fence, outside_heights
from flockd.flight.safety.fence import towards_fence
from tests.make import around, request

Corners = tuple[tuple[float, float], ...]
SQUARE: Corners = ((-10.0, -10.0), (-10.0, 10.0), (10.0, 10.0), (10.0, -10.0))
L_SHAPE: Corners = ((0.0, 0.0), (40.0, 0.0), (40.0, 10.0), (10.0, 10.0), (10.0, 40.0), (0.0, 40.0))
WEDGE: Corners = ((-30.0, 0.0), (10.0, -8.0), (10.0, 8.0))
DIAMOND: Corners = ((0.0, -10.0), (10.0, 0.0), (0.0, 10.0), (-10.0, 0.0))


def fence(corners: Corners = (), radius_m: float | None = None) -> GateParameters:
    return GateParameters(fence_radius_m=radius_m, fence_corners_m=corners)


def stopping(left_m: float) -> float:
    """From which a drone stops within it with the defaults' 0.5 s and 1.5 m/s^2, by the quadratic formula."""
    return -0.75 + math.sqrt(0.5625 + 3.0 * left_m)


def is_inside(point: FloatArray, corners: Corners) -> bool:
    """By the winding number: seen from inside, the outline goes round once."""
    angles = [math.atan2(east - point[1], north - point[0]) for north, east in corners]
    turns = sum(math.remainder(b - a, math.tau) for a, b in zip(angles, angles[1:] + angles[:1], strict=True))
    return abs(turns) > math.pi


def outline(corners: Corners) -> FloatArray:
    """Points of the outline, 5 cm apart at most."""
    ends = np.array(corners)
    steps = np.linspace(0.0, 1.0, 801)[:, None]
    return np.concatenate([a + steps * (b - a) for a, b in zip(ends, np.roll(ends, -1, axis=0), strict=True)])


def test_a_circle_around_home() -> None:
    circle = fence(radius_m=50.0)
    assert outside_fence(circle, np.array([30.0, 40.0])) is False
    assert outside_fence(circle, np.array([30.0, 40.01])) is True
    assert outside_fence(circle, np.array([-30.0, -40.01]))
    for position, most_m_s in (([36.0, 48.0], 0.0), ([29.7, 39.6], 0.0), ([27.0, 36.0], stopping(5.0 - 0.6))):
        directions, limits = towards_fence(circle, np.array(position))
        np.testing.assert_allclose(directions[0], [0.6, 0.8])
        assert limits[0] == pytest.approx(most_m_s)
    assert towards_fence(circle, np.zeros(2))[1] == pytest.approx(np.full(12, stopping(50.0 - 0.6)))


def test_the_way_to_a_circle_counts_all_around() -> None:
    place, ways_m = np.array([-20.0, 35.0]), np.arange(0.0, 100.0, 0.001)
    for direction, most_m_s in zip(*towards_fence(fence(radius_m=50.0), place), strict=True):
        inside = np.hypot(*(place[:, None] + ways_m * direction[:, None])) <= 50.0
        assert most_m_s == pytest.approx(stopping(ways_m[inside].max() - 0.6), abs=0.01)


def test_without_a_fence_nothing_is_outside_not_even_the_unknown() -> None:
    assert outside_fence(fence(), np.array([1e6, 1e6])) is False
    assert not outside_fence(fence(), np.full(2, math.nan))
    assert len(towards_fence(fence(), np.array([1e6, 1e6]))[1]) == 0


@pytest.mark.parametrize("limits", [fence(radius_m=50.0), fence(SQUARE)])
def test_where_the_drone_is_not_known_it_counts_as_outside_but_in_no_direction(limits: GateParameters) -> None:
    for position in ([math.nan, math.nan], [0.0, math.nan], [math.inf, 0.0]):
        assert outside_fence(limits, np.array(position))
        assert [part.shape for part in towards_fence(limits, np.array(position))] == [(0, 2), (0,)]


@pytest.mark.parametrize("corners", [SQUARE, L_SHAPE, L_SHAPE[::-1]])
def test_a_fence_of_any_shape(corners: Corners) -> None:
    border, limits = outline(corners), fence(corners)
    for point in np.random.default_rng(0).uniform(-20.0, 50.0, (200, 2)):
        directions, most_m_s = towards_fence(limits, point)
        nearest = border[np.argmin(np.linalg.norm(border - point, axis=1))]
        range_m = float(np.linalg.norm(nearest - point))
        outside = not is_inside(point, corners)
        assert outside_fence(limits, point) is outside
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
        if outside:
            (direction,) = directions
            np.testing.assert_array_equal(most_m_s, [0.0])
            np.testing.assert_allclose(range_m * direction, point - nearest, atol=0.06)
        else:
            assert len(directions) == len(corners)
            np.testing.assert_allclose(range_m * directions[np.argmin(most_m_s)], nearest - point, atol=0.06)
            assert most_m_s.min() == pytest.approx(stopping(max(range_m - 0.6, 0.0)), abs=0.01)


def test_a_corner_beside_the_drone_does_not_count_twice() -> None:
    """The rays to the east through a corner: in a diamond, inside and outside."""
    places = np.array([[0.0, 0.0], [0.0, -11.0], [0.0, 11.0], [10.0, -5.0]])
    assert [outside_fence(fence(DIAMOND), place) for place in places] == [False, True, True, True]


def test_with_a_circle_and_corners_both_have_to_be_kept() -> None:
    both = fence(SQUARE, 12.0)
    assert not outside_fence(both, np.array([8.0, 8.0]))
    for position, outward in (
        ([11.0, 0.0], [[1.0, 0.0]]),
        ([-11.0, 0.0], [[-1.0, 0.0]]),
        ([9.6, 9.6], [[0.0, 1.0], [1.0, 0.0]]),
    ):
        directions, limits = towards_fence(both, np.array(position))
        of_square = limits[12:] == 0.0
        np.testing.assert_allclose(directions[12:][of_square], outward, atol=1e-12)
        assert (limits[:12] == 0.0).any() == (math.hypot(*position) > 11.4)


@pytest.mark.parametrize("asked", [(3.0, 0.0), (-2.0, 2.0), (1.0, -2.5), (-3.9, 0.0), (-3.9, 0.6), (2.8, 2.8)])
@pytest.mark.parametrize("corners", [(), SQUARE, tuple((n - 5.0, e - 5.0) for n, e in L_SHAPE), WEDGE])
def test_who_flies_at_a_fence_stops_before_it(corners: Corners, asked: tuple[float, float]) -> None:
    """In the closed loop: a drone that follows its setpoints as PX4's does, with 0.45 s after a dead time of 0.2 s.

    Also along a side into an acute corner, and towards one that leads inward.
    """
    limits = fence(corners, None if corners else 12.0)
    setpoints = deque([np.zeros(2)] * 4)
    gate, position, velocity, nearest_m = Gate(limits), np.zeros(2), np.zeros(2), math.inf
    border = outline(corners) if corners else None
    for now_s in np.arange(0.0, 20.0, 0.05):
        setpoint = gate.step(now_s, request(now_s, asked, surroundings=around(position, velocity))).setpoint
        assert setpoint is not None
        setpoints.append(setpoint.velocity)
        velocity = velocity + 0.05 / 0.45 * (setpoints.popleft() - velocity)
        position = position + 0.05 * velocity
        assert not outside_fence(limits, position)
        left_m = 12.0 - np.hypot(*position) if border is None else np.linalg.norm(border - position, axis=1).min()
        nearest_m = min(nearest_m, float(left_m))
    assert 0.3 < nearest_m < 1.0


@pytest.mark.parametrize("radius_m", [10.0, 100.0])
@pytest.mark.parametrize("outward_rad", [0.0, 0.8])
def test_who_flies_along_a_circle_stays_within_it(radius_m: float, outward_rad: float) -> None:
    """At 4 m/s, always at the same angle from it: a limit outward alone leads 25 m out of a circle of 10 m."""
    setpoints = deque([np.zeros(2)] * 4)
    gate, position, velocity = Gate(fence(radius_m=radius_m)), np.array([radius_m - 4.0, 0.0]), np.zeros(2)
    for now_s in np.arange(0.0, 60.0, 0.05):
        course = math.atan2(position[1], position[0]) + math.pi / 2 - outward_rad
        asked = 4.0 * np.array([math.cos(course), math.sin(course)])
        setpoint = gate.step(now_s, request(now_s, asked, surroundings=around(position, velocity))).setpoint
        assert setpoint is not None
        setpoints.append(setpoint.velocity)
        velocity = velocity + 0.05 / 0.45 * (setpoints.popleft() - velocity)
        position = position + 0.05 * velocity
        assert np.hypot(*position) < radius_m - 0.3


def test_the_heights_are_a_band_with_room_for_noise_and_an_unknown_height_is_outside() -> None:
    band = GateParameters(min_height_m=2.0, max_height_m=20.0)
    found = [outside_heights(band, height) for height in (1.69, 1.7, 20.3, 20.31, math.nan, math.inf)]
    assert found == [True, False, False, True, True, True]


def test_directions_to_a_circle_are_thirty_degrees_apart_all_around() -> None:
    directions, _ = towards_fence(fence(radius_m=50.0), np.array([20.0, 10.0]))
    azimuths = np.sort(np.degrees(np.arctan2(directions[:, 1], directions[:, 0])))
    np.testing.assert_allclose(np.diff(azimuths), 30.0)
    assert len(azimuths) == 12


@pytest.mark.parametrize("position", [(10.0, 0.0), (10.0, 10.0), (0.0, -10.0)])
def test_on_a_fence_a_side_at_no_distance_has_no_direction(position: tuple[float, float]) -> None:
    directions, limits = towards_fence(fence(SQUARE), np.array(position))
    assert np.isfinite(directions).all()
    assert len(directions) == len(limits)
