"""Random forests and villages from a seed, as solids, and how near a flight came to them."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from flockd.core.errors import UsageError
from flockd.core.messages import FloatArray
from flockd.review.flight_log.log import FlightLog
from flockd.sim.scenario import ObstaclesConfig, ScenarioConfig
from flockd.sim.world.obstacles import POINTS_A_STEP, Box, Capsule, Frustum, Material, Obstacles, Solid

DEPTH_M = 0.6
"""How far everything reaches below z = 0, where the ground may lie lower."""
LOWEST_CROWN_M = 6.0
"""Lowest crown of a forest's old trees."""
_TREE_TRIES = 400
_YOUNG = 0.12
"""Share of a forest's trees that have branches down to the ground."""
_LOT_TRIES = 40
_STREET_M = 6.0
"""Free width of the village's street."""
_POLE_SPACING_M = 25.0
_SPAN_PARTS = 6
"""Straight parts of a sagging wire."""


def obstacles_of(scenario: ScenarioConfig) -> Obstacles:
    """The obstacles of a scenario's world, drawn from its seed; none without `world.obstacles`.

    Raises UsageError if they do not fit into the area.
    """
    if scenario.world.obstacles is None:
        return Obstacles()
    starts = np.array([vehicle.position_m[:2] for vehicle in scenario.vehicles])
    return generate_obstacles(scenario.world.obstacles, scenario.seed, starts)


def generate_obstacles(config: ObstaclesConfig, seed: int, starts: FloatArray) -> Obstacles:
    """The obstacles of a scenario; `starts` (n, 2) m north and east are kept free by `config.free_start_m`.

    Raises UsageError where they do not fit into the area.
    """
    rng = np.random.default_rng([seed, 3])
    free = [(float(north), float(east), config.free_start_m) for north, east in starts]
    free += [(place.north_m, place.east_m, place.radius_m) for place in config.clearings]
    site = _Site(rng, config.extent_m, np.array(free).reshape(-1, 3))
    return Obstacles(_forest(site, config) if config.kind == "forest" else _village(site, config))


def _crowded(config: ObstaclesConfig, fitted: str, key: str) -> UsageError:
    return UsageError(
        f"world.obstacles: only {fitted} fit in with {config.min_gap_m:g} m between them; "
        f"write a smaller `{key}` or `min_gap_m`"
    )


class _Site:
    """The area, and circles in it that are taken."""

    def __init__(self, rng: Generator, extent: float, free: FloatArray) -> None:
        self.rng, self.extent = rng, extent
        self._free = free
        self._taken = np.zeros((0, 3))

    def take(self, place: FloatArray, reach: float, gap: float) -> bool:
        """Whether a circle at `place` (2,) is within the area and off all others by `gap`; then it is taken."""
        if (np.abs(place) > self.extent - reach).any():
            return False
        for circles, apart in ((self._free, 0.0), (self._taken, gap)):
            if (np.hypot(*(circles[:, :2] - place).T) < circles[:, 2] + reach + apart).any():
                return False
        self._taken = np.vstack([self._taken, (*place, reach)])
        return True

    def anywhere(self, tries: int, reach: float, gap: float, street: float | None = None) -> FloatArray | None:
        """(2,) a free circle's middle; off the street that runs north, where ``street`` is its easting."""
        for _ in range(tries):
            place = self.rng.uniform(-self.extent, self.extent, 2)
            on_street = street is not None and abs(place[1] - street) < _STREET_M / 2 + reach
            if not on_street and self.take(place, reach, gap):
                return place
        return None


def _forest(site: _Site, config: ObstaclesConfig) -> list[Solid]:
    """Old trees, whose crowns begin above the drones, and a few young ones with branches down to the ground."""
    rng, solids = site.rng, list[Solid]()
    count = round(config.trees_per_hectare * (2 * config.extent_m) ** 2 / 10_000)
    conifers = rng.random()
    for number in range(count):
        young = rng.random() < _YOUNG
        crown = float(rng.uniform(0.5, 0.9)) if young else 0.0
        trunk = float(rng.uniform(0.08, 0.3))
        place = site.anywhere(_TREE_TRIES, max(trunk, crown), config.min_gap_m)
        if place is None:
            raise _crowded(config, f"{number} of {count} trees", "trees_per_hectare")
        if young:
            solids += _young_tree(rng, place, crown)
        else:
            solids += _old_tree(rng, place, trunk, conifer=rng.random() < conifers)
    return solids


