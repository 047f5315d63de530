"""Obstacles as triangles: the very solids, with bark, leaves, bricks and windows on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, assert_never

import numpy as np
from numpy.random import Generator

from flockd.core.messages import Float32Array, FloatArray
from flockd.sim.world import textures
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
    tile_m: tuple[float, float]


def draw_obstacles(scenery: Scenery, obstacles: Obstacles, seed: int) -> None:
    """Adds their triangles, textures and footprints to a scenery, with colours drawn from the seed."""
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
                _draw_frustum(scenery, solid, look, shade)
            case Box():
                if solid.material != "roof" and min(solid.half_length, solid.half_width) > _HOUSE_M:
                    look = houses[int(rng.integers(_LOOKS))]
                _draw_box(scenery, solid, look, shade)
            case Capsule():
                _draw_capsule(scenery, solid, look, shade, rng)
            case never:
                assert_never(never)


def _draw_frustum(scenery: Scenery, solid: Frustum, look: _Look, shade: float) -> None:
    wide = max(solid.foot_radius, solid.top_radius)
    base, tip = (np.array([solid.north, solid.east, -height]) for height in (solid.foot, solid.top))
    radii = solid.foot_radius, solid.top_radius
    scenery.mesh.frustum(base, tip, radii, 10 if wide < 0.4 else 16, look.texture, look.tint * shade, look.tile_m)
    if solid.foot < 1.0:
        scenery.obstacles.append((solid.north, solid.east, wide, wide, 0.0, solid.top))


def _draw_box(scenery: Scenery, solid: Box, look: _Look, shade: float) -> None:
    half = solid.half_length, solid.half_width, (solid.top - solid.foot) / 2
    centre = np.array([solid.north, solid.east, -(solid.top + solid.foot) / 2])
    scenery.mesh.box(centre, half, solid.heading, look.texture, look.tint * shade, look.tile_m)
    if solid.foot < 1.0:
        scenery.obstacles.append((solid.north, solid.east, *half[:2], solid.heading, solid.top))


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
    if min(solid.height, solid.other_height) - solid.radius < LOWEST_CROWN_M:
        top = max(solid.height, solid.other_height) + solid.radius
        scenery.obstacles.append((solid.north, solid.east, solid.radius, solid.radius, 0.0, top))


def _look(scenery: Scenery, rng: Generator, material: Material) -> _Look:
    tint, tile_m = _tint(rng, material), _TILES_M[material]
    return _Look(scenery.add_texture(_TEXTURES[material](rng)), tint, (tile_m, tile_m))


def _facade(scenery: Scenery, rng: Generator) -> _Look:
    wall = textures.WALLS[int(rng.integers(2))](rng)
    tile_m = float(rng.uniform(4.0, 7.0)), float(rng.uniform(5.0, 6.5))
    return _Look(scenery.add_texture(textures.facade(rng, wall, paint_colour(rng))), np.full(3, 0.5), tile_m)


_TEXTURES: Mapping[Material, Callable[[Generator], Float32Array]] = {
    "bark": textures.bark,
    "leaves": textures.leaves,
    "needles": textures.leaves,
    "plaster": textures.plaster,
    "bricks": textures.bricks,
    "stone": textures.stone_cells,
    "roof": textures.roof_tiles,
    "wood": textures.planks,
    "metal": textures.plaster,
}
_TILES_M: Mapping[Material, float] = {
    "bark": 0.8, "leaves": 1.6, "needles": 1.0, "plaster": 3.0, "bricks": 2.0, "stone": 2.0, "roof": 2.5, "wood": 1.0,
    "metal": 1.0,
}  # fmt: skip


def _tint(rng: Generator, material: Material) -> FloatArray:
    """(3,) linear."""
    match material:
        case "bark":
            pale = rng.random() < 0.2
            return np.array([0.5, 0.47, 0.42] if pale else [0.24, 0.17, 0.11]) * rng.uniform(0.6, 1.4)
        case "leaves":
            return leaf_colour(rng)
        case "needles":
            return np.array([rng.uniform(0.03, 0.09), rng.uniform(0.09, 0.18), rng.uniform(0.02, 0.07)])
        case "bricks":
            return np.array([0.42, 0.2, 0.13]) * rng.uniform(0.6, 1.3)
        case "roof":
            return roof_colour(rng)
        case "wood":
            return np.array([0.26, 0.19, 0.13]) * rng.uniform(0.6, 1.5)
        case "metal":
            return np.full(3, rng.uniform(0.02, 0.08))
        case "plaster" | "stone":
            return paint_colour(rng)
