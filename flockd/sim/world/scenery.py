"""What stands and lies on the ground: textures, roads, buildings, trees and street furniture, drawn from a seed."""

from __future__ import annotations

import math
from collections import namedtuple
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from flockd.core.messages import Float32Array, FloatArray
from flockd.sim.world import textures
from flockd.sim.world.mesh import Mesh, Tile
from flockd.sim.world.terrain import grid_height

Spot = tuple[float, float, float]
"""Along a place's heading, across it, and down."""
Ground = namedtuple("Ground", "zone_limits zone_kinds zone_colours roads road_colours patches patch_colours")
"""``zone_limits`` part the noise into zones. Rows of ``roads``: a point (n, e), a direction, half width, sway, sway per
metre, phase, kind, style (0 track, 1 path, 2 marked); of ``patches``: a centre, a direction, half sizes, kind."""


class Scenery:
    """The objects of one world, drawn in a fixed order. Its attributes are for reading only.

    ``textures``: the ground's kinds first. ``obstacles`` as in ``World``.
    """

    def __init__(
        self, rng: Generator, heights: FloatArray, extent: float, keep_out: FloatArray | None, clearance: float,
        first_vertex: int,
    ) -> None:  # fmt: skip
        self.rng, self.heights, self.extent = rng, heights, extent
        self.keep_out, self.clearance = keep_out, clearance
        self.mesh = Mesh(first_vertex)
        self.obstacles: list[tuple[float, float, float, float, float, float]] = []
        kinds = [textures.GROUNDS[i] for i in rng.permutation(len(textures.GROUNDS))[: int(rng.integers(3, 5))]]
        self.ground_kinds = len(kinds)
        self.textures = [draw(rng) for draw in kinds]
        self._choose_textures()
        self.ground = _ground(rng, extent, [draw.__name__ for draw in kinds])
        self.tree_styles = [_TreeStyle.draw(rng, self.leaves) for _ in range(int(rng.integers(1, 4)))]
        # How much of each thing is drawn first, so that worlds differ in kind.
        for draw, most, chance in (
            (self._building, 30, 0.75), (self._container, 14, 0.45), (self._fence, 16, 0.6), (self._car, 24, 0.4),
            (self._pole, 24, 0.55), (self._tree, 130, 0.85), (self._bush, 90, 0.65), (self._rock, 50, 0.5),
            (self._pebble, 120, 0.5),
        ):  # fmt: skip
            for _ in range(int(most * rng.random() ** 1.5) + 1 if rng.random() < chance else 0):
                draw()
        self._horizon()

    def _choose_textures(self) -> None:
        rng, add = self.rng, self.add_texture
        self.leaves = [add(textures.leaves(rng)) for _ in range(2)]
        self.bark = add(textures.bark(rng))
        walls = [textures.WALLS[i](rng) for i in rng.permutation(len(textures.WALLS))[:3]]
        self.walls = [add(wall) for wall in walls]
        self.roofs = [add(textures.ROOFS[i](rng)) for i in rng.permutation(len(textures.ROOFS))[:2]]
        facades = [textures.facade(rng, walls[int(rng.integers(0, 3))], paint_colour(rng)) for _ in range(4)]
        self.facades = [add(facade) for facade in facades]
        self.planks = add(textures.planks(rng))
        self.rock = add(textures.soil(rng))

    def add_texture(self, texture: Float32Array) -> int:
        """Adds a texture; returns its number."""
        self.textures.append(texture)
        return len(self.textures) - 1

    def _place(
        self, half_length: float, half_width: float, top: float, *, off_road: bool = False, gap: float = 0.5
    ) -> _Place | None:
        """A spot for a footprint that keeps clear of the path and of what stands already; None if none was found."""
        rng, narrow = self.rng, min(half_length, half_width)
        reach, standing = math.hypot(half_length, half_width), np.array(self.obstacles).reshape(-1, 6)
        sizes = standing[:, 2:4]
        bound = np.minimum(np.hypot(*sizes.T), 1.3 * sizes.min(axis=1) + 0.5)
        for _ in range(12):
            n, e = rng.uniform(-1, 1, 2) * (self.extent - 4.0 - reach)
            heading = rng.uniform(0, math.pi)
            footprint = np.array([[n, e, half_length, half_width, heading, top]])
            if self.keep_out is not None and footprint_distance(footprint, self.keep_out).min() < self.clearance + 0.05:
                continue
            if off_road and any(
                abs(-(n - r[0]) * r[3] + (e - r[1]) * r[2]) < r[4] + r[5] + narrow for r in self.ground.roads
            ):
                continue
            if (footprint_distance(standing, np.array([[n, e]])) < narrow + gap).any():
                continue
            if (np.hypot(standing[:, 0] - n, standing[:, 1] - e) < bound + reach).any():
                continue
            self.obstacles.append((n, e, half_length, half_width, heading, top))
            return _Place(n, e, heading)
        return None

    def _ground_z(self, place: _Place) -> float:
        return -float(grid_height(self.heights, self.extent, np.array([place.north]), np.array([place.east]))[0])

    def _box(
        self, place: _Place, at: Spot, half: Spot, texture: int, tint: FloatArray, tile: Tile = (2.0, 2.0)
    ) -> None:
        """A box with its middle at ``at`` in the place's axes, turned as the place is."""
        self.mesh.box(place.at(*at), half, place.heading, texture, tint, tile)

    def _blob(
        self, place: _Place, at: Spot, radii: Spot, rough: float, texture: int, tint: FloatArray, tile: float
    ) -> None:
        """A lump with its middle at ``at`` in the place's axes."""
        self.mesh.blob(place.at(*at), np.array(radii), rough, self.rng, texture, tint, tile)

    def _building(self) -> None:
        rng = self.rng
        floors = int(rng.integers(1, 4)) if rng.random() < 0.8 else int(rng.integers(3, 6))
        floor_m = rng.uniform(2.5, 3.6)
        a, b = rng.uniform(2.5, 9.0), rng.uniform(2.0, 5.5)
        wall_m = floors * floor_m
        overhang = rng.uniform(0.05, 0.6)
        roof_m = rng.uniform(0.25, 0.8) * b
        place = self._place(a + overhang, b + overhang, wall_m + roof_m, off_road=True, gap=1.0)
        if place is None:
            return
        z = self._ground_z(place)
        windows = rng.random() < 0.75
        paint = paint_colour(rng)
        facade = int(rng.choice(self.facades)) if windows else int(rng.choice(self.walls))
        tint = np.full(3, 0.5) * rng.uniform(0.75, 1.2) if windows else paint
        bay_m = rng.uniform(2.2, 4.0)
        foundation = 0.6
        for length, turn, out in ((a, 0.0, b), (b, math.pi / 2, a), (a, math.pi, b), (b, -math.pi / 2, a)):
            wall = _Place(place.north, place.east, place.heading + turn)
            ends = (-length, foundation), (length, foundation), (length, -wall_m), (-length, -wall_m)
            corners = np.array([wall.at(x, out, z + d) for x, d in ends])
            bays = max(1, round(2 * length / bay_m))
            tile = (4 * length / bays, 2 * floor_m) if windows else (3.0, 3.0)
            self.mesh.add(corners, _QUAD, facade, tint, tile, wall.at(length, out, z - wall_m))
            if turn == 0.0 and rng.random() < 0.7:
                entrance = rng.uniform(-0.6, 0.6) * length, out, z - 1.0
                self._box(wall, entrance, (0.5, 0.04, 1.05), self.planks, paint_colour(rng), (1.0, 2.0))
        roof_tint = roof_colour(rng)
        roof = int(rng.choice(self.roofs))
        top = z - wall_m
        if rng.random() < 0.35:
            half = (a + 0.5 * overhang, b + 0.5 * overhang, 0.13)
            self._box(place, (0, 0, top - 0.12), half, self.walls[0], roof_tint, (3.0, 3.0))
            for _ in range(int(rng.integers(0, 4))):
                x, y = rng.uniform(-0.7, 0.7) * a, rng.uniform(-0.6, 0.6) * b
                half = tuple(rng.uniform(0.3, 0.9, 3))
                self._box(place, (x, y, top - 0.2 - half[2]), half, self.roofs[1], paint_colour(rng))
            return
        la, lb = a + overhang, b + overhang
        ridge = la if rng.random() < 0.6 else la * rng.uniform(0.0, 0.6)
        eave = top + overhang * roof_m / lb * 0.5
        eaves = [place.at(x * la, y * lb, eave) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        v = np.array([*eaves, place.at(-ridge, 0, top - roof_m), place.at(ridge, 0, top - roof_m)])
        tile = (rng.uniform(1.5, 3.0),) * 2
        gable = (roof, roof_tint) if ridge < la else (self.walls[1], paint)
        self.mesh.add(v, np.array([(0, 5, 1), (0, 4, 5), (2, 4, 3), (2, 5, 4)]), roof, roof_tint, tile, v[4])
        self.mesh.add(v, np.array([(1, 5, 2), (3, 4, 0)]), *gable, tile, v[4])
        self.mesh.add(v, _QUAD, self.planks, paint * 0.6, (2.0, 2.0))
        if rng.random() < 0.6:
            wide = rng.uniform(0.2, 0.45)
            spot = rng.uniform(-0.5, 0.5) * ridge, rng.uniform(-0.4, 0.4) * b, top - roof_m
            self._box(place, spot, (wide, wide, rng.uniform(0.7, 1.3)), self.walls[0], paint_colour(rng), (1.5, 1.5))

    def _container(self) -> None:
        rng = self.rng
        a, b, h = rng.uniform(0.5, 3.2), rng.uniform(0.5, 1.25), rng.uniform(0.4, 1.3)
        place = self._place(a, b, 2 * h)
        if place is not None:
            texture = int(rng.choice([*self.walls, *self.roofs]))
            middle = 0, 0, self._ground_z(place) - h + 0.1
            self._box(place, middle, (a, b, h + 0.1), texture, paint_colour(rng), (2.4, 2.4))

    def _fence(self) -> None:
        rng = self.rng
        a, h = rng.uniform(3.0, 14.0), rng.uniform(0.5, 1.1)
        place = self._place(a, 0.25, 2 * h)
        if place is None:
            return
        tint, style = paint_colour(rng), rng.random()
        sections = max(2, int(a))
        for k in range(sections):
            x = (2 * (k + 0.5) / sections - 1) * a
            north, east, _ = place.at(x, 0, 0)
            piece = _Place(north, east, place.heading)
            z, half = self._ground_z(piece), a / sections
            if style < 0.35:  # wall
                self._box(piece, (0, 0, z - h + 0.2), (half, 0.12, h + 0.2), self.walls[1], tint)
            elif style < 0.55:  # hedge
                inside = 0, 0, z - h + 0.2
                self._box(piece, inside, (half, 0.24, h + 0.2), self.leaves[0], leaf_colour(rng), (1.2, 1.2))
            else:
                self._box(piece, (half, 0, z - h + 0.2), (0.06, 0.06, h + 0.25), self.planks, tint, (1.0, 1.0))
                rails, thick = ((0.35, 1.0, 1.65), 0.08) if style < 0.8 else ((0.95,), 0.75 * h)
                for level in rails:
                    rail = 0, 0, z - level * h - 0.05
                    self._box(piece, rail, (half, 0.025, thick), self.planks, tint, (1.0, 1.0))

    def _car(self) -> None:
        rng = self.rng
        length, width = rng.uniform(1.8, 2.5), rng.uniform(0.8, 0.95)
        place = self._place(length, width, 1.6)
        if place is None:
            return
        z = self._ground_z(place)
        paint = paint_colour(rng)
        cabin, roof = (0.55 * length, 0.88 * width, 0.26), (0.5 * length, 0.85 * width, 0.04)
        self._box(place, (0, 0, z - 0.58), (length, width, 0.3), self.rock, paint, (4.0, 4.0))
        self._box(place, (-0.15 * length, 0, z - 1.14), cabin, self.facades[0], np.full(3, 0.12), (9.0, 9.0))
        self._box(place, (-0.15 * length, 0, z - 1.43), roof, self.rock, paint, (4.0, 4.0))
        for x in (-0.62, 0.62):
            for y in (-1.0, 1.0):
                hub = place.at(x * length, y * (width - 0.12), z - 0.31)
                out = place.at(x * length, y * (width + 0.03), z - 0.31)
                self.mesh.frustum(hub, out, (0.32, 0.32), 10, self.rock, np.full(3, 0.05))

    def _pole(self) -> None:
        rng = self.rng
        h, r = rng.uniform(2.0, 8.0), rng.uniform(0.04, 0.13)
        place = self._place(0.5, 0.5, h)
        if place is None:
            return
        z = self._ground_z(place)
        tint = paint_colour(rng)
        self.mesh.frustum(place.at(0, 0, z + 0.3), place.at(0, 0, z - h), (r, 0.7 * r), 8, self.rock, tint)
        style = rng.random()
        if style < 0.4:
            self._box(place, (0.25, 0, z - h), (0.35, 0.1, 0.06), self.rock, tint)
        elif style < 0.75:
            sign = r, 0, z - h + 0.4
            self._box(place, sign, (0.02, 0.35, 0.35), self.facades[1], paint_colour(rng), (0.9, 0.9))
        else:
            self._blob(place, (0, 0, z - h), (0.2, 0.2, 0.2), 0.0, self.rock, np.full(3, 0.5), 2.0)

    def _tree(self) -> None:
        rng = self.rng
        style = self.tree_styles[int(rng.integers(0, len(self.tree_styles)))]
        height = style.height * rng.uniform(0.7, 1.3)
        crown = min(style.crown * height, 3.5) * rng.uniform(0.8, 1.2)
        place = self._place(crown, crown, height, off_road=rng.random() < 0.9, gap=-0.4 * crown)
        if place is None:
            return
        z, mesh = self._ground_z(place), self.mesh
        tint = style.colour * rng.uniform(0.75, 1.25)
        trunk_tint = np.array([0.22, 0.15, 0.1]) * rng.uniform(0.6, 1.8)
        r = 0.02 * height + 0.06
        bare = style.bare * height
        top = place.at(0, 0, z - max(bare + 0.3, 0.75 * height))
        mesh.frustum(place.at(0, 0, z + 0.3), top, (r, 0.5 * r), 7, self.bark, trunk_tint)
        if style.shape == "cone":
            for k in range(style.layers):
                low = bare + (height - bare) * k / style.layers * 0.85
                high = low + (height - low) * (0.75 if k < style.layers - 1 else 1.0)
                foot, tip = place.at(0, 0, z - low), place.at(0, 0, z - high)
                radii = (crown * (1 - 0.75 * k / style.layers), 0.0)
                mesh.frustum(foot, tip, radii, 9, style.texture, tint * (1 + 0.1 * k), (1.5, 1.5))
        elif style.shape in ("column", "round"):
            share, rough, tile = (0.45, 0.12, 1.6) if style.shape == "column" else (0.9, 0.14, 2.0)
            radius, middle = share * crown, (0, 0, z - (bare + height) / 2)
            self._blob(place, middle, (radius, radius, (height - bare) / 2), rough, style.texture, tint, tile)
        elif style.shape == "cloud":
            for _ in range(style.layers + 2):
                x, y = rng.uniform(-0.55, 0.55, 2) * crown
                size = rng.uniform(0.35, 0.55) * crown
                up = rng.uniform(bare + 0.5 * size, max(bare + 0.6 * size, height - size))
                shade = tint * rng.uniform(0.85, 1.15)
                self._blob(place, (x, y, z - up), (size, size, 0.8 * size), 0.16, style.texture, shade, 1.6)
        else:  # bare branches
            for _ in range(9):
                foot = place.at(0, 0, z - rng.uniform(0.35, 0.72) * height)
                angle = rng.uniform(0, 6.28)
                tip = foot + np.array([math.cos(angle), math.sin(angle), -rng.uniform(0.3, 1.2)]) * 0.8 * crown
                mesh.frustum(foot, tip, (0.35 * r, 0.1 * r), 5, self.bark, trunk_tint)

    def _bush(self) -> None:
        rng = self.rng
        r = rng.uniform(0.25, 1.1)
        place = self._place(r, r, 1.3 * r, gap=-0.3)
        if place is not None:
            middle, radii = (0, 0, self._ground_z(place) - 0.5 * r), (0.8 * r, 0.8 * r, 0.7 * r)
            self._blob(place, middle, radii, 0.2, int(rng.choice(self.leaves)), leaf_colour(rng), 1.2)

    def _rock(self) -> None:
        rng = self.rng
        r = rng.uniform(0.15, 0.8)
        place = self._place(r, r, r, gap=-0.2)
        if place is not None:
            radii = tuple(r * rng.uniform(0.55, 0.8, 3))
            colour = np.full(3, rng.uniform(0.15, 0.5)) * rng.uniform(0.85, 1.1, 3)
            self._blob(place, (0, 0, self._ground_z(place) - 0.2 * r), radii, 0.2, self.rock, colour, 1.5)

    def _pebble(self) -> None:
        """Low things may lie under the path too."""
        rng = self.rng
        place = _Place(rng.uniform(-0.9, 0.9) * self.extent, rng.uniform(-0.9, 0.9) * self.extent, 0.0)
        size = rng.uniform(0.05, 0.2)
        middle = 0, 0, self._ground_z(place)
        if rng.random() < 0.6:
            tint = np.full(3, rng.uniform(0.1, 0.6))
            self._blob(place, middle, (size, size, 0.7 * size), 0.2, self.rock, tint, 0.8)
        else:
            self._blob(place, middle, (size, size, 0.8 * size), 0.25, self.leaves[1], leaf_colour(rng), 0.8)

    def _horizon(self) -> None:
        """Far woods and hills beyond the extent: a ring of lumps, none nearer than 1.3 extents."""
        rng = self.rng
        for _ in range(int(rng.choice([0, 12, 25, 40]))):
            bearing, away = rng.uniform(0, 2 * math.pi), self.extent * rng.uniform(1.9, 4.5)
            wide, high = rng.uniform(8, 35), rng.uniform(4, 16)
            centre = np.array([away * math.cos(bearing), away * math.sin(bearing), 0.2 * high])
            self.mesh.blob(centre, np.array([wide, wide, high]), 0.12, rng, self.leaves[0], leaf_colour(rng) * 0.8, 6.0)


def footprint_distance(obstacles: FloatArray, points: FloatArray) -> FloatArray:
    """Horizontal distances (n,) m from points (n, 2) to the nearest of the rectangles; 0 inside."""
    nearest = np.full(len(points), np.inf)
    for north, east, half_length, half_width, heading, _ in obstacles:
        dn, de = points[:, 0] - north, points[:, 1] - east
        along = np.abs(dn * math.cos(heading) + de * math.sin(heading)) - half_length
        across = np.abs(-dn * math.sin(heading) + de * math.cos(heading)) - half_width
        nearest = np.minimum(nearest, np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0)))
    return nearest