def _young_tree(rng: Generator, place: FloatArray, crown: float) -> list[Solid]:
    north, east = place.tolist()
    height = float(rng.uniform(3.0, 6.5))
    return [
        Frustum(north, east, 0.06, 0.05, -DEPTH_M, 0.6, "bark"),
        Frustum(north, east, crown, 0.0, float(rng.uniform(0.2, 0.5)), height, "needles"),
    ]


def _old_tree(rng: Generator, place: FloatArray, trunk: float, *, conifer: bool) -> list[Solid]:
    north, east = place.tolist()
    bare, height = float(rng.uniform(LOWEST_CROWN_M, 8.5)), float(rng.uniform(11.0, 17.0))
    crown = float(rng.uniform(1.0, 2.2))
    solids: list[Solid] = [Frustum(north, east, trunk, 0.5 * trunk, -DEPTH_M, bare + 0.6 * (height - bare), "bark")]
    if conifer:
        middle, upper = bare + 0.4 * (height - bare), bare + 0.6 * (height - bare)
        solids.append(Frustum(north, east, crown, 0.3 * crown, bare, upper, "needles"))
        return [*solids, Frustum(north, east, 0.75 * crown, 0.0, middle, height, "needles")]
    solids.append(Capsule(north, east, bare + crown, north, east, max(bare + crown, height - crown), crown, "leaves"))
    for _ in range(int(rng.integers(1, 4))):
        radius = float(rng.uniform(0.5, 0.8)) * crown
        up = float(rng.uniform(bare + radius, max(bare + radius + 0.1, height - 2 * radius)))
        aside, angle = 0.8 * crown, rng.uniform(0, 2 * math.pi)
        at = north + aside * math.cos(angle), east + aside * math.sin(angle)
        solids.append(Capsule(*at, up, *at, up + 0.4 * radius, radius, "leaves"))
    return solids


def _village(site: _Site, config: ObstaclesConfig) -> list[Solid]:
    """A street from south to north with poles and wires, and on both sides houses, walls and trees."""
    rng, extent = site.rng, config.extent_m
    street = float(rng.uniform(-0.1, 0.1)) * extent
    along_street = rng.uniform(-0.12, 0.12)
    solids, houses = _street_poles(site, street), list[Box]()
    area_ha = (2 * extent) ** 2 / 10_000
    count = round(config.houses_per_hectare * area_ha)
    for number in range(count):
        half = rng.uniform(3.5, 6.5), rng.uniform(2.8, 4.5)
        reach = math.hypot(*half)
        place = site.anywhere(_LOT_TRIES, reach, config.min_gap_m, street)
        if place is None:
            raise _crowded(config, f"{number} of {count} houses", "houses_per_hectare")
        turn = float(along_street + rng.normal(0.0, 0.08) + (math.pi / 2 if rng.random() < 0.5 else 0.0))
        houses.append(_house(rng, place, half, turn, solids))
    for _ in range(round(0.8 * count)):
        length, heading = float(rng.uniform(3.0, 10.0)), float(rng.uniform(0, math.pi))
        place = site.anywhere(_LOT_TRIES, length / 2, config.min_gap_m, street)
        if place is not None:
            material: Material = "stone" if rng.random() < 0.5 else "bricks"
            top, thick = float(rng.uniform(2.0, 5.5)), float(rng.uniform(0.1, 0.25))
            north, east = place.tolist()
            solids.append(Box(north, east, length / 2, thick, heading, -DEPTH_M, top, material))
    for _ in range(round(1.2 * count)):
        crown = float(rng.uniform(0.8, 1.6))
        spot = site.anywhere(_LOT_TRIES, crown, config.min_gap_m, street)
        if spot is not None:
            solids += _garden_tree(rng, spot, crown)
    _service_wires(rng, solids, houses)
    return solids


def _house(rng: Generator, place: FloatArray, half: tuple[float, float], heading: float, solids: list[Solid]) -> Box:
    north, east = place.tolist()
    top = float(rng.uniform(4.5, 8.0))
    material: Material = "bricks" if rng.random() < 0.5 else "plaster"
    house = Box(north, east, *half, heading, -DEPTH_M, top, material)
    overhang, roof_m = float(rng.uniform(0.1, 0.4)), float(rng.uniform(0.2, 0.5))
    solids += [house, Box(north, east, half[0] + overhang, half[1] + overhang, heading, top, top + roof_m, "roof")]
    along = float(rng.uniform(-0.6, 0.6)) * half[0]
    at = north + along * math.cos(heading), east + along * math.sin(heading)
    solids.append(Box(*at, 0.4, 0.4, heading, top, top + roof_m + float(rng.uniform(0.8, 1.6)), "bricks"))
    return house


