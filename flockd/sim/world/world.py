"""A random outdoor world from a seed: uneven ground, buildings, trees, street furniture, sun, sky and haze.

NED metres. Outer faces wind counter-clockwise seen from outside; every solid is closed or stands in the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.core.messages import Float32Array, FloatArray, UInt8Array
from flockd.sim.world import baking, obstacle_mesh, sky, terrain, textures
from flockd.sim.world.mesh import face_normals
from flockd.sim.world.obstacles import Obstacles
from flockd.sim.world.scenery import Scenery, footprint_distance
from flockd.sim.world.terrain import hills
from flockd.sim.world.textures import PackedArray

GROUND = -1
"""Texture number of the ground's triangles, which take their colour from the ground map."""


@dataclass(frozen=True, eq=False)
class World:
    """Everything that does not move. Arrays are never changed after generation."""

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
        seed: int, *, ground_relief_m: float = 0.15, keep_out: FloatArray | None = None, clearance_m: float = 9.0,
        extent_m: float = 80.0, obstacles: Obstacles | None = None, hills_m: float = 0.0, hills_slope: float = 0.15,
    ) -> World:  # fmt: skip
        """A world drawn from ``seed``: the same arguments give the same bytes.

        ``ground_relief_m``: standard deviation of the ground's height (0: exactly flat). Nothing taller than 0.3 m
        comes closer than ``clearance_m`` to any of the ``keep_out`` points (n, 2) north, east, but ``obstacles``, which
        stand where they stand, on level ground. ``hills_m`` and ``hills_slope``: see `flockd.sim.world.terrain`; their
        ground is added to the relief.
        """
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
        shadow, frame = baking.shadow_map(vertices, triangles[ground_count:], light[0], extent_m)
        ground_map, kinds = baking.ground_map(rng, scenery, light[0], shadow, frame)
        kind_count = scenery.ground_kinds
        tiles_per_m = 1.0 / rng.uniform(2.2, 4.5, kind_count)
        return World(
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
        """Heights (n,) m of the ground above z = 0, on the triangles that are drawn; 0 beyond the extent."""
        return terrain.grid_height(self.ground_heights, self.extent_m, north, east)

    def obstacle_distance(self, points: FloatArray) -> FloatArray:
        """Horizontal distances (n,) m from points (n, 2) to the nearest obstacle's footprint; 0 inside one."""
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
