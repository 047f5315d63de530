"""What is baked into a world once: its shadow map, and the ground's map of colours with sunlight."""
# Compiled loops are long: a call for each few lines would cost more than it explains.
# ruff: noqa: PLR0912, PLR0915

from __future__ import annotations

import math
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


def ground_map(
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
    compose_ground(
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


def shadow_map(
    vertices: FloatArray, triangles: NDArray[np.int32], sun: FloatArray, extent: float
) -> tuple[Float32Array, FloatArray]:
    """The greatest height towards the sun (size, size), and from NED to its columns, rows and height (3, 4)."""
    size = SHADOW_MAP_SIZE
    across = unit(np.array([-sun[1], sun[0], 0.0]))
    reach = extent * math.sqrt(2.0)
    half = reach * abs(sun[2]) + 25.0  # nothing is taller
    frame = np.zeros((3, 4))
    frame[0, :3], frame[1, :3], frame[2, :3] = (
        across * size / (2 * reach),
        np.cross(sun, across) * size / (2 * half),
        sun,
    )
    frame[:2, 3] = size / 2
    shadow = np.full((size, size), -1e9, dtype=np.float32)
    fill_shadow(vertices, triangles, frame, shadow)
    frame[2, 3] += 0.06  # a surface does not shade itself
    return shadow, frame


@njit(cache=True, error_model="numpy")
def sun_reaches(shadow: Any, frame: Any, n: float, e: float, d: float) -> float:
    """Share of sunlight at a point, 0 to 1: four neighbours of the shadow map, weighted.

    ``frame`` (3, 4) takes a point to map column, map row and height towards the sun; the map holds the highest
    thing's height.
    """
    size = shadow.shape[0]
    s = frame[0, 0] * n + frame[0, 1] * e + frame[0, 2] * d + frame[0, 3] - 0.5
    t = frame[1, 0] * n + frame[1, 1] * e + frame[1, 2] * d + frame[1, 3] - 0.5
    if s < 0.0 or t < 0.0 or s >= size - 1.0 or t >= size - 1.0:
        return 1.0
    here = frame[2, 0] * n + frame[2, 1] * e + frame[2, 2] * d + frame[2, 3]
    i = int(s)
    j = int(t)
    ws = s - i
    wt = t - j
    lit = 0.0
    if here >= shadow[j, i]:
        lit += (1.0 - ws) * (1.0 - wt)
    if here >= shadow[j, i + 1]:
        lit += ws * (1.0 - wt)
    if here >= shadow[j + 1, i]:
        lit += (1.0 - ws) * wt
    if here >= shadow[j + 1, i + 1]:
        lit += ws * wt
    return lit


@njit(nogil=True, cache=True, error_model="numpy")
def fill_shadow(vertices: Any, triangles: Any, frame: Any, shadow: Any) -> None:
    """Greatest height towards the sun in each cell of the shadow map (parallel projection)."""
    size = shadow.shape[0]
    for t in range(triangles.shape[0]):
        s = np.empty(3)
        r = np.empty(3)
        h = np.empty(3)
        for k in range(3):
            p = vertices[triangles[t, k]]
            s[k] = frame[0, 0] * p[0] + frame[0, 1] * p[1] + frame[0, 2] * p[2] + frame[0, 3]
            r[k] = frame[1, 0] * p[0] + frame[1, 1] * p[1] + frame[1, 2] * p[2] + frame[1, 3]
            h[k] = frame[2, 0] * p[0] + frame[2, 1] * p[1] + frame[2, 2] * p[2] + frame[2, 3]
        area = (s[1] - s[0]) * (r[2] - r[0]) - (s[2] - s[0]) * (r[1] - r[0])
        if abs(area) < 1e-9:
            continue
        x0 = max(0, math.ceil(s.min() - 0.5))
        x1 = min(size - 1, math.floor(s.max() - 0.5))
        y0 = max(0, math.ceil(r.min() - 0.5))
        y1 = min(size - 1, math.floor(r.max() - 0.5))
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                ds = x + 0.5 - s[0]
                dr = y + 0.5 - r[0]
                b1 = (ds * (r[2] - r[0]) - (s[2] - s[0]) * dr) / area
                b2 = ((s[1] - s[0]) * dr - ds * (r[1] - r[0])) / area
                if b1 >= 0.0 and b2 >= 0.0 and b1 + b2 <= 1.0:
                    here = h[0] + b1 * (h[1] - h[0]) + b2 * (h[2] - h[0])
                    shadow[y, x] = max(shadow[y, x], here)


@njit(cache=True, error_model="numpy")
def _noise(maps: Any, k: int, u: float, v: float) -> float:
    """Bilinear value of the k-th tileable noise map at (u, v) in tiles."""
    size = maps.shape[1]
    mask = size - 1
    fu = u * size
    fv = v * size
    x = math.floor(fu)
    y = math.floor(fv)
    wx = fu - x
    wy = fv - y
    x0 = x & mask
    x1 = (x + 1) & mask
    y0 = y & mask
    y1 = (y + 1) & mask
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
def compose_ground(
    noise: Any,
    extent: float,
    zone_scale: float,
    zone_limits: Any,
    zone_colours: Any,
    zone_kinds: Any,
    variation: Any,
    roads: Any,
    road_colours: Any,
    patches: Any,
    patch_colours: Any,
    openness: Any,
    slopes: Any,
    sun: Any,
    shadow: Any,
    shadow_frame: Any,
    heights: Any,
    colour: Any,
    kinds: Any,
) -> None:
    """The ground's map: colour and baked sunlight per texel (rows run north, columns east), and which detail covers it.

    Zones from noise, then roads (straight with a sway), then rectangles: their rows are ``Scenery``'s.
    """
    size = kinds.shape[0]
    cells = heights.shape[0] - 1
    coarse = openness.shape[0]
    for row in range(size):
        n = ((row + 0.5) / size * 2.0 - 1.0) * extent
        for column in range(size):
            e = ((column + 0.5) / size * 2.0 - 1.0) * extent
            gu = (n / extent + 1.0) * 0.5
            gv = (e / extent + 1.0) * 0.5
            broad = _noise(noise, 0, gv * zone_scale, gu * zone_scale)
            tone = _noise(noise, 1, gv, gu)
            fine = _noise(noise, 2, e / 19.0, n / 19.0)
            value = broad + 0.03 * fine
            zone = 0
            while zone < zone_limits.shape[0] and value > zone_limits[zone]:
                zone += 1
            kind = zone_kinds[zone]
            red = zone_colours[zone, 0]
            green = zone_colours[zone, 1]
            blue = zone_colours[zone, 2]
            worn = 1.0
            for k in range(roads.shape[0]):
                dn = n - roads[k, 0]
                de = e - roads[k, 1]
                along = dn * roads[k, 2] + de * roads[k, 3]
                across = -dn * roads[k, 3] + de * roads[k, 2]
                across += roads[k, 5] * math.sin(along * roads[k, 6] + roads[k, 7])
                off = abs(across) - roads[k, 4]
                ragged = 0.12 * fine if roads[k, 9] < 0.5 else 0.02 * fine
                if off + ragged < 0.0:
                    kind = int(roads[k, 8])
                    red = road_colours[k, 0]
                    green = road_colours[k, 1]
                    blue = road_colours[k, 2]
                    worn = 1.0
                    if roads[k, 9] > 1.5:
                        stripe = abs(across) < 0.07 and (along * 0.2 - math.floor(along * 0.2)) < 0.5
                        if stripe or abs(off + 0.25) < 0.06:
                            red = green = blue = 0.55
                            worn = 0.9
                    elif roads[k, 9] < 0.5:  # two wheel tracks
                        worn = 1.0 - 0.25 * math.exp(-(((abs(across) - 0.5 * roads[k, 4]) / 0.25) ** 2))
                elif off + ragged < 0.22 and roads[k, 9] > 0.5:
                    red = green = blue = 0.3
                    worn = 1.0
            for k in range(patches.shape[0]):
                dn = n - patches[k, 0]
                de = e - patches[k, 1]
                a = abs(dn * patches[k, 2] + de * patches[k, 3])
                b = abs(-dn * patches[k, 3] + de * patches[k, 2])
                if a + 0.03 * fine < patches[k, 4] and b + 0.03 * fine < patches[k, 5]:
                    kind = int(patches[k, 6])
                    red = patch_colours[k, 0]
                    green = patch_colours[k, 1]
                    blue = patch_colours[k, 2]
                    worn = 1.0
                    if patches[k, 4] - a < 0.15 or patches[k, 5] - b < 0.15:
                        worn = 0.7
            shade = worn * math.exp(variation[0] * tone + variation[1] * fine)
            hue = variation[2] * _noise(noise, 3, gv, gu)
            i = min(coarse - 1, row * coarse // size)
            j = min(coarse - 1, column * coarse // size)
            shade *= openness[i, j]
            # Sunlight: the grid's slopes, smoothed, with what stands in the way.
            fn = gu * cells
            fe = gv * cells
            ci = min(cells - 1, int(fn))
            cj = min(cells - 1, int(fe))
            a = fn - ci
            b = fe - cj
            height = _between(heights, ci, cj, a, b)
            slope_n = _between(slopes[0], ci, cj, a, b)
            slope_e = _between(slopes[1], ci, cj, a, b)
            lit = 0.0
            for k in range(5):
                dx = 0.06 * ((k & 1) * 2 - 1) if k < 4 else 0.0
                dy = 0.06 * ((k & 2) - 1) if k < 4 else 0.0
                lit += 0.2 * sun_reaches(shadow, shadow_frame, n + dx, e + dy, -height)
            cosine = max(
                0.0, (-slope_n * sun[0] - slope_e * sun[1] - sun[2]) / math.sqrt(1.0 + slope_n**2 + slope_e**2)
            )
            colour[row, column, 0] = red * shade * (1.0 + hue)
            colour[row, column, 1] = green * shade
            colour[row, column, 2] = blue * shade * (1.0 - hue)
            colour[row, column, 3] = lit * cosine
            kinds[row, column] = kind