_QUAD = np.array([(0, 1, 2), (0, 2, 3)])


class _Place(NamedTuple):
    north: float
    east: float
    heading: float

    def at(self, along: float, across: float, down: float) -> FloatArray:
        c, s = math.cos(self.heading), math.sin(self.heading)
        return np.array([self.north + along * c - across * s, self.east + along * s + across * c, down])


class _TreeStyle(NamedTuple):
    shape: str
    height: float
    crown: float
    bare: float
    layers: int
    texture: int
    colour: FloatArray

    @staticmethod
    def draw(rng: Generator, leaves: list[int]) -> _TreeStyle:
        shape = str(rng.choice(["cone", "round", "cloud", "cloud", "column", "bare"]))
        height, crown, bare = rng.uniform(2.5, 10.0), rng.uniform(0.2, 0.45), rng.uniform(0.08, 0.4)
        layers, texture = int(rng.integers(2, 5)), int(rng.choice(leaves))
        return _TreeStyle(shape, height, crown, bare, layers, texture, leaf_colour(rng))


def leaf_colour(rng: Generator) -> FloatArray:
    """Green mostly; sometimes autumn or blossom."""
    if rng.random() < 0.8:
        return np.array([rng.uniform(0.05, 0.2), rng.uniform(0.14, 0.32), rng.uniform(0.02, 0.09)])
    return np.array([rng.uniform(0.25, 0.5), rng.uniform(0.1, 0.32), rng.uniform(0.03, 0.2)])


