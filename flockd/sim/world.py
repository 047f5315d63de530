"""A random outdoor world from a seed: uneven ground, buildings, trees, street furniture, sun, sky and haze.

NED metres. Outer faces wind counter-clockwise seen from outside; every solid is closed or stands in the ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.messages import Float32Array, FloatArray, IntArray, UInt8Array
from flockd.sim import _raster, textures
from flockd.sim.mesh import Mesh, unit
from flockd.sim.textures import PackedArray

GROUND_CELL_M = 2.0
GROUND_MAP_BITS = 11
SHADOW_MAP_SIZE = 2048
SKY_BITS = 9
HORIZON_M = 1500.0
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
    ) -> World:
        """A world drawn from ``seed``: the same arguments give the same bytes.

        ``ground_relief_m``: standard deviation of the ground's height (0: exactly flat). Nothing taller than 0.3 m
        comes closer than ``clearance_m`` to any of the ``keep_out`` points (n, 2) north, east.
        """
        if extent_m < 20.0:
            raise ValueError(f"extent_m must be at least 20 m, not {extent_m}")
        if keep_out is not None and (keep_out.ndim != 2 or keep_out.shape[1] != 2):
            raise ValueError(f"keep_out must be (n, 2), not {keep_out.shape}")
        rng = np.random.default_rng(seed)
        return _Generator(rng, ground_relief_m, keep_out, clearance_m, extent_m).world(seed)

    def height_at(self, north: FloatArray, east: FloatArray) -> FloatArray:
        """(n,) metres of ground above z = 0 (z = -height), on the very triangles that are drawn; 0 beyond the extent."""
        return _grid_height(self.ground_heights, self.extent_m, np.asarray(north, float), np.asarray(east, float))

    def obstacle_distance(self, points: FloatArray) -> FloatArray:
        """(n,) horizontal metres from points (n, 2) to the nearest obstacle's footprint; 0 inside one."""
        return _footprint_distance(self.obstacles, points)

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


def _grid_height(heights: FloatArray, extent: float, north: FloatArray, east: FloatArray) -> FloatArray:
    cells = heights.shape[0] - 1
    fn = (north / extent + 1.0) * 0.5 * cells
    fe = (east / extent + 1.0) * 0.5 * cells
    inside = (fn >= 0) & (fn <= cells) & (fe >= 0) & (fe <= cells)
    i = np.clip(np.floor(fn).astype(np.int64), 0, cells - 1)
    j = np.clip(np.floor(fe).astype(np.int64), 0, cells - 1)
    a, b = fn - i, fe - j
    h00, h10, h01, h11 = heights[i, j], heights[i + 1, j], heights[i, j + 1], heights[i + 1, j + 1]
    north_half = h00 + a * (h10 - h00) + b * (h11 - h10)
    east_half = h00 + b * (h01 - h00) + a * (h11 - h01)
    return np.where(inside, np.where(a >= b, north_half, east_half), 0.0)


def _footprint_distance(obstacles: FloatArray, points: FloatArray) -> FloatArray:
    if len(obstacles) == 0:
        return np.full(len(points), np.inf)
    nearest = np.full(len(points), np.inf)
    for north, east, half_length, half_width, heading, _ in obstacles:
        dn, de = points[:, 0] - north, points[:, 1] - east
        along = np.abs(dn * math.cos(heading) + de * math.sin(heading)) - half_length
        across = np.abs(-dn * math.sin(heading) + de * math.cos(heading)) - half_width
        nearest = np.minimum(nearest, np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0)))
    return nearest


@dataclass(frozen=True)
class _Place:
    north: float
    east: float
    heading: float

    def at(self, along: float, across: float, down: float) -> FloatArray:
        c, s = math.cos(self.heading), math.sin(self.heading)
        return np.array([self.north + along * c - across * s, self.east + along * s + across * c, down])


