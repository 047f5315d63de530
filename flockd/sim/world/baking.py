"""What is baked into a world once: its shadow map, and the ground's map of colours with sunlight."""
# Compiled loops are long: a call for each few lines would cost more than it explains.
# ruff: noqa: PLR0915

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any

import numpy as np
from numba import njit
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.core.messages import Float32Array, FloatArray, UInt8Array
from flockd.sim.world import textures
from flockd.sim.world.mesh import unit
from flockd.sim.world.scenery import Scenery

GROUND_MAP_BITS = 11
SHADOW_MAP_SIZE = 2048


Baked = namedtuple(
    "Baked", "noise extent zone_scale variation ground openness heights slopes sun shadow_map shadow_frame"
)
"""What the ground's map is made of: `ground` is `Scenery.ground`, `slopes` are those of `heights`, north and east."""


def ground_map(
    rng: Generator, scenery: Scenery, sun: FloatArray, shadow: Float32Array, frame: FloatArray
) -> tuple[Float32Array, UInt8Array]:
    """Colour with baked sunlight (size, size, 4), and the kind of ground, per texel: rows run north, columns east."""
    size = 1 << GROUND_MAP_BITS
    colour, kinds = np.empty((size, size, 4), dtype=np.float32), np.empty((size, size), dtype=np.uint8)
    noise = np.stack([
        textures.fractal_noise(rng, slope=rng.uniform(2.0, 2.6), coarsest=0.5),
        textures.fractal_noise(rng, slope=rng.uniform(0.8, 1.3), coarsest=0.4),
        textures.fractal_noise(rng, slope=rng.uniform(0.4, 1.0), coarsest=0.4),
        textures.fractal_noise(rng, slope=1.5, coarsest=0.4),
    ])  # fmt: skip
    cell = 2 * scenery.extent / (scenery.heights.shape[0] - 1)
    slopes = np.stack([np.gradient(scenery.heights, cell, axis=k) for k in (0, 1)])
    zone_scale = rng.uniform(0.7, 2.5)
    variation = np.array([rng.uniform(0.12, 0.38), rng.uniform(0.1, 0.35), rng.uniform(0.0, 0.1)])
    compose_ground(
        Baked(noise, scenery.extent, zone_scale, variation, scenery.ground, _openness(scenery), scenery.heights, slopes,
              sun, shadow, frame),
        colour, kinds,
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


def shadow_map(
    vertices: FloatArray, triangles: NDArray[np.int32], sun: FloatArray, extent: float
) -> tuple[Float32Array, FloatArray]:
    """The greatest height towards the sun (size, size), and from NED to its columns, rows and height (3, 4)."""
    size = SHADOW_MAP_SIZE
    across = unit(np.array([-sun[1], sun[0], 0.0]))
    reach = extent * math.sqrt(2.0)
    half = reach * abs(sun[2]) + 25.0  # nothing is taller
    towards = across * size / (2 * reach), np.cross(sun, across) * size / (2 * half), sun
    frame = np.column_stack([np.stack(towards), [size / 2, size / 2, 0.0]])
    shadow = np.full((size, size), -1e9, dtype=np.float32)
    n, e, d = vertices.T[..., None]
    fill_shadow(frame[:, 0] * n + frame[:, 1] * e + frame[:, 2] * d + frame[:, 3], triangles, shadow)
    frame[2, 3] += 0.06  # a surface does not shade itself
    return shadow, frame


@njit(cache=True, error_model="numpy", forceinline=True)
def sun_reaches(shadow: Any, frame: Any, n: Any, e: Any, d: Any) -> Any:
    """Share of sunlight at a point, 0 to 1: four neighbours of the shadow map, weighted.

    ``frame`` (3, 4) takes a point to map column, map row and height towards the sun; the map holds the highest
    thing's height.
    """
    size = shadow.shape[0]
    s = frame[0, 0] * n + frame[0, 1] * e + frame[0, 2] * d + frame[0, 3] - np.float32(0.5)
    t = frame[1, 0] * n + frame[1, 1] * e + frame[1, 2] * d + frame[1, 3] - np.float32(0.5)
    here = frame[2, 0] * n + frame[2, 1] * e + frame[2, 2] * d + frame[2, 3]
    first, last = np.int32(0), np.int32(size - 2)
    column, row = min(max(np.int32(s), first), last), min(max(np.int32(t), first), last)
    ws, wt = s - np.float32(column), t - np.float32(row)
    # Unsigned indices spare the check for negative ones.
    i, j, k, m = np.uint32(column), np.uint32(row), np.uint32(column + 1), np.uint32(row + 1)
    one, none = np.float32(1.0), np.float32(0.0)
    lit = (one - ws) * (one - wt) if here >= shadow[j, i] else none
    lit += ws * (one - wt) if here >= shadow[j, k] else none
    lit += (one - ws) * wt if here >= shadow[m, i] else none
    lit += ws * wt if here >= shadow[m, k] else none
    outside = s < none or t < none or s >= np.float32(size - 1) or t >= np.float32(size - 1)
    return one if outside else lit


@njit(nogil=True, cache=True, error_model="numpy")
def fill_shadow(points: Any, triangles: Any, shadow: Any) -> None:
    """Greatest height in each cell of the shadow map, of triangles of points: column, row, height towards the sun."""
    size = shadow.shape[0]
    for t in range(triangles.shape[0]):
        a, b, c = points[triangles[t, 0]], points[triangles[t, 1]], points[triangles[t, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if abs(area) < 1e-9:
            continue
        x0 = max(0, math.ceil(min(a[0], b[0], c[0]) - 0.5))
        x1 = min(size - 1, math.floor(max(a[0], b[0], c[0]) - 0.5))
        y0 = max(0, math.ceil(min(a[1], b[1], c[1]) - 0.5))
        y1 = min(size - 1, math.floor(max(a[1], b[1], c[1]) - 0.5))
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                ds, dr = x + 0.5 - a[0], y + 0.5 - a[1]
                b1 = (ds * (c[1] - a[1]) - (c[0] - a[0]) * dr) / area
                b2 = ((b[0] - a[0]) * dr - ds * (b[1] - a[1])) / area
                if b1 >= 0.0 and b2 >= 0.0 and b1 + b2 <= 1.0:
                    shadow[y, x] = max(shadow[y, x], a[2] + b1 * (b[2] - a[2]) + b2 * (c[2] - a[2]))


@njit(cache=True, error_model="numpy")
def _noise(maps: Any, k: int, u: float, v: float) -> float:
    """Bilinear value of the k-th tileable noise map at (u, v) in tiles."""
    mask = maps.shape[1] - 1
    fu, fv = u * maps.shape[1], v * maps.shape[1]
    x, y = math.floor(fu), math.floor(fv)
    wx, wy = fu - x, fv - y
    x0, x1, y0, y1 = x & mask, (x + 1) & mask, y & mask, (y + 1) & mask
    above = maps[k, y0, x0] * (1.0 - wx) + maps[k, y0, x1] * wx
    below = maps[k, y1, x0] * (1.0 - wx) + maps[k, y1, x1] * wx
    return float(above * (1.0 - wy) + below * wy)


@njit(cache=True, error_model="numpy")
def _between(grid: Any, i: int, j: int, a: float, b: float) -> float:
    """Bilinear value of a grid, shares ``a`` and ``b`` of a cell beyond node (i, j)."""
    low = grid[i, j] * (1.0 - a) + grid[i + 1, j] * a
    high = grid[i, j + 1] * (1.0 - a) + grid[i + 1, j + 1] * a
    return float(low * (1.0 - b) + high * b)


@njit(nogil=True, cache=True, error_model="numpy")
def compose_ground(baked: Any, colour: Any, kinds: Any) -> None:
    """The ground's map. Zones from noise, then roads (straight with a sway), then rectangles."""
    noise, extent, variation, sun = baked.noise, baked.extent, baked.variation, baked.sun
    ground, heights, slopes = baked.ground, baked.heights, baked.slopes
    roads, patches = ground.roads, ground.patches
    size, cells, coarse = kinds.shape[0], heights.shape[0] - 1, baked.openness.shape[0]
    marking, kerb = np.full(3, 0.55), np.full(3, 0.3)
    for row in range(size):
        n = ((row + 0.5) / size * 2.0 - 1.0) * extent
        for column in range(size):
            e = ((column + 0.5) / size * 2.0 - 1.0) * extent
            gu, gv = (n / extent + 1.0) * 0.5, (e / extent + 1.0) * 0.5
            tone, fine = _noise(noise, 1, gv, gu), _noise(noise, 2, e / 19.0, n / 19.0)
            value = _noise(noise, 0, gv * baked.zone_scale, gu * baked.zone_scale) + 0.03 * fine
            zone = 0
            while zone < ground.zone_limits.shape[0] and value > ground.zone_limits[zone]:
                zone += 1
            kind, paint, worn = ground.zone_kinds[zone], ground.zone_colours[zone], 1.0
            for k in range(roads.shape[0]):
                dn, de = n - roads[k, 0], e - roads[k, 1]
                along = dn * roads[k, 2] + de * roads[k, 3]
                across = -dn * roads[k, 3] + de * roads[k, 2]
                across += roads[k, 5] * math.sin(along * roads[k, 6] + roads[k, 7])
                off = abs(across) - roads[k, 4]
                ragged = 0.12 * fine if roads[k, 9] < 0.5 else 0.02 * fine
                if off + ragged < 0.0:
                    kind, paint, worn = int(roads[k, 8]), ground.road_colours[k], 1.0
                    if roads[k, 9] > 1.5:
                        stripe = abs(across) < 0.07 and (along * 0.2 - math.floor(along * 0.2)) < 0.5
                        if stripe or abs(off + 0.25) < 0.06:
                            paint, worn = marking, 0.9
                    elif roads[k, 9] < 0.5:  # two wheel tracks
                        worn = 1.0 - 0.25 * math.exp(-(((abs(across) - 0.5 * roads[k, 4]) / 0.25) ** 2))
                elif off + ragged < 0.22 and roads[k, 9] > 0.5:
                    paint, worn = kerb, 1.0
            for k in range(patches.shape[0]):
                dn, de = n - patches[k, 0], e - patches[k, 1]
                a = abs(dn * patches[k, 2] + de * patches[k, 3])
                b = abs(-dn * patches[k, 3] + de * patches[k, 2])
                if a + 0.03 * fine < patches[k, 4] and b + 0.03 * fine < patches[k, 5]:
                    kind, paint = int(patches[k, 6]), ground.patch_colours[k]
                    worn = 0.7 if patches[k, 4] - a < 0.15 or patches[k, 5] - b < 0.15 else 1.0
            shade = worn * math.exp(variation[0] * tone + variation[1] * fine)
            hue = variation[2] * _noise(noise, 3, gv, gu)
            shade *= baked.openness[min(coarse - 1, row * coarse // size), min(coarse - 1, column * coarse // size)]
            # Sunlight: the grid's slopes, smoothed, with what stands in the way.
            i, j = min(cells - 1, int(gu * cells)), min(cells - 1, int(gv * cells))
            a, b = gu * cells - i, gv * cells - j
            height, north, east = (_between(heights, i, j, a, b), _between(slopes[0], i, j, a, b),
                                   _between(slopes[1], i, j, a, b))  # fmt: skip
            lit = 0.0
            for k in range(5):
                dx = 0.06 * ((k & 1) * 2 - 1) if k < 4 else 0.0
                dy = 0.06 * ((k & 2) - 1) if k < 4 else 0.0
                lit += 0.2 * sun_reaches(baked.shadow_map, baked.shadow_frame, n + dx, e + dy, -height)
            cosine = max(0.0, (-north * sun[0] - east * sun[1] - sun[2]) / math.sqrt(1.0 + north**2 + east**2))
            colour[row, column, 0] = paint[0] * shade * (1.0 + hue)
            colour[row, column, 1] = paint[1] * shade
            colour[row, column, 2] = paint[2] * shade * (1.0 - hue)
            colour[row, column, 3] = lit * cosine
            kinds[row, column] = kind