def paint_colour(rng: Generator) -> FloatArray:
    """Any wall's or machine's colour: mostly muted, sometimes strong."""
    grey = rng.uniform(0.06, 0.7)
    strength = rng.uniform(0.0, 0.25) if rng.random() < 0.65 else rng.uniform(0.4, 0.85)
    return np.asarray(np.clip(grey * (1 - strength) + strength * grey * 2.2 * rng.random(3), 0.02, 0.8))


def roof_colour(rng: Generator) -> FloatArray:
    """Red, grey, brown or green."""
    bases = np.array([(0.4, 0.14, 0.08), (0.2, 0.2, 0.22), (0.3, 0.22, 0.15), (0.15, 0.22, 0.2)])
    base = bases[int(rng.integers(0, 4))]
    return np.asarray(np.clip(base * rng.uniform(0.6, 1.6) * rng.uniform(0.85, 1.15, 3), 0.03, 0.7))


_GROUND_COLOURS = {
    "grass": (0.16, 0.22, 0.06), "soil": (0.27, 0.19, 0.12), "gravel": (0.32, 0.3, 0.27), "asphalt": (0.14, 0.14, 0.15),
    "paving": (0.34, 0.32, 0.3), "bricks": (0.3, 0.18, 0.14), "stone_cells": (0.33, 0.3, 0.25),
}  # fmt: skip