class _Generator:
    """The draws that make one world, in a fixed order."""

    def __init__(
        self, rng: Generator, relief: float, keep_out: FloatArray | None, clearance: float, extent: float
    ) -> None:
        self.rng = rng
        self.extent = extent
        self.keep_out = keep_out
        self.clearance = clearance
        self.mesh = Mesh()
        self.obstacles: list[tuple[float, float, float, float, float, float]] = []
        self.textures: list[Float32Array] = []
        self.heights = self._relief(relief)

    def world(self, seed: int) -> World:
        rng = self.rng
        light, fog, sky = self._sky()
        self._choose_textures()
        self._choose_ground()
        ground_vertices, ground_triangles = self._ground_mesh()
        self.mesh.count = len(ground_vertices)
        self._populate()
        self._horizon()
        mesh = self.mesh
        ground_count = len(ground_triangles)
        vertices = np.ascontiguousarray(np.vstack([ground_vertices, *mesh.vertices]))
        triangles = np.ascontiguousarray(np.vstack([ground_triangles, *mesh.triangles]).astype(np.int32))
        corner = vertices[triangles]
        normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        normals /= np.maximum(1e-12, np.linalg.norm(normals, axis=1, keepdims=True))
        uv = np.concatenate([np.zeros((ground_count, 2, 4)), *mesh.uv])
        tiles_per_m = 1.0 / rng.uniform(2.2, 4.5, self.ground_kinds)
        sun = light[0]
        frame = self._shadow_frame(sun)
        shadow = np.full((SHADOW_MAP_SIZE, SHADOW_MAP_SIZE), -1e9, dtype=np.float32)
        _raster.fill_shadow(vertices, triangles[ground_count:], frame, shadow)
        lookup = frame.copy()
        lookup[2, 3] += 0.06  # a surface does not shade itself
        ground_map, kinds = self._ground_map(sun, shadow, lookup)
        return World(
            seed=seed,
            extent_m=self.extent,
            vertices=vertices,
            triangles=triangles,
            normals=normals,
            texture=np.concatenate([np.full(ground_count, GROUND), *mesh.texture]).astype(np.int32),
            uv=uv,
            level=np.log2(textures.SIZE * np.maximum(1e-6, np.linalg.norm(uv[:, :, :3], axis=2).max(axis=1))),
            tint=np.concatenate([np.ones((ground_count, 3)), *mesh.tint]),
            texels=np.concatenate([textures.pack_pyramid(t) for t in self.textures]),
            ground_map=textures.pack_pyramid(ground_map),
            ground_kind=kinds,
            ground_detail=np.column_stack(
                [np.arange(self.ground_kinds), tiles_per_m, np.log2(textures.SIZE * tiles_per_m)]
            ),
            ground_heights=self.heights,
            obstacles=np.array(self.obstacles).reshape(-1, 6),
            shadow_map=shadow,
            shadow_frame=lookup,
            light=light,
            fog_per_m=fog,
            sky=sky,
            tone=_tone_curve(rng),
        )

    # --- Ground -----------------------------------------------------------------------------------------------------

    def _relief(self, relief: float) -> FloatArray:
        """Heights of the ground grid: waves of 8-40 m, mean 0, zero along the border."""
        cells = max(2, round(2 * self.extent / GROUND_CELL_M))
        axis = np.linspace(-self.extent, self.extent, cells + 1)
        heights = np.zeros((cells + 1, cells + 1))
        for _ in range(24):
            wavelength = math.exp(self.rng.uniform(math.log(8.0), math.log(40.0)))
            heading, phase = self.rng.uniform(0, 2 * math.pi, 2)
            k = 2 * math.pi / wavelength
            wave = np.cos(k * (math.cos(heading) * axis[:, None] + math.sin(heading) * axis[None, :]) + phase)
            heights += wavelength * wave
        border = np.clip((self.extent - np.abs(axis)) / 12.0, 0.0, 1.0)
        fade = border[:, None] * border[None, :]
        heights -= (heights * fade).sum() / fade.sum()
        heights *= fade
        return heights * (relief / heights.std())

    def _ground_mesh(self) -> tuple[FloatArray, IntArray]:
        """The grid, and a flat skirt from its border to the horizon."""
        cells = self.heights.shape[0] - 1
        axis = np.linspace(-self.extent, self.extent, cells + 1)
        north, east = np.meshgrid(axis, axis, indexing="ij")
        grid = np.stack([north, east, -self.heights], axis=-1).reshape(-1, 3)
        index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
        a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
        inner = np.vstack([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
        ring = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
        outer = grid[ring] * (HORIZON_M / self.extent) * np.array([1.0, 1.0, 0.0])
        k = np.arange(len(ring))
        following = (k + 1) % len(ring)
        far = len(grid) + k
        skirt = np.vstack([np.stack([ring, ring[following], far], 1),
                           np.stack([ring[following], len(grid) + following, far], 1)])  # fmt: skip
        # The order of the draw does not matter, the orientation does: up.
        vertices = np.vstack([grid, outer])
        triangles = np.vstack([inner, skirt])
        corner = vertices[triangles]
        up = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2] < 0
        triangles[~up] = triangles[~up][:, [0, 2, 1]]
        return vertices, triangles

    def _choose_ground(self) -> None:
        """Zones, roads and paved rectangles, and their colours."""
        rng = self.rng
        count = int(rng.integers(1, 5))
        self.zone_limits = np.sort(rng.uniform(-0.9, 0.9, count - 1))
        self.zone_kinds = rng.integers(0, self.ground_kinds, count)
        self.zone_colours = np.array([_ground_colour(rng, self.ground_names[k]) for k in self.zone_kinds])
        roads = []
        for _ in range(int(rng.choice([0, 1, 1, 2, 2, 3]))):
            heading = rng.uniform(0, math.pi)
            style = float(rng.integers(0, 3))  # track, path, marked road
            half_width = {0.0: rng.uniform(0.8, 1.8), 1.0: rng.uniform(0.6, 2.0), 2.0: rng.uniform(2.2, 4.5)}[style]
            n, e = rng.uniform(-0.6, 0.6, 2) * self.extent
            sway = rng.uniform(0.0, 4.0) if rng.random() < 0.6 else 0.0
            roads.append((n, e, math.cos(heading), math.sin(heading), half_width, sway,
                          2 * math.pi / rng.uniform(25, 90), rng.uniform(0, 6.28), rng.integers(0, self.ground_kinds), style))  # fmt: skip
        self.roads = np.array(roads, dtype=float).reshape(-1, 10)
        self.road_colours = np.array([_ground_colour(rng, self.ground_names[int(r[8])]) for r in roads]).reshape(-1, 3)
        patches = []
        for _ in range(int(rng.choice([0, 0, 1, 3, 8, 20]))):
            heading = rng.uniform(0, math.pi)
            n, e = rng.uniform(-0.9, 0.9, 2) * self.extent
            a, b = np.exp(rng.uniform(math.log(0.6), math.log(12.0), 2))
            patches.append((n, e, math.cos(heading), math.sin(heading), a, b, rng.integers(0, self.ground_kinds)))
        self.patches = np.array(patches, dtype=float).reshape(-1, 7)
        self.patch_colours = np.array([_ground_colour(rng, self.ground_names[int(p[6])]) for p in patches]).reshape(
            -1, 3
        )

    def _ground_map(self, sun: FloatArray, shadow: Float32Array, frame: FloatArray) -> tuple[Float32Array, UInt8Array]:
        rng = self.rng
        size = 1 << GROUND_MAP_BITS
        colour = np.empty((size, size, 4), dtype=np.float32)
        kinds = np.empty((size, size), dtype=np.uint8)
        noise = np.stack([
            textures.fractal_noise(rng, slope=rng.uniform(2.0, 2.6), coarsest=0.5),
            textures.fractal_noise(rng, slope=rng.uniform(0.8, 1.3), coarsest=0.4),
            textures.fractal_noise(rng, slope=rng.uniform(0.4, 1.0), coarsest=0.4),
            textures.fractal_noise(rng, slope=1.5, coarsest=0.4),
        ])  # fmt: skip
        cell = 2 * self.extent / (self.heights.shape[0] - 1)
        slopes = np.stack(np.gradient(self.heights, cell))
        _raster.compose_ground(
            noise, self.extent, rng.uniform(0.7, 2.5), self.zone_limits, self.zone_colours, self.zone_kinds,
            np.array([rng.uniform(0.12, 0.38), rng.uniform(0.1, 0.35), rng.uniform(0.0, 0.1)]),
            self.roads, self.road_colours, self.patches, self.patch_colours, self._openness(), slopes, sun, shadow,
            frame, self.heights, colour, kinds,
        )  # fmt: skip
        return colour, kinds

    def _openness(self) -> Float32Array:
        """How much of the sky the ground sees beside its obstacles, (512, 512), roughly."""
        size = 512
        cell = 2 * self.extent / size
        covered = np.zeros((size, size), dtype=np.float32)
        axis = -self.extent + (np.arange(size) + 0.5) * cell
        for north, east, half_length, half_width, heading, top in self.obstacles:
            reach = math.hypot(half_length, half_width)
            rows = slice(*np.searchsorted(axis, (north - reach, north + reach)))
            columns = slice(*np.searchsorted(axis, (east - reach, east + reach)))
            dn = axis[rows, None] - north
            de = axis[None, columns] - east
            inside = (np.abs(dn * math.cos(heading) + de * math.sin(heading)) <= half_length) & (
                np.abs(-dn * math.sin(heading) + de * math.cos(heading)) <= half_width
            )
            covered[rows, columns] = np.maximum(covered[rows, columns], inside * min(1.0, 0.3 * top))
        for _ in range(3):
            for axis_number in (0, 1):
                total = np.cumsum(
                    np.pad(covered, [(3, 2) if k == axis_number else (0, 0) for k in (0, 1)], mode="edge"),
                    axis=axis_number,
                )
                upper = np.take(total, np.arange(5, total.shape[axis_number]), axis=axis_number)
                lower = np.take(total, np.arange(0, total.shape[axis_number] - 5), axis=axis_number)
                covered = (upper - lower) / 5
        return np.asarray(1.0 - 0.45 * covered, dtype=np.float32)

    # --- Light ------------------------------------------------------------------------------------------------------

    def _sky(self) -> tuple[FloatArray, float, PackedArray]:
        """Sun, skylight, haze and the sky's map. Scaled so that level ground receives about 1."""
        rng = self.rng
        elevation, azimuth = math.radians(rng.uniform(25, 70)), rng.uniform(0, 2 * math.pi)
        sun = np.array(
            [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), -math.sin(elevation)]
        )
        overcast = float(rng.choice([0.0, 0.0, rng.uniform(0, 0.6), rng.uniform(0.7, 1.0)]))
        warm = (math.radians(70) - elevation) / math.radians(45) * rng.uniform(0.3, 1.0)
        sun_colour = np.array([1.0, 1.0 - 0.14 * warm, 1.0 - 0.38 * warm]) * (1.0 - 0.92 * overcast)
        blue = np.array([0.62, 0.8, 1.1]) * rng.uniform(0.93, 1.07, 3)
        skylight = (blue * (1 - overcast) + np.array([0.95, 1.0, 1.05]) * overcast) * rng.uniform(0.16, 0.36)
        skylight = skylight * (1.0 + 1.5 * overcast)
        irradiance = float((sun_colour * math.sin(elevation) + skylight).mean())
        exposure = 2.0 ** rng.uniform(-0.55, 0.35) / irradiance
        sun_colour, skylight = sun_colour * exposure, skylight * exposure
        bounce = rng.uniform(0.15, 0.3) * (sun_colour * math.sin(elevation) + skylight) * rng.uniform(0.8, 1.0, 3)
        zenith = (
            (np.array([0.1, 0.24, 0.62]) * (1 - overcast) + 0.42 * overcast)
            * rng.uniform(0.75, 1.2)
            * rng.uniform(0.93, 1.07, 3)
        )
        horizon = (
            (np.array([0.55, 0.68, 0.85]) * (1 - overcast) + 0.62 * overcast)
            * rng.uniform(0.7, 1.15)
            * rng.uniform(0.95, 1.05, 3)
        )
        fog = math.exp(rng.uniform(math.log(0.0006), math.log(0.007)))

        size = 1 << SKY_BITS
        t = (np.arange(size) + 0.5) / size - 0.5
        a, b = t[None, :], t[:, None]
        north, east = a + b, a - b
        up = np.maximum(0.0, 1.0 - np.abs(north) - np.abs(east))
        norm = np.sqrt(north**2 + east**2 + up**2)
        north, east, up = north / norm, east / norm, up / norm
        height = np.clip(up, 0, 1)[..., None] ** rng.uniform(0.4, 0.7)
        sky = horizon * (1 - height) + zenith * height
        toward = np.clip(north * sun[0] + east * sun[1] - up * sun[2], 0, 1)[..., None]
        sky = sky + sun_colour * (0.25 * toward**8 + 0.8 * toward**120) * (1 - overcast)
        clouds = textures.fractal_noise(rng, size, slope=rng.uniform(1.3, 1.8), coarsest=0.3)
        drop = rng.uniform(2.5, 6.0) * (up + 0.12)
        column = (north / drop * size).astype(np.int64) % size
        row = (east / drop * size).astype(np.int64) % size
        density = clouds[row, column]
        cover = rng.uniform(-1.3, 0.6) + 1.5 * overcast
        amount = np.clip((density + cover) * rng.uniform(0.5, 1.5), 0, 1)[..., None] * np.clip(up * 5, 0, 1)[..., None]
        white = (0.95 * (1 - overcast) + 0.8 * overcast) * (1.15 - 0.25 * np.clip(density, 0, 2)[..., None])
        sky = sky * (1 - amount) + white * amount
        light = np.stack([sun, sun_colour, skylight, bounce, horizon])
        return light, fog, textures.pack_pyramid((sky / 4.0).astype(np.float32))[: size * size]

    def _shadow_frame(self, sun: FloatArray) -> FloatArray:
        """From NED to the shadow map's columns, rows and height towards the sun."""
        across = unit(np.array([-sun[1], sun[0], 0.0]))
        other = np.cross(sun, across)
        reach = self.extent * math.sqrt(2.0)
        tall = 25.0
        frame = np.zeros((3, 4))
        frame[0, :3] = across * SHADOW_MAP_SIZE / (2 * reach)
        frame[0, 3] = SHADOW_MAP_SIZE / 2
        half = reach * abs(sun[2]) + tall
        frame[1, :3] = other * SHADOW_MAP_SIZE / (2 * half)
        frame[1, 3] = SHADOW_MAP_SIZE / 2
        frame[2, :3] = sun
        return frame

    # --- Textures ---------------------------------------------------------------------------------------------------

    def _choose_textures(self) -> None:
        rng = self.rng
        names = rng.permutation(len(textures.GROUNDS))[: int(rng.integers(3, 5))]
        self.ground_names = [textures.GROUNDS[i].__name__ for i in names]
        self.ground_kinds = len(names)
        self.textures = [textures.GROUNDS[i](rng) for i in names]
        self.leaves = [self._texture(textures.leaves(rng)) for _ in range(2)]
        self.bark = self._texture(textures.bark(rng))
        walls = [textures.WALLS[i](rng) for i in rng.permutation(len(textures.WALLS))[:3]]
        self.walls = [self._texture(w) for w in walls]
        self.roofs = [self._texture(textures.ROOFS[i](rng)) for i in rng.permutation(len(textures.ROOFS))[:2]]
        self.facades = [
            self._texture(textures.facade(rng, walls[int(rng.integers(0, 3))], _paint(rng))) for _ in range(4)
        ]
        self.planks = self._texture(textures.planks(rng))
        self.rock = self._texture(textures.soil(rng))

    def _texture(self, texture: Float32Array) -> int:
        self.textures.append(texture)
        return len(self.textures) - 1

    # --- Things -----------------------------------------------------------------------------------------------------

    def _populate(self) -> None:
        """Fill the world: how much of each thing is drawn first, so that worlds differ in kind."""
        rng = self.rng

        def some(most: int, chance: float) -> int:
            return int(most * rng.random() ** 1.5) + 1 if rng.random() < chance else 0

        self.tree_styles = [_TreeStyle.draw(rng, self.leaves) for _ in range(int(rng.integers(1, 4)))]
        for _ in range(some(30, 0.75)):
            self._building()
        for _ in range(some(14, 0.45)):
            self._container()
        for _ in range(some(16, 0.6)):
            self._fence()
        for _ in range(some(24, 0.4)):
            self._car()
        for _ in range(some(24, 0.55)):
            self._pole()
        for _ in range(some(130, 0.85)):
            self._tree()
        for _ in range(some(90, 0.65)):
            self._bush()
        for _ in range(some(50, 0.5)):
            self._rock()
        for _ in range(some(120, 0.5)):
            self._pebble()

    def _place(
        self, half_length: float, half_width: float, top: float, *, off_road: bool = False, gap: float = 0.5
    ) -> _Place | None:
        """A spot for a footprint that keeps clear of the path and of what stands already; None if none was found."""
        rng = self.rng
        reach = math.hypot(half_length, half_width)
        for _ in range(12):
            n, e = rng.uniform(-1, 1, 2) * (self.extent - 4.0 - reach)
            heading = rng.uniform(0, math.pi)
            footprint = np.array([[n, e, half_length, half_width, heading, top]])
            if (
                self.keep_out is not None
                and _footprint_distance(footprint, self.keep_out).min() < self.clearance + 0.05
            ):
                continue
            if off_road and any(
                abs(-(n - r[0]) * r[3] + (e - r[1]) * r[2]) < r[4] + r[5] + min(half_length, half_width)
                for r in self.roads
            ):
                continue
            if self.obstacles:
                standing = np.array(self.obstacles)
                if (_footprint_distance(standing, np.array([[n, e]])) < min(half_length, half_width) + gap).any():
                    continue
                distance = np.hypot(standing[:, 0] - n, standing[:, 1] - e)
                bound = np.minimum(
                    np.hypot(standing[:, 2], standing[:, 3]), 1.3 * np.minimum(standing[:, 2], standing[:, 3]) + 0.5
                )
                if (distance < bound + reach).any():
                    continue
            self.obstacles.append((n, e, half_length, half_width, heading, top))
            return _Place(n, e, heading)
        return None

    def _ground_z(self, place: _Place) -> float:
        return -float(_grid_height(self.heights, self.extent, np.array([place.north]), np.array([place.east]))[0])

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
        paint = _paint(rng)
        facade = int(rng.choice(self.facades)) if windows else int(rng.choice(self.walls))
        tint = np.full(3, 0.5) * rng.uniform(0.75, 1.2) if windows else paint
        bay_m = rng.uniform(2.2, 4.0)
        foundation = 0.6
        for side, (length, turn, out) in enumerate(
            ((a, 0.0, b), (b, math.pi / 2, a), (a, math.pi, b), (b, -math.pi / 2, a))
        ):
            wall = _Place(place.north, place.east, place.heading + turn)
            corners = np.array(
                [
                    wall.at(x, out, z + d)
                    for x, d in ((-length, foundation), (length, foundation), (length, -wall_m), (-length, -wall_m))
                ]
            )
            bays = max(1, round(2 * length / bay_m))
            tile = (4 * length / bays, 2 * floor_m) if windows else (3.0, 3.0)
            # Seen from outside the wall's columns run the other way: winding decides.
            self.mesh.add(
                corners, np.array([(0, 1, 2), (0, 2, 3)]), facade, tint, tile, wall.at(length, out, z - wall_m)
            )
            if side == 0 and rng.random() < 0.7:
                door = wall.at(rng.uniform(-0.6, 0.6) * length, out, z - 1.0)
                self.mesh.box(door, (0.5, 0.04, 1.05), wall.heading, self.planks, _paint(rng), (1.0, 2.0))
        roof_tint = _roof_colour(rng)
        roof = int(rng.choice(self.roofs))
        top = z - wall_m
        if rng.random() < 0.35:
            self.mesh.box(
                place.at(0, 0, top - 0.12),
                (a + 0.5 * overhang, b + 0.5 * overhang, 0.13),
                place.heading,
                self.walls[0],
                roof_tint,
                (3.0, 3.0),
            )
            for _ in range(int(rng.integers(0, 4))):
                x, y = rng.uniform(-0.7, 0.7) * a, rng.uniform(-0.6, 0.6) * b
                size = rng.uniform(0.3, 0.9, 3)
                self.mesh.box(
                    place.at(x, y, top - 0.2 - size[2]),
                    (size[0], size[1], size[2]),
                    place.heading,
                    self.roofs[1],
                    _paint(rng),
                )
            return
        la, lb = a + overhang, b + overhang
        ridge = la if rng.random() < 0.6 else la * rng.uniform(0.0, 0.6)
        eave = top + overhang * roof_m / lb * 0.5
        v = np.array([place.at(-la, -lb, eave), place.at(la, -lb, eave), place.at(la, lb, eave), place.at(-la, lb, eave),
                      place.at(-ridge, 0, top - roof_m), place.at(ridge, 0, top - roof_m)])  # fmt: skip
        tile = (rng.uniform(1.5, 3.0),) * 2
        self.mesh.add(v, np.array([(0, 5, 1), (0, 4, 5), (2, 4, 3), (2, 5, 4)]), roof, roof_tint, tile, v[4])
        self.mesh.add(
            v,
            np.array([(1, 5, 2), (3, 4, 0)]),
            roof if ridge < la else self.walls[1],
            roof_tint if ridge < la else paint,
            tile,
            v[4],
        )
        self.mesh.add(v, np.array([(0, 1, 2), (0, 2, 3)]), self.planks, paint * 0.6, (2.0, 2.0))
        if rng.random() < 0.6:
            size = rng.uniform(0.2, 0.45)
            spot = place.at(rng.uniform(-0.5, 0.5) * ridge, rng.uniform(-0.4, 0.4) * b, top - roof_m)
            self.mesh.box(
                spot, (size, size, rng.uniform(0.7, 1.3)), place.heading, self.walls[0], _paint(rng), (1.5, 1.5)
            )

    def _container(self) -> None:
        rng = self.rng
        a, b, h = rng.uniform(0.5, 3.2), rng.uniform(0.5, 1.25), rng.uniform(0.4, 1.3)
        place = self._place(a, b, 2 * h)
        if place is not None:
            texture = int(rng.choice([*self.walls, *self.roofs]))
            self.mesh.box(
                place.at(0, 0, self._ground_z(place) - h + 0.1),
                (a, b, h + 0.1),
                place.heading,
                texture,
                _paint(rng),
                (2.4, 2.4),
            )

    def _fence(self) -> None:
        rng = self.rng
        a, h = rng.uniform(3.0, 14.0), rng.uniform(0.5, 1.1)
        place = self._place(a, 0.25, 2 * h)
        if place is None:
            return
        tint, style = _paint(rng), rng.random()
        sections = max(2, int(a))
        for k in range(sections):
            x = (2 * (k + 0.5) / sections - 1) * a
            piece = _Place(*place.at(x, 0, 0)[:2], place.heading)
            z = self._ground_z(piece)
            half = a / sections
            if style < 0.35:  # wall
                self.mesh.box(
                    piece.at(0, 0, z - h + 0.2), (half, 0.12, h + 0.2), place.heading, self.walls[1], tint, (2.0, 2.0)
                )
            elif style < 0.55:  # hedge
                self.mesh.box(
                    piece.at(0, 0, z - h + 0.2),
                    (half, 0.24, h + 0.2),
                    place.heading,
                    self.leaves[0],
                    _leaf_colour(rng),
                    (1.2, 1.2),
                )
            else:
                self.mesh.box(
                    piece.at(half, 0, z - h + 0.2), (0.06, 0.06, h + 0.25), place.heading, self.planks, tint, (1.0, 1.0)
                )
                rails = (0.35, 1.0, 1.65) if style < 0.8 else (0.95,)
                thick = 0.08 if style < 0.8 else 0.75 * h
                for level in rails:
                    self.mesh.box(
                        piece.at(0, 0, z - level * h - 0.05),
                        (half, 0.025, thick),
                        place.heading,
                        self.planks,
                        tint,
                        (1.0, 1.0),
                    )

    def _car(self) -> None:
        rng = self.rng
        length, width = rng.uniform(1.8, 2.5), rng.uniform(0.8, 0.95)
        place = self._place(length, width, 1.6)
        if place is None:
            return
        z = self._ground_z(place)
        paint = _paint(rng)
        smooth = self.facades[0]
        self.mesh.box(place.at(0, 0, z - 0.58), (length, width, 0.3), place.heading, self.rock, paint, (4.0, 4.0))
        self.mesh.box(
            place.at(-0.15 * length, 0, z - 1.14),
            (0.55 * length, 0.88 * width, 0.26),
            place.heading,
            smooth,
            np.full(3, 0.12),
            (9.0, 9.0),
        )
        self.mesh.box(
            place.at(-0.15 * length, 0, z - 1.43),
            (0.5 * length, 0.85 * width, 0.04),
            place.heading,
            self.rock,
            paint,
            (4.0, 4.0),
        )
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
        tint = _paint(rng)
        self.mesh.frustum(place.at(0, 0, z + 0.3), place.at(0, 0, z - h), (r, 0.7 * r), 8, self.rock, tint)
        style = rng.random()
        if style < 0.4:
            self.mesh.box(place.at(0.25, 0, z - h), (0.35, 0.1, 0.06), place.heading, self.rock, tint)
        elif style < 0.75:
            self.mesh.box(
                place.at(r, 0, z - h + 0.4), (0.02, 0.35, 0.35), place.heading, self.facades[1], _paint(rng), (0.9, 0.9)
            )
        else:
            self.mesh.blob(place.at(0, 0, z - h), np.full(3, 0.2), 0.0, rng, self.rock, np.full(3, 0.5), 2.0)

    def _tree(self) -> None:
        rng = self.rng
        style = self.tree_styles[int(rng.integers(0, len(self.tree_styles)))]
        height = style.height * rng.uniform(0.7, 1.3)
        crown = min(style.crown * height, 3.5) * rng.uniform(0.8, 1.2)
        place = self._place(crown, crown, height, off_road=rng.random() < 0.9, gap=-0.4 * crown)
        if place is None:
            return
        z = self._ground_z(place)
        mesh = self.mesh
        tint = style.colour * rng.uniform(0.75, 1.25)
        trunk_tint = np.array([0.22, 0.15, 0.1]) * rng.uniform(0.6, 1.8)
        r = 0.02 * height + 0.06
        bare = style.bare * height
        mesh.frustum(
            place.at(0, 0, z + 0.3),
            place.at(0, 0, z - max(bare + 0.3, 0.75 * height)),
            (r, 0.5 * r),
            7,
            self.bark,
            trunk_tint,
        )
        if style.shape == "cone":
            layers = style.layers
            for k in range(layers):
                low = bare + (height - bare) * k / layers * 0.85
                high = low + (height - low) * (0.75 if k < layers - 1 else 1.0)
                mesh.frustum(
                    place.at(0, 0, z - low),
                    place.at(0, 0, z - high),
                    (crown * (1 - 0.75 * k / layers), 0.0),
                    9,
                    style.texture,
                    tint * (1 + 0.1 * k),
                    (1.5, 1.5),
                )
        elif style.shape == "column":
            mesh.blob(
                place.at(0, 0, z - (bare + height) / 2),
                np.array([0.45 * crown, 0.45 * crown, (height - bare) / 2]),
                0.12,
                rng,
                style.texture,
                tint,
                1.6,
            )
        elif style.shape == "round":
            mesh.blob(
                place.at(0, 0, z - (bare + height) / 2),
                np.array([0.9 * crown, 0.9 * crown, (height - bare) / 2]),
                0.14,
                rng,
                style.texture,
                tint,
                2.0,
            )
        elif style.shape == "cloud":
            for _ in range(style.layers + 2):
                x, y = rng.uniform(-0.55, 0.55, 2) * crown
                size = rng.uniform(0.35, 0.55) * crown
                up = rng.uniform(bare + 0.5 * size, max(bare + 0.6 * size, height - size))
                mesh.blob(
                    place.at(x, y, z - up),
                    np.array([size, size, 0.8 * size]),
                    0.16,
                    rng,
                    style.texture,
                    tint * rng.uniform(0.85, 1.15),
                    1.6,
                )
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
            z = self._ground_z(place)
            self.mesh.blob(
                place.at(0, 0, z - 0.5 * r),
                np.array([0.8 * r, 0.8 * r, 0.7 * r]),
                0.2,
                rng,
                int(rng.choice(self.leaves)),
                _leaf_colour(rng),
                1.2,
            )

    def _rock(self) -> None:
        rng = self.rng
        r = rng.uniform(0.15, 0.8)
        place = self._place(r, r, r, gap=-0.2)
        if place is not None:
            z = self._ground_z(place)
            radii = r * rng.uniform(0.55, 0.8, 3)
            self.mesh.blob(
                place.at(0, 0, z - 0.2 * r),
                radii,
                0.2,
                rng,
                self.rock,
                np.full(3, rng.uniform(0.15, 0.5)) * rng.uniform(0.85, 1.1, 3),
                1.5,
            )

    def _pebble(self) -> None:
        """Low things may lie under the path too."""
        rng = self.rng
        place = _Place(*(rng.uniform(-0.9, 0.9, 2) * self.extent), 0.0)
        size = rng.uniform(0.05, 0.2)
        z = self._ground_z(place)
        if rng.random() < 0.6:
            self.mesh.blob(
                place.at(0, 0, z),
                np.array([size, size, 0.7 * size]),
                0.2,
                rng,
                self.rock,
                np.full(3, rng.uniform(0.1, 0.6)),
                0.8,
            )
        else:
            self.mesh.blob(
                place.at(0, 0, z), np.array([size, size, 0.8 * size]), 0.25, rng, self.leaves[1], _leaf_colour(rng), 0.8
            )

    def _horizon(self) -> None:
        """Far woods and hills beyond the extent: a ring of lumps, none nearer than 1.3 extents."""
        rng = self.rng
        for _ in range(int(rng.choice([0, 12, 25, 40]))):
            bearing, away = rng.uniform(0, 2 * math.pi), self.extent * rng.uniform(1.9, 4.5)
            wide, high = rng.uniform(8, 35), rng.uniform(4, 16)
            centre = np.array([away * math.cos(bearing), away * math.sin(bearing), 0.2 * high])
            self.mesh.blob(
                centre, np.array([wide, wide, high]), 0.12, rng, self.leaves[0], _leaf_colour(rng) * 0.8, 6.0
            )


