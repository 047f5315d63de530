"""A random outdoor world from a seed: uneven ground, buildings, trees, street furniture, sun, sky and haze.

NED metres. Outer faces wind counter-clockwise seen from outside; every solid is closed or stands in the ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.core.messages import Float32Array, FloatArray, UInt8Array
from flockd.sim.renderer import _raster, sky
from flockd.sim.world import obstacle_mesh, terrain, textures
from flockd.sim.world.hills import hills
from flockd.sim.world.mesh import face_normals, unit
from flockd.sim.world.obstacles import Obstacles
from flockd.sim.world.scenery import Scenery, footprint_distance
from flockd.sim.world.textures import PackedArray

GROUND_MAP_BITS = 11
SHADOW_MAP_SIZE = 2048
GROUND = -1
"""Texture number of the ground's triangles, which take their colour from the ground map."""


@dataclass(frozen=True, eq=False)
class World:
    """Everything that does not move. Arrays are never changed after generation."""

    seed: int
    extent_m: float
    """Objects stand within this distance of the origin, north and east."""
    vertices: FloatArray
    """(n, 3) NED."""
    triangles: NDArray[np.int32]
    """(m, 3), the ground first."""
    normals: FloatArray
    """(m, 3) outward unit normals, NED."""
    texture: NDArray[np.int32]
    """(m,) texture number, or GROUND."""
    uv: FloatArray
    """(m, 2, 4): texture coordinates in tiles from (n, e, d, 1)."""
    level: FloatArray
    """(m,) log2 of texels per metre."""
    tint: FloatArray
    """(m, 3) linear."""
    texels: PackedArray
    ground_map: PackedArray
    """Pyramid of colour and, in the fourth byte, baked sunlight; rows run north, columns east."""
    ground_kind: UInt8Array
    ground_detail: FloatArray
    """(kinds, 3): texture number, tiles per metre, log2 of texels per metre."""
    ground_heights: FloatArray
    """(cells + 1, cells + 1) metres, up positive, rows north, columns east, from -extent to +extent."""
    obstacles: FloatArray
    """(k, 6) north, east, half length, half width, heading of the length (rad), top height above z = 0."""
    shadow_map: Float32Array
    shadow_frame: FloatArray
    light: FloatArray
    """(5, 3): direction to the sun (NED), sunlight, skylight, light from the ground, haze colour."""
    fog_per_m: float
    sky: PackedArray
    tone: UInt8Array
    """Display byte over the square root of linear light, 1024 entries per unit."""

    @staticmethod
    def generate(
        seed: int,
        *,
        ground_relief_m: float = 0.15,
        keep_out: FloatArray | None = None,
        clearance_m: float = 9.0,
        extent_m: float = 80.0,
        obstacles: Obstacles | None = None,
        hills_m: float = 0.0,
        hills_slope: float = 0.15,
    ) -> World:
        """A world drawn from ``seed``: the same arguments give the same bytes.

        ``ground_relief_m``: standard deviation of the ground's height (0: exactly flat). Nothing taller than 0.3 m
        comes closer than ``clearance_m`` to any of the ``keep_out`` points (n, 2) north, east, but ``obstacles``, which
        stand where they stand, on level ground. ``hills_m`` and ``hills_slope``: see `flockd.sim.world.hills`; their
        ground is added to the relief.
        """
        if extent_m < 20.0:
            raise ValueError(f"extent_m must be at least 20 m, not {extent_m}")
        if keep_out is not None and (keep_out.ndim != 2 or keep_out.shape[1] != 2):
            raise ValueError(f"keep_out must be (n, 2), not {keep_out.shape}")
        rng = np.random.default_rng(seed)
        light, fog, sky_map = sky.draw_sky(rng)
        heights = terrain.relief(rng, extent_m, ground_relief_m)
        if hills_m > 0.0:  # drawn by themselves: the rest of the world is as without them
            heights = heights + hills(np.random.default_rng([seed, 3]), extent_m, hills_m, hills_slope)
        ground_vertices, ground_triangles = terrain.ground_mesh(heights, extent_m)
        scenery = Scenery(rng, heights, extent_m, keep_out, clearance_m, len(ground_vertices))
        if obstacles is not None:
            obstacle_mesh.draw_obstacles(scenery, obstacles, seed)
        mesh, ground_count = scenery.mesh, len(ground_triangles)
        vertices = np.vstack([ground_vertices, *mesh.vertices])
        triangles = np.vstack([ground_triangles, *mesh.triangles]).astype(np.int32)
        uv = np.concatenate([np.zeros((ground_count, 2, 4)), *mesh.uv])
        frame = _shadow_frame(light[0], extent_m)
        shadow = np.full((SHADOW_MAP_SIZE, SHADOW_MAP_SIZE), -1e9, dtype=np.float32)
        _raster.fill_shadow(vertices, triangles[ground_count:], frame, shadow)
        frame[2, 3] += 0.06  # a surface does not shade itself
        ground_map, kinds = _ground_map(rng, scenery, light[0], shadow, frame)
        kind_count = len(scenery.ground_names)
        tiles_per_m = 1.0 / rng.uniform(2.2, 4.5, kind_count)
        return World(
            seed=seed,
            extent_m=extent_m,
            vertices=vertices,
            triangles=triangles,
            normals=face_normals(vertices, triangles),
            texture=np.concatenate([np.full(ground_count, GROUND), *mesh.texture]).astype(np.int32),
            uv=uv,
            level=np.log2(textures.SIZE * np.maximum(1e-6, np.linalg.norm(uv[:, :, :3], axis=2).max(axis=1))),
            tint=np.concatenate([np.ones((ground_count, 3)), *mesh.tint]),
            texels=np.concatenate([textures.pack_pyramid(t) for t in scenery.textures]),
            ground_map=textures.pack_pyramid(ground_map),
            ground_kind=kinds,
            ground_detail=np.column_stack([np.arange(kind_count), tiles_per_m, np.log2(textures.SIZE * tiles_per_m)]),
            ground_heights=heights,
            obstacles=np.array(scenery.obstacles).reshape(-1, 6),
            shadow_map=shadow,
            shadow_frame=frame,
            light=light,
            fog_per_m=fog,
            sky=sky_map,
            tone=sky.tone_curve(rng),
        )

    def height_at(self, north: FloatArray, east: FloatArray) -> FloatArray:
        """(n,) metres of ground above z = 0 (z = -height), on the very triangles drawn; 0 beyond the extent."""
        return terrain.grid_height(
            self.ground_heights, self.extent_m, np.asarray(north, float), np.asarray(east, float)
        )

    def obstacle_distance(self, points: FloatArray) -> FloatArray:
        """(n,) horizontal metres from points (n, 2) to the nearest obstacle's footprint; 0 inside one."""
        return footprint_distance(self.obstacles, points)

    def free_points(
        self, count: int, rng: Generator, min_distance_m: float, *, within_m: float | None = None
    ) -> FloatArray:
        """(count, 2) north, east: uniform over the square of half side ``within_m``, clear of all obstacles.

        Raises ``ValueError`` when the world is too crowded for that.
        """
        reach = self.extent_m - 5.0 if within_m is None else within_m
        found = np.empty((0, 2))
        for _ in range(200):
            points = rng.uniform(-reach, reach, (4 * count, 2))
            found = np.vstack([found, points[self.obstacle_distance(points) >= min_distance_m]])
            if len(found) >= count:
                return found[:count]
        raise ValueError(f"no {count} points {min_distance_m} m away from every obstacle")


