"""A flock of any size starts without a collision."""

from __future__ import annotations

import math
from itertools import combinations

import pytest

from flockd.sim.flock.start import with_drones
from tests import make

PAPER = make.scenario()


def test_a_smaller_flock_is_the_first_of_the_list() -> None:
    assert with_drones(PAPER, 2).vehicles == PAPER.vehicles[:2]
    assert with_drones(PAPER, 5) == PAPER


@pytest.mark.parametrize("count", [6, 20, 200])
def test_a_larger_flock_keeps_the_given_and_stands_apart(count: int) -> None:
    vehicles = with_drones(PAPER, count).vehicles
    assert len(vehicles) == count
    assert vehicles[:5] == PAPER.vehicles
    places = [vehicle.position_m for vehicle in vehicles]
    for one, other in combinations(places, 2):
        if other in places[5:]:
            assert math.dist(one[:2], other[:2]) >= 3.0
    assert {place[2] for place in places[5:]} <= {-3.0, -4.0, -5.0, -6.0}
    assert {vehicle.velocity_m_s for vehicle in vehicles} == {(1.0, 0.0)}
    # Dense enough to be one flock: within the disc that the same number fills at twice the spacing.
    assert max(math.dist(place[:2], (1.92, 0.9)) for place in places) < 7.0 * math.sqrt(count / math.pi) + 7.0
