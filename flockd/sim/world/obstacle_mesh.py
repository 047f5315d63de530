"""Obstacles as triangles: the very solids, with bark, leaves, bricks and windows on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, assert_never

import numpy as np
from numpy.random import Generator

from flockd.core.messages import Float32Array, FloatArray
from flockd.sim.world import textures
from flockd.sim.world.mesh import Tile
from flockd.sim.world.obstacle_worlds import LOWEST_CROWN_M
from flockd.sim.world.obstacles import Box, Capsule, Frustum, Material, Obstacles
from flockd.sim.world.scenery import Scenery, leaf_colour, paint_colour, roof_colour

_LOOKS = 3
"""Looks of each material: the trees of one wood are of a few kinds, the houses of one village too."""
_HOUSE_M = 2.0
"""A box that is wider than this on both sides is a house, and has windows."""
_SWELL = 1.04
"""Factor on a crown's corners, so that its faces lie about as far out as the sphere that they stand for."""


class _Look(NamedTuple):
    texture: int
    tint: FloatArray
    """(3,) linear."""
    tile_m: Tile


def draw_obstacles(scenery: Scenery, obstacles: Obstacles, seed: int) -> None:
    """Adds the obstacles' triangles, textures and footprints to a scenery, with colours drawn from the seed."""
    rng = np.random.default_rng([seed, 4])
    looks = {
        material: [_look(scenery, rng, material) for _ in range(_LOOKS)]
        for material in dict.fromkeys(solid.material for solid in obstacles.solids)
    }
    houses = [_facade(scenery, rng) for _ in range(_LOOKS)]
    for solid in obstacles.solids:
        look = looks[solid.material][int(rng.integers(_LOOKS))]
        shade = rng.uniform(0.8, 1.2)
        match solid:
            case Frustum():
                wide = max(solid.foot_radius, solid.top_radius)
                base, tip = (np.array([solid.north, solid.east, -height]) for height in (solid.foot, solid.top))
                radii, sides = (solid.foot_radius, solid.top_radius), 10 if wide < 0.4 else 16
                scenery.mesh.frustum(base, tip, radii, sides, look.texture, look.tint * shade, look.tile_m)
            case Box():
                if solid.material != "roof" and min(solid.half_length, solid.half_width) > _HOUSE_M:
                    look = houses[int(rng.integers(_LOOKS))]
                half = solid.half_length, solid.half_width, (solid.top - solid.foot) / 2
                centre = np.array([solid.north, solid.east, -(solid.top + solid.foot) / 2])
                scenery.mesh.box(centre, half, solid.heading, look.texture, look.tint * shade, look.tile_m)
            case Capsule():
                _draw_capsule(scenery, solid, look, shade, rng)
            case never:
                assert_never(never)
        lowest, highest = solid.heights
        if solid.material != "metal" and lowest < (LOWEST_CROWN_M if isinstance(solid, Capsule) else 1.0):
            *place, length, width, heading, margin = solid.between(-math.inf, math.inf)
            scenery.obstacles.append((place[0], place[1], length + margin, width + margin, heading, highest))


def _draw_capsule(scenery: Scenery, solid: Capsule, look: _Look, shade: float, rng: Generator) -> None:
    """A wire as a thin pipe; a crown as a sphere, drawn out where it is upright."""
    one = np.array([solid.north, solid.east, -solid.height])
    other = np.array([solid.other_north, solid.other_east, -solid.other_height])
    if solid.material == "metal":
        radii = solid.radius, solid.radius
        scenery.mesh.frustum(one, other, radii, 5, look.texture, look.tint * shade, look.tile_m)
        return
    scenery.mesh.blob(
        (one + other) / 2, np.full(3, _SWELL * solid.radius), 0.0, rng, look.texture, look.tint * shade,
        look.tile_m[0], half_height=abs(one[2] - other[2]) / 2,
    )  # fmt: skip


def _look(scenery: Scenery, rng: Generator, material: Material) -> _Look:
    kind = _MATERIALS[material]
    tint = kind.tint(rng)
    return _Look(scenery.add_texture(kind.texture(rng)), tint, (kind.tile_m, kind.tile_m))


def _facade(scenery: Scenery, rng: Generator) -> _Look:
    wall = textures.WALLS[int(rng.integers(2))](rng)
    tile_m = float(rng.uniform(4.0, 7.0)), float(rng.uniform(5.0, 6.5))
    return _Look(scenery.add_texture(textures.facade(rng, wall, paint_colour(rng))), np.full(3, 0.5), tile_m)


def _bark(rng: Generator) -> FloatArray:
    pale = rng.random() < 0.2
    return np.array([0.5, 0.47, 0.42] if pale else [0.24, 0.17, 0.11]) * rng.uniform(0.6, 1.4)


class _Kind(NamedTuple):
    texture: Callable[[Generator], Float32Array]
    tint: Callable[[Generator], FloatArray]
    """(3,) linear."""
    tile_m: float


_MATERIALS: Mapping[Material, _Kind] = {
    "bark": _Kind(textures.bark, _bark, 0.8),
    "leaves": _Kind(textures.leaves, leaf_colour, 1.6),
    "needles": _Kind(textures.leaves, lambda rng: rng.uniform((0.03, 0.09, 0.02), (0.09, 0.18, 0.07)), 1.0),
    "plaster": _Kind(textures.plaster, paint_colour, 3.0),
    "bricks": _Kind(textures.bricks, lambda rng: np.array([0.42, 0.2, 0.13]) * rng.uniform(0.6, 1.3), 2.0),
    "stone": _Kind(textures.stone_cells, paint_colour, 2.0),
    "roof": _Kind(textures.roof_tiles, roof_colour, 2.5),
    "wood": _Kind(textures.planks, lambda rng: np.array([0.26, 0.19, 0.13]) * rng.uniform(0.6, 1.5), 1.0),
    "metal": _Kind(textures.plaster, lambda rng: np.full(3, rng.uniform(0.02, 0.08)), 1.0),
}