def _ground_map(
    rng: Generator, scenery: Scenery, sun: FloatArray, shadow: Float32Array, frame: FloatArray
) -> tuple[Float32Array, UInt8Array]:
    """Colour with baked sunlight (size, size, 4), and the kind of ground, per texel."""
    size = 1 << GROUND_MAP_BITS
    colour = np.empty((size, size, 4), dtype=np.float32)
    kinds = np.empty((size, size), dtype=np.uint8)
    noise = np.stack([
        textures.fractal_noise(rng, slope=rng.uniform(2.0, 2.6), coarsest=0.5),
        textures.fractal_noise(rng, slope=rng.uniform(0.8, 1.3), coarsest=0.4),
        textures.fractal_noise(rng, slope=rng.uniform(0.4, 1.0), coarsest=0.4),
        textures.fractal_noise(rng, slope=1.5, coarsest=0.4),
    ])  # fmt: skip
    cell = 2 * scenery.extent / (scenery.heights.shape[0] - 1)
    slopes = np.stack([np.gradient(scenery.heights, cell, axis=k) for k in (0, 1)])
    _raster.compose_ground(
        noise, scenery.extent, rng.uniform(0.7, 2.5), scenery.zone_limits, scenery.zone_colours, scenery.zone_kinds,
        np.array([rng.uniform(0.12, 0.38), rng.uniform(0.1, 0.35), rng.uniform(0.0, 0.1)]),
        scenery.roads, scenery.road_colours, scenery.patches, scenery.patch_colours, _openness(scenery), slopes, sun,
        shadow, frame, scenery.heights, colour, kinds,
    )  # fmt: skip
    return colour, kinds


def _openness(scenery: Scenery) -> Float32Array:
    """How much of the sky the ground sees beside its obstacles, (512, 512), roughly."""
    size = 512
    cell = 2 * scenery.extent / size
    covered = np.zeros((size, size), dtype=np.float32)
    axis = -scenery.extent + (np.arange(size) + 0.5) * cell
    for north, east, half_length, half_width, heading, top in scenery.obstacles:
        reach = math.hypot(half_length, half_width)
        rows = slice(*np.searchsorted(axis, (north - reach, north + reach)))
        columns = slice(*np.searchsorted(axis, (east - reach, east + reach)))
        dn = axis[rows, None] - north
        de = axis[None, columns] - east
        inside = (np.abs(dn * math.cos(heading) + de * math.sin(heading)) <= half_length) & (
            np.abs(-dn * math.sin(heading) + de * math.cos(heading)) <= half_width
        )
        covered[rows, columns] = np.maximum(covered[rows, columns], inside * min(1.0, 0.3 * top))
    for axis_number in (0, 1, 0, 1, 0, 1):
        covered = np.mean([np.roll(covered, k, axis_number) for k in range(-2, 3)], axis=0, dtype=np.float32)
    return np.asarray(1.0 - 0.45 * covered, dtype=np.float32)


def _shadow_frame(sun: FloatArray, extent: float) -> FloatArray:
    """From NED to the shadow map's columns, rows and height towards the sun."""
    across = unit(np.array([-sun[1], sun[0], 0.0]))
    other = np.cross(sun, across)
    reach = extent * math.sqrt(2.0)
    tall = 25.0
    frame = np.zeros((3, 4))
    frame[0, :3] = across * SHADOW_MAP_SIZE / (2 * reach)
    frame[0, 3] = SHADOW_MAP_SIZE / 2
    half = reach * abs(sun[2]) + tall
    frame[1, :3] = other * SHADOW_MAP_SIZE / (2 * half)
    frame[1, 3] = SHADOW_MAP_SIZE / 2
    frame[2, :3] = sun
    return frame
