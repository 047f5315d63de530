"""Makes a scenario's flock larger or smaller, with start positions that keep apart."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

from flockd.config.scenario import ScenarioConfig, StartConfig

SPACING_M = 3.5
MIN_DISTANCE_M = 3.0
LAYERS_DOWN_M = (-3.0, -4.0, -5.0, -6.0)


def with_drones(scenario: ScenarioConfig, count: int) -> ScenarioConfig:
    """The scenario with its first `count` vehicles, or with more on a grid around them.

    Every further vehicle starts at least 3 m, measured level, from all others, with the first one's velocity. The
    places depend on nothing but the scenario. Raises ValueError for fewer than one.
    """
    if count < 1:
        raise ValueError(f"{count} drones cannot fly; ask for at least 1")
    given = scenario.vehicles[:count]
    return scenario.model_copy(update={"vehicles": given + _further(scenario.vehicles, count - len(given))})


def _further(given: tuple[StartConfig, ...], count: int) -> tuple[StartConfig, ...]:
    north = sum(vehicle.position_m[0] for vehicle in given) / len(given)
    east = sum(vehicle.position_m[1] for vehicle in given) / len(given)
    places = ((north + SPACING_M * row, east + SPACING_M * column) for row, column in _spiral())
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


def _spiral() -> Iterator[tuple[int, int]]:
    """All cells of the grid, ring by ring around (0, 0)."""
    yield 0, 0
    for ring in itertools.count(1):
        cells = range(-ring, ring + 1)
        yield from sorted(
            ((row, column) for row in cells for column in cells if max(abs(row), abs(column)) == ring),
            key=lambda cell: (cell[0] ** 2 + cell[1] ** 2, cell),
        )