@dataclass(frozen=True, eq=False)
class _TreeStyle:
    shape: str
    height: float
    crown: float
    bare: float
    layers: int
    texture: int
    colour: FloatArray

    @staticmethod
    def draw(rng: Generator, leaves: list[int]) -> _TreeStyle:
        return _TreeStyle(
            shape=str(rng.choice(["cone", "round", "cloud", "cloud", "column", "bare"])),
            height=float(rng.uniform(2.5, 10.0)),
            crown=float(rng.uniform(0.2, 0.45)),
            bare=float(rng.uniform(0.08, 0.4)),
            layers=int(rng.integers(2, 5)),
            texture=int(rng.choice(leaves)),
            colour=_leaf_colour(rng),
        )


def _leaf_colour(rng: Generator) -> FloatArray:
    """Green mostly; sometimes autumn or blossom."""
    if rng.random() < 0.8:
        return np.array([rng.uniform(0.05, 0.2), rng.uniform(0.14, 0.32), rng.uniform(0.02, 0.09)])
    return np.array([rng.uniform(0.25, 0.5), rng.uniform(0.1, 0.32), rng.uniform(0.03, 0.2)])


def _paint(rng: Generator) -> FloatArray:
    """Any wall's or machine's colour: mostly muted, sometimes strong."""
    grey = rng.uniform(0.06, 0.7)
    strength = rng.uniform(0.0, 0.25) if rng.random() < 0.65 else rng.uniform(0.4, 0.85)
    return np.asarray(np.clip(grey * (1 - strength) + strength * grey * 2.2 * rng.random(3), 0.02, 0.8))


