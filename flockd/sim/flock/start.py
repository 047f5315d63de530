"""Makes a scenario's flock larger or smaller, and moves its starts so that all keep apart."""

from __future__ import annotations

import itertools
import math

import numpy as np

from flockd.core.errors import UsageError
from flockd.review.metrics import min_distance
from flockd.sim.scenario import MIN_START_DISTANCE_M, ScenarioConfig, StartConfig

SPACING_M = 3.5
MIN_DISTANCE_M = 3.0
LAYERS_DOWN_M = (-3.0, -4.0, -5.0, -6.0)
_SCATTER = 7
"""Tells the generator of the starts from the others of the same seed."""
_TRIES = 200
_RINGS = 15


def with_drones(scenario: ScenarioConfig, count: int) -> ScenarioConfig:
    """The scenario with its first `count` vehicles, one at least, or with more on a grid around them.

    Every further vehicle starts at least 3 m, measured level, from all others, with the first one's velocity. The
    places depend on nothing but the scenario.
    """
    given = scenario.vehicles[:count]
    return scenario.model_copy(update={"vehicles": given + _further(scenario.vehicles, count - len(given))})


def scattered(scenario: ScenarioConfig, scatter_m: float) -> ScenarioConfig:
    """The scenario with each start moved by up to `scatter_m` to the north and to the east, by its seed.

    Drawn again until no two are too near each other. Raises UsageError where no such starts are found.
    """
    rng = np.random.default_rng([scenario.seed, _SCATTER])
    starts = np.array([vehicle.position_m for vehicle in scenario.vehicles])
    for _ in range(_TRIES):
        moved = starts.copy()
        moved[:, :2] += rng.uniform(-scatter_m, scatter_m, (len(starts), 2))
        if min_distance(moved) >= MIN_START_DISTANCE_M:
            places = zip(scenario.vehicles, moved.tolist(), strict=True)
            vehicles = tuple(vehicle.model_copy(update={"position_m": tuple(place)}) for vehicle, place in places)
            return scenario.model_copy(update={"vehicles": vehicles})
    raise UsageError(f"no starts of seed {scenario.seed} were {MIN_START_DISTANCE_M:g} m apart; reduce scatter_m")


def _further(given: tuple[StartConfig, ...], count: int) -> tuple[StartConfig, ...]:
    """On a grid, ring by ring around the middle of the given ones."""
    north, east = np.mean([vehicle.position_m[:2] for vehicle in given], axis=0).tolist()
    cells = itertools.product(range(-_RINGS, _RINGS + 1), repeat=2)
    by_ring = sorted(cells, key=lambda cell: (max(map(abs, cell)), cell[0] ** 2 + cell[1] ** 2, cell))
    places = ((north + SPACING_M * row, east + SPACING_M * column) for row, column in by_ring)
    # Grid places are farther apart than MIN_DISTANCE_M; only the given vehicles stand off the grid.
    free = (
        place
        for place in places
        if all(math.dist(place, vehicle.position_m[:2]) >= MIN_DISTANCE_M for vehicle in given)
    )
    return tuple(
        StartConfig(position_m=(*place, down), velocity_m_s=given[0].velocity_m_s)
        for place, down in zip(itertools.islice(free, count), itertools.cycle(LAYERS_DOWN_M), strict=False)
    )