def _garden_tree(rng: Generator, place: FloatArray, crown: float) -> list[Solid]:
    north, east = place.tolist()
    radius, bare = float(rng.uniform(0.08, 0.2)), float(rng.uniform(1.5, 3.0))
    top = bare + 2 * crown + float(rng.uniform(0.0, 2.0))
    return [
        Frustum(north, east, radius, 0.7 * radius, -DEPTH_M, bare + crown, "bark"),
        Capsule(north, east, bare + crown, north, east, max(bare + crown, top - crown), crown, "leaves"),
    ]


def _street_poles(site: _Site, street: float) -> list[Solid]:
    """Along the street's east side, with sagging wires above the drones from each to the next."""
    rng, solids = site.rng, list[Solid]()
    tops: list[FloatArray] = []
    for along in np.arange(-site.extent + 3.0, site.extent - 3.0, _POLE_SPACING_M):
        place = np.array([along + rng.uniform(-2.0, 2.0), street + _STREET_M / 2 - 0.3])
        height, radius = float(rng.uniform(7.5, 8.5)), float(rng.uniform(0.08, 0.15))
        if site.take(place, radius, 0.5):
            north, east = place.tolist()
            solids.append(Frustum(north, east, radius, 0.7 * radius, -DEPTH_M, height, "wood"))
            tops.append(np.array([*place, height - 0.3]))
    for one, other in itertools.pairwise(tops):
        solids += _wire(one, other, sag=0.03 * float(np.linalg.norm(other - one)))
    return solids


def _service_wires(rng: Generator, solids: list[Solid], houses: list[Box]) -> None:
    """From some poles to the nearest house: these come down through the drones' heights."""
    poles = [solid for solid in solids if isinstance(solid, Frustum) and solid.material == "wood"]
    for pole in poles:
        top = np.array([pole.north, pole.east, pole.top - 0.5])
        near = [house for house in houses if math.hypot(house.north - pole.north, house.east - pole.east) < 22.0]
        if not near or rng.random() < 0.4:
            continue
        house = min(near, key=lambda box: math.hypot(box.north - pole.north, box.east - pole.east))
        solids += _wire(top, np.array([house.north, house.east, house.top - 0.4]), sag=0.3)


def _wire(one: FloatArray, other: FloatArray, *, sag: float) -> list[Solid]:
    """A parabola of straight parts, `sag` metres below the middle of the straight line."""
    share = np.linspace(0.0, 1.0, _SPAN_PARTS + 1)[:, None]
    points = one + share * (other - one)
    points[:, 2] -= sag * 4 * (share * (1 - share))[:, 0]
    ends = itertools.pairwise(points.tolist())
    return [Capsule(a[0], a[1], a[2], b[0], b[1], b[2], 0.012, "metal") for a, b in ends]


def with_obstacles(log: FlightLog, scenario: ScenarioConfig) -> FlightLog:
    """The log of a scenario's flight with its obstacles and clearances; unchanged if there are no obstacles."""
    obstacles = obstacles_of(scenario)
    if not obstacles.solids:
        return log
    return replace(
        log,
        obstacles=obstacles.outlines(),
        clearance=clearances(obstacles, log.time_s, log.position, log.velocity),
        metadata=log.metadata.model_copy(update={"drone_radius_m": scenario.vehicle.radius_m}),
    )


def clearances(obstacles: Obstacles, times: FloatArray, position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Smallest clearances (S, N) m from each of the times (S,) s to the next, of drones at (S, N, 3) m and m/s NED.

    Between them each drone is taken to fly on the cubic through both states.
    """
    interval = np.diff(times)[:, None, None]
    share = np.arange(POINTS_A_STEP)[:, None, None, None] / POINTS_A_STEP
    a, b = position[:-1], position[1:]
    run, end_run = interval * velocity[:-1], interval * velocity[1:]
    path = (2 * share**3 - 3 * share**2 + 1) * a + (share**3 - 2 * share**2 + share) * run
    path = path + (3 * share**2 - 2 * share**3) * b + (share**3 - share**2) * end_run
    nearest = np.minimum(obstacles.clearance(path).min(axis=0), obstacles.clearance(b))
    return np.vstack([nearest, obstacles.clearance(position[-1:])])