def _ground(rng: Generator, extent: float, names: list[str]) -> Ground:
    """Zones, roads and paved rectangles, and their colours; ``names`` of the kinds."""

    def colours(kinds: list[int]) -> FloatArray:
        drawn = [
            np.array(_GROUND_COLOURS[names[kind]]) * rng.uniform(0.55, 1.4) * rng.uniform(0.85, 1.15, 3)
            for kind in kinds
        ]
        return np.clip(np.array(drawn).reshape(-1, 3), 0.02, 0.7)

    count = int(rng.integers(1, 5))
    zone_limits = np.sort(rng.uniform(-0.9, 0.9, count - 1))
    zone_kinds = rng.integers(0, len(names), count)
    zone_colours = colours(zone_kinds.tolist())
    roads, patches = [], []
    for _ in range(int(rng.choice([0, 1, 1, 2, 2, 3]))):
        heading = rng.uniform(0, math.pi)
        style = int(rng.integers(0, 3))
        half_width = (rng.uniform(0.8, 1.8), rng.uniform(0.6, 2.0), rng.uniform(2.2, 4.5))[style]
        n, e = rng.uniform(-0.6, 0.6, 2) * extent
        sway = rng.uniform(0.0, 4.0) if rng.random() < 0.6 else 0.0
        wave, phase = 2 * math.pi / rng.uniform(25, 90), rng.uniform(0, 6.28)
        kind = int(rng.integers(0, len(names)))
        roads.append((n, e, math.cos(heading), math.sin(heading), half_width, sway, wave, phase, kind, style))
    road_colours = colours([road[8] for road in roads])
    for _ in range(int(rng.choice([0, 0, 1, 3, 8, 20]))):
        heading = rng.uniform(0, math.pi)
        n, e = rng.uniform(-0.9, 0.9, 2) * extent
        a, b = np.exp(rng.uniform(math.log(0.6), math.log(12.0), 2))
        patches.append((n, e, math.cos(heading), math.sin(heading), a, b, int(rng.integers(0, len(names)))))
    return Ground(
        zone_limits, zone_kinds, zone_colours, np.array(roads, dtype=float).reshape(-1, 10), road_colours,
        np.array(patches, dtype=float).reshape(-1, 7), colours([patch[6] for patch in patches]),
    )  # fmt: skip
