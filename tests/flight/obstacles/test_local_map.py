"""The local map: what is kept of the ranges of the last seconds while the drone moves."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.core.config.avoidance import ObstacleParameters
from flockd.core.messages import SECTORS, FloatArray, ObstacleRanges
from flockd.flight.obstacles import LocalMap, nearest_points

PARAMETERS = ObstacleParameters(enabled=True, range_m=15.0, memory_s=3.0, sigmas=2.0)
STILL = np.zeros(2)
NORTH, EAST = 0, SECTORS // 4


def ranges(time_s: float, found: dict[int, float], sigma_m: float = 0.1, seen_m: float = 15.0) -> ObstacleRanges:
    """Obstacles by sector; all others are seen to be free."""
    range_m, sigmas_m = np.full(SECTORS, np.inf), np.zeros(SECTORS)
    for sector, away_m in found.items():
        range_m[sector], sigmas_m[sector] = away_m, sigma_m
    return ObstacleRanges(time_s, range_m, sigmas_m, np.minimum(range_m, seen_m))


def obstacles_in(view: ObstacleRanges | FloatArray) -> dict[int, float]:
    range_m = view.range_m if isinstance(view, ObstacleRanges) else view
    return {int(sector): float(range_m[sector]) for sector in np.flatnonzero(~np.isposinf(range_m))}


def test_an_obstacle_stays_where_it_is_while_the_drone_passes_it_unseeing() -> None:
    local = LocalMap(PARAMETERS)
    local.step(0.0, ranges(0.0, {NORTH: 4.0}), None, 0.0)
    view = local.step(0.5, None, np.array([4.0, -3.0]), 0.05)
    assert obstacles_in(view) == {EAST: pytest.approx(3.0)}
    view = local.step(1.0, None, np.array([0.0, 3.5]), 0.05)
    assert obstacles_in(view) == {3 * SECTORS // 4: pytest.approx(0.5)}


def test_it_grows_uncertain_by_the_drones_own_motion_and_is_forgotten() -> None:
    local = LocalMap(PARAMETERS)
    local.step(0.0, ranges(0.0, {NORTH: 4.0}, sigma_m=0.3), None, 0.0)
    assert local.step(1.0, None, STILL, 0.4).sigma_m[NORTH] == pytest.approx(0.5)  # 3-4-5
    assert obstacles_in(local.step(3.0, None, STILL, 0.0)) == {NORTH: 4.0}
    assert obstacles_in(local.step(3.1, None, STILL, 0.0)) == {}


def test_a_newer_range_of_the_same_obstacle_takes_the_older_ones_place() -> None:
    local = LocalMap(PARAMETERS)
    local.step(0.0, ranges(0.0, {NORTH: 4.0}, sigma_m=0.3), None, 0.0)
    view = local.step(0.5, ranges(0.5, {NORTH: 4.6}, sigma_m=0.2), STILL, 0.0)
    assert obstacles_in(view) == {NORTH: 4.6}
    assert view.sigma_m[NORTH] == 0.2


def test_farther_than_its_range_nothing_counts() -> None:
    local = LocalMap(PARAMETERS)
    assert obstacles_in(local.step(0.0, ranges(0.0, {NORTH: 15.5, EAST: 14.5}), None, 0.0)) == {EAST: 14.5}
    assert obstacles_in(local.step(0.5, None, np.array([0.0, -1.0]), 0.0)) == {}


def test_what_is_known_to_be_free_fades() -> None:
    local = LocalMap(PARAMETERS)
    assert local.step(0.0, ranges(0.0, {}), None, 0.0).seen_m[NORTH] == 15.0
    assert local.step(1.0, None, np.array([2.0, 0.0]), 0.0).seen_m[NORTH] == pytest.approx(15.0 * 2 / 3 - 2.0)
    assert local.step(3.0, None, STILL, 0.0).seen_m.max() == 0.0


@pytest.mark.parametrize(("time_s", "displacement"), [(1.0, STILL), (5.5, None)])
def test_where_time_runs_backwards_or_the_own_motion_is_not_known_the_map_begins_anew(
    time_s: float, displacement: FloatArray | None
) -> None:
    local = LocalMap(PARAMETERS)
    local.step(5.0, ranges(5.0, {NORTH: 3.0}), None, 0.0)
    view = local.step(time_s, ranges(time_s, {EAST: 4.0}), displacement, 0.0)
    assert obstacles_in(view) == {EAST: 4.0}


@pytest.mark.parametrize(("sector", "place"), [(NORTH, [2.8, 0.0]), (EAST, [0.0, 2.8]), (SECTORS // 2, [-2.8, 0.0])])
def test_an_obstacle_counts_as_nearer_than_measured(sector: int, place: list[float]) -> None:
    points: FloatArray = nearest_points(ranges(0.0, {sector: 3.0}, sigma_m=0.1), 2.0)
    np.testing.assert_allclose(points, [place], atol=1e-12)