def _roof_colour(rng: Generator) -> FloatArray:
    base = np.array([(0.4, 0.14, 0.08), (0.2, 0.2, 0.22), (0.3, 0.22, 0.15), (0.15, 0.22, 0.2)])[
        int(rng.integers(0, 4))
    ]
    return np.asarray(np.clip(base * rng.uniform(0.6, 1.6) * rng.uniform(0.85, 1.15, 3), 0.03, 0.7))


def _ground_colour(rng: Generator, kind: str) -> FloatArray:
    base = {
        "grass": (0.16, 0.22, 0.06),
        "soil": (0.27, 0.19, 0.12),
        "gravel": (0.32, 0.3, 0.27),
        "asphalt": (0.14, 0.14, 0.15),
        "paving": (0.34, 0.32, 0.3),
        "bricks": (0.3, 0.18, 0.14),
        "stone_cells": (0.33, 0.3, 0.25),
    }[kind]
    return np.asarray(np.clip(np.array(base) * rng.uniform(0.55, 1.4) * rng.uniform(0.85, 1.15, 3), 0.02, 0.7))


def _tone_curve(rng: Generator) -> UInt8Array:
    """Soft shoulder, then the sRGB encoding."""
    linear = (np.arange(2049) / 1024.0) ** 2
    strength = rng.uniform(0.9, 1.4)
    y = (1 - np.exp(-strength * linear)) / (1 - math.exp(-strength * 3.0))
    y = np.minimum(y, 1.0) ** rng.uniform(1.0, 1.2)
    srgb = np.where(y <= 0.0031308, 12.92 * y, 1.055 * y ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(255 * srgb), dtype=np.uint8)
