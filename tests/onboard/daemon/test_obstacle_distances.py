"""The local map as Collision Prevention gets it: where everything is by now, not where it was in the step."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flockd.core.messages import SECTORS, FloatArray, Neighbour, ObstacleRanges
from flockd.onboard.daemon.autopilot_tasks import ObstacleDistances
from flockd.onboard.daemon.pilot_loop import VehicleHistory
from tests.make import drone, neighbour, output, vehicle

NORTH, EAST = 0, SECTORS // 4


def _distances(
    *neighbours: Neighbour, wall_m: float = math.inf, north_m_s: float = 0.0, age_s: float = 0.2, known: bool = True
) -> FloatArray | None:
    """Of a drone that looks north and flies on for ``age_s`` after the step; a wall in the north."""
    config, range_m = drone(), np.full(SECTORS, np.inf)
    range_m[NORTH] = wall_m
    seen_m = np.full(SECTORS, config.obstacles.range_m)
    ranges = ObstacleRanges(1.0, range_m, np.zeros(SECTORS), seen_m) if known else None
    history = VehicleHistory()
    for time_s in (1.0, 1.0 + age_s):
        history.add(vehicle(time_s, velocity_ned=[north_m_s, 0.0, 0.0]))
    result = SimpleNamespace(time_s=1.0, output=output(1.0, neighbours=neighbours, obstacles=ranges))
    link: Any = SimpleNamespace(vehicle_state=lambda: history.at(1.0 + age_s))
    loop: Any = SimpleNamespace(newest=result)
    sends = ObstacleDistances(config, link, loop, history, lambda: 1.0 + age_s)
    return sends._free_ahead(1.0 + age_s)


def test_a_wall_is_nearer_by_what_the_drone_has_moved_towards_it() -> None:
    found = _distances(wall_m=3.0, north_m_s=2.0)
    assert found is not None
    assert found[NORTH] == pytest.approx(2.6)
    assert found[EAST] == math.inf


def test_a_neighbour_has_flown_on_and_the_drone_has_moved_and_it_may_be_nearer() -> None:
    """2 m east at 1 m/s to the north, as the drone itself: it stays abreast, nearer by its uncertainty."""
    config = drone()
    found = _distances(neighbour([0.0, 2.0, 0.0], [1.0, 0.0, 0.0]), north_m_s=1.0)
    assert found is not None
    assert found[EAST] == pytest.approx(2.0 - config.obstacles.sigmas * 0.05)
    closing = _distances(neighbour([2.0, 0.0, 0.0], [-1.0, 0.0, 0.0]), north_m_s=1.0)
    assert closing is not None
    assert closing[NORTH] == pytest.approx(1.6 - config.obstacles.sigmas * 0.05)


def test_who_flies_far_above_or_is_not_confirmed_is_left_out() -> None:
    far_m = drone().obstacles.height_band_m + 0.5
    for one in (neighbour([2.0, 0.0, -far_m]), neighbour([2.0, 0.0, 0.0], confirmed=False)):
        found = _distances(one)
        assert found is not None
        assert found[NORTH] == math.inf


def test_of_an_old_map_or_without_one_nothing_is_sent() -> None:
    assert _distances(age_s=drone().safety.estimate_timeout_s + 0.1) is None
    assert _distances(known=False) is None
