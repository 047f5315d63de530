"""The colours of the world without drones, compiled: most of it to vectors.

No loop has a branch, a call, or a number that is looked up, but where its docstring says so; numbers are float32, and
logarithms polynomials. Pixels differ by at most a grey level or two from those of the plain formulas
(`tests/sim/renderer/test_shading.py`), in a fifth of the time.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from flockd.sim.world.baking import GROUND_MAP_BITS, sun_reaches
from flockd.sim.world.sky import SKY_BITS
from flockd.sim.world.textures import TEXTURE_BITS

_ROWS, _COLUMNS = 16, 32
"""Of a tile, a power of two each. Its texels lie together too, and what is known of it stays in the fastest cache."""
_PLANE = _ROWS * _COLUMNS + 16
"""Room for one number of all its pixels. Not a power of two: such planes displace each other in the cache."""
_DEPTH, _NORTH, _EAST, _DOWN, _LEVEL, _CLEAR, _TILES, _SUN, _UP, _RED, _GREEN, _BLUE = (k * _PLANE for k in range(12))
"""Where in `work` is what. One array with offsets that the compiler knows: so it makes vectors of the loops.

`_TILES`: the ground's detail repeats so often a metre; 0 for other things, less for sky.
"""
_SKY = -1.0
_U, _V, _FINENESS, _FIRST, _SECOND, _THIRD, _FOURTH = (k * _PLANE for k in range(7))
"""Where in a `query` is what: where to sample, in tiles and levels, and then the four channels found, linear light."""
_FINE_U, _FINE_V, _COARSE_U, _COARSE_V, _COARSE = (k * _PLANE for k in range(8, 13))
"""Where in `taps` is what, after the places of eight texels: weights in 1/256."""
_LOG2 = tuple(np.float32(c) for c in (-2.49835315, 4.02921139, -2.07833517, 0.62603218, -0.07844068))
_EXP2 = tuple(np.float32(c) for c in (0.99990029, 0.69632477, 0.22469316, 0.07896726))


@njit(nogil=True, cache=True, error_model="numpy")
def shade_scene(hit: Any, planes: Any, eye: Any, scene: Any, blobs: Any, rgb: Any, depth: Any) -> None:
    """Colour and metric depth of every pixel from its triangle index: the world without drones.

    A tile at a time, and each stage for the whole tile: most of it then compiles to vectors.
    """
    height, width = hit.shape
    tone = scene.tone
    work = np.zeros(12 * _PLANE, dtype=np.float32)
    on_map = np.zeros(7 * _PLANE, dtype=np.float32)
    on_texture = np.zeros(7 * _PLANE, dtype=np.float32)
    on_sky = np.zeros(7 * _PLANE, dtype=np.float32)
    taps = np.zeros(13 * _PLANE, dtype=np.int32)
    base = np.zeros(_PLANE, dtype=np.int32)
    cells = np.zeros(_PLANE, dtype=np.int32)
    seen = np.zeros(8 * _PLANE, dtype=np.uint32)
    nowhere = np.zeros(_PLANE, dtype=np.int32)
    for top in range(0, height, _ROWS):
        bottom = min(height, top + _ROWS)
        count = (bottom - top) * _COLUMNS
        for left in range(0, width, _COLUMNS):
            right = min(width, left + _COLUMNS)
            _find_depth(hit, planes, eye.K, top, bottom, left, right, depth, work)
            _find_places(eye, scene.fog_per_m, top, bottom, left, work)
            _find_cells(scene.extent_m, GROUND_MAP_BITS, count, work, on_map, cells)
            _cast_shadows(blobs, scene.light[0], top, bottom, left, right, work)
            skies, grounds = _find_surfaces(hit, scene, top, bottom, left, right, cells, work, on_texture, base)
            if grounds > 0:
                _sample_tile(scene.ground_map, GROUND_MAP_BITS, nowhere, count, on_map, taps, seen)
            if skies < (bottom - top) * (right - left):
                _sample_tile(scene.texels, TEXTURE_BITS, base, count, on_texture, taps, seen)
            if skies > 0:
                _find_directions(eye, SKY_BITS, top, bottom, left, on_sky)
                _sample_tile(scene.sky, SKY_BITS, nowhere, count, on_sky, taps, seen)
            _find_tones(scene.light, scene.extent_m, tone.shape[0] - 1, count, on_map, on_texture, on_sky, work)
            for y in range(top, bottom):
                first = (y - top) * _COLUMNS - left
                for x in range(left, right):
                    rgb[y, x, 0] = tone[np.uint32(work[_RED + first + x])]
                    rgb[y, x, 1] = tone[np.uint32(work[_GREEN + first + x])]
                    rgb[y, x, 2] = tone[np.uint32(work[_BLUE + first + x])]


@njit(nogil=True, cache=True, error_model="numpy")
def _find_depth(
    hit: Any, planes: Any, K: Any, top: int, bottom: int, left: int, right: int, depth: Any, work: Any
) -> None:
    """Depth of each pixel of a tile, inf for sky; and in place of its level, how far its triangle's plane is away.

    Scalar, and in float64: far ground is seen at a grazing angle.
    """
    last = -1
    a = b = c = away = 0.0
    for y in range(top, bottom):
        first = (y - top) * _COLUMNS - left
        for x in range(left, right):
            t = hit[y, x]
            if t != last:
                last = t
                if t < 0:
                    a = b = c = away = 0.0
                else:
                    a, b, c = planes[t, 9], planes[t, 10], planes[t, 11]
                    e, f, g = a * K[0, 0], a * K[0, 1] + b * K[1, 1], a * K[0, 2] + b * K[1, 2] + c
                    away = 1.0 / math.sqrt(e * e + f * f + g * g)
            z = np.float32(1.0 / (a * (x + 0.5) + b * (y + 0.5) + c))
            depth[y, x] = z
            work[_DEPTH + first + x] = z
            work[_LEVEL + first + x] = away


@njit(nogil=True, cache=True, error_model="numpy")
def _find_places(eye: Any, fog: float, top: int, bottom: int, left: int, work: Any) -> None:
    """Where each pixel of a tile is, log2 of its footprint's metres, and the share of light that haze leaves."""
    on, oe, od = np.float32(eye.origin[0]), np.float32(eye.origin[1]), np.float32(eye.origin[2])
    fog_2 = np.float32(-fog / math.log(2.0))
    sharper = np.float32(math.log2(eye.focal) + 0.4)
    ray = _rays_of_tile(eye.inverse_K, eye.R, top, left)
    one, least = np.float32(1.0), np.float32(0.02)
    for i in range((bottom - top) * _COLUMNS):
        column, row = np.float32(i & (_COLUMNS - 1)), np.float32(i // _COLUMNS)
        z = work[_DEPTH + i]
        x = ray[0][0] + ray[1][0] * column + ray[2][0] * row
        y = ray[0][1] + ray[2][1] * row
        length = np.sqrt(x * x + y * y + one)
        work[_NORTH + i] = on + (ray[0][2] + ray[1][2] * column + ray[2][2] * row) * z
        work[_EAST + i] = oe + (ray[0][3] + ray[1][3] * column + ray[2][3] * row) * z
        work[_DOWN + i] = od + (ray[0][4] + ray[1][4] * column + ray[2][4] * row) * z
        # A pixel's footprint: midway between its short side and its long one, which grazing views stretch; a
        # little sharper than that.
        facing = max(least * length, work[_LEVEL + i] / z)
        work[_LEVEL + i] = np.float32(0.5) * _log2(z * z * length / facing) - sharper
        work[_CLEAR + i] = _exp2(max(np.float32(-100.0), fog_2 * z * length))


@njit(nogil=True, cache=True, error_model="numpy")
def _rays_of_tile(inverse_K: Any, R: Any, top: int, left: int) -> Any:
    """The ray of a tile's first pixel, and what a column and a row add: x and y in camera axes (z is 1), then NED."""
    x = inverse_K[0, 0] * (left + 0.5) + inverse_K[0, 1] * (top + 0.5) + inverse_K[0, 2]
    y = inverse_K[1, 1] * (top + 0.5) + inverse_K[1, 2]
    return (
        _ray(R, x, y, 1.0),
        _ray(R, inverse_K[0, 0], 0.0, 0.0),
        _ray(R, inverse_K[0, 1], inverse_K[1, 1], 0.0),
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _ray(R: Any, x: float, y: float, z: float) -> Any:
    return (
        np.float32(x),
        np.float32(y),
        np.float32(R[0, 0] * x + R[0, 1] * y + R[0, 2] * z),
        np.float32(R[1, 0] * x + R[1, 1] * y + R[1, 2] * z),
        np.float32(R[2, 0] * x + R[2, 1] * y + R[2, 2] * z),
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _find_cells(extent: float, bits: int, count: int, work: Any, on_map: Any, cells: Any) -> None:
    """Where each pixel of a tile is on the ground's map, which is mirrored beyond its borders."""
    scale, half, one, two = np.float32(0.5 / extent), np.float32(0.5), np.float32(1.0), np.float32(2.0)
    size, first, last = np.float32(1 << bits), np.int32(0), np.int32((1 << bits) - 1)
    level = np.float32(bits - math.log2(2.0 * extent))
    for i in range(count):
        u = work[_EAST + i] * scale + half
        v = work[_NORTH + i] * scale + half
        u = one - abs(one - (u - two * np.floor(u * half)))
        v = one - abs(one - (v - two * np.floor(v * half)))
        on_map[_U + i] = u
        on_map[_V + i] = v
        on_map[_FINENESS + i] = work[_LEVEL + i] + level
        column = max(first, min(np.int32(u * size), last))
        cells[i] = np.int32((max(first, min(np.int32(v * size), last)) << bits) + column)


@njit(nogil=True, cache=True, error_model="numpy")
def _cast_shadows(blobs: Any, sun: Any, top: int, bottom: int, left: int, right: int, work: Any) -> None:
    """The share of sunlight that the drones leave to each pixel of a tile.

    ``blobs`` (k, 9): a drone's place, radius and darkness; left, top, right and bottom of where its shadow may be.
    """
    count = (bottom - top) * _COLUMNS
    none, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    sn, se, sd = np.float32(sun[0]), np.float32(sun[1]), np.float32(sun[2])
    for i in range(count):
        work[_SUN + i] = one
    for k in range(blobs.shape[0]):
        if blobs[k, 5] >= right or blobs[k, 6] >= bottom or blobs[k, 7] <= left or blobs[k, 8] <= top:
            continue
        bn, be, bd = np.float32(blobs[k, 0]), np.float32(blobs[k, 1]), np.float32(blobs[k, 2])
        radius, darkness = np.float32(blobs[k, 3]), np.float32(blobs[k, 4])
        for i in range(count):
            n = bn - work[_NORTH + i]
            e = be - work[_EAST + i]
            d = bd - work[_DOWN + i]
            along = n * sn + e * se + d * sd
            off = np.sqrt(max(none, n * n + e * e + d * d - along * along))
            # The sun is half a degree wide: the edge softens with distance.
            soft = np.float32(0.35) * radius + np.float32(0.01) * along
            edge = (radius + half * soft - off) / soft
            dark = darkness * max(none, min(one, edge))
            work[_SUN + i] *= one - (dark if along > none else none)


@njit(nogil=True, cache=True, error_model="numpy")
def _find_surfaces(
    hit: Any,
    scene: Any,
    top: int,
    bottom: int,
    left: int,
    right: int,
    cells: Any,
    work: Any,
    on_texture: Any,
    base: Any,
) -> Any:
    """All that is looked up by a pixel's triangle: its texture, where on it, tint and sunlight. Scalar.

    Returns how many pixels are sky, and how many are ground.
    """
    texture_area = ((4 << (2 * TEXTURE_BITS)) - 1) // 3
    kinds, ground_detail, sun = scene.ground_kind.ravel(), scene.ground_detail, scene.light[0]
    normals, texture, uv, tint = scene.normals, scene.texture, scene.uv, scene.tint
    skies = 0
    grounds = 0
    for y in range(top, bottom):
        for x in range(left, right):
            i = (y - top) * _COLUMNS + x - left
            t = hit[y, x]
            if t < 0:
                skies += 1
                work[_TILES + i] = _SKY
                continue
            kind = texture[t]
            if kind < 0:
                grounds += 1
                k = kinds[np.uint32(cells[i])]
                base[i] = int(ground_detail[k, 0]) * texture_area
                work[_TILES + i] = ground_detail[k, 1]
                on_texture[_U + i] = 0.0
                on_texture[_V + i] = 0.0
                on_texture[_FINENESS + i] = work[_LEVEL + i] + ground_detail[k, 2]
                work[_UP + i] = 1.0
                continue
            n = float(work[_NORTH + i])
            e = float(work[_EAST + i])
            d = float(work[_DOWN + i])
            nn, ne, nd = normals[t, 0], normals[t, 1], normals[t, 2]
            base[i] = kind * texture_area
            work[_TILES + i] = 0.0
            on_texture[_U + i] = uv[t, 0, 0] * n + uv[t, 0, 1] * e + uv[t, 0, 2] * d + uv[t, 0, 3]
            on_texture[_V + i] = uv[t, 1, 0] * n + uv[t, 1, 1] * e + uv[t, 1, 2] * d + uv[t, 1, 3]
            on_texture[_FINENESS + i] = work[_LEVEL + i] + scene.level[t]
            cosine = max(0.0, nn * sun[0] + ne * sun[1] + nd * sun[2])
            if cosine > 0.0:
                cosine *= sun_reaches(scene.shadow_map, scene.shadow_frame, n + 0.08 * nn, e + 0.08 * ne, d + 0.08 * nd)
            work[_SUN + i] *= cosine
            work[_UP + i] = 0.5 - 0.5 * nd
            work[_RED + i] = tint[t, 0]
            work[_GREEN + i] = tint[t, 1]
            work[_BLUE + i] = tint[t, 2]
    for i in range((bottom - top) * _COLUMNS):
        tiles = max(np.float32(0.0), work[_TILES + i])
        u = on_texture[_U + i] + tiles * work[_EAST + i]
        v = on_texture[_V + i] + tiles * work[_NORTH + i]
        on_texture[_U + i] = u - np.floor(u)
        on_texture[_V + i] = v - np.floor(v)
    return skies, grounds


@njit(nogil=True, cache=True, error_model="numpy")
def _find_directions(eye: Any, bits: int, top: int, bottom: int, left: int, on_sky: Any) -> None:
    """Where each pixel of a tile is on the sky's map: an octahedral one of the upper half."""
    half, none, least = np.float32(0.5), np.float32(0.0), np.float32(1e-9)
    limit = np.float32(0.5 - 0.51 / (1 << bits))  # keep the filter off the opposite border
    ray = _rays_of_tile(eye.inverse_K, eye.R, top, left)
    for i in range((bottom - top) * _COLUMNS):
        column, row = np.float32(i & (_COLUMNS - 1)), np.float32(i // _COLUMNS)
        n = ray[0][2] + ray[1][2] * column + ray[2][2] * row
        e = ray[0][3] + ray[1][3] * column + ray[2][3] * row
        up = -(ray[0][4] + ray[1][4] * column + ray[2][4] * row)
        scale = half / max(least, abs(n) + abs(e) + max(none, up))
        on_sky[_U + i] = max(-limit, min(limit, (n + e) * scale)) + half
        on_sky[_V + i] = max(-limit, min(limit, (n - e) * scale)) + half


@njit(nogil=True, cache=True, error_model="numpy")
def _sample_tile(texels: Any, bits: int, base: Any, count: int, query: Any, taps: Any, seen: Any) -> None:
    """Trilinear samples as `sample` takes them, of a whole query: u and v are from 0 to 1."""
    _find_taps(bits, base, count, query, taps)
    for tap in range(0, 8 * _PLANE, _PLANE):
        for i in range(tap, tap + count):
            seen[i] = texels[np.uint64(taps[i])]
    _blend_taps(count, taps, seen, query)


@njit(nogil=True, cache=True, error_model="numpy")
def _find_taps(bits: int, base: Any, count: int, query: Any, taps: Any) -> None:
    """The places of eight texels of each sample, and their weights."""
    levels = np.int32(bits)
    none, most, before_last = np.float32(0.0), np.float32(bits), np.int32(bits - 1)
    whole_area = np.int32(4 * (0x55555555 & ((1 << (2 * bits)) - 1)))
    for i in range(count):
        level = query[_FINENESS + i]
        level = min(level if level > none else none, most)
        whole = min(np.int32(level), before_last)
        taps[_COARSE + i] = np.int32((level - np.float32(whole)) * np.float32(256.0))
        b = np.int32(levels - whole)
        across = np.float32(np.int32(np.int32(256) << b))
        u = np.int32(np.floor(query[_U + i] * across - np.float32(128.0)))
        v = np.int32(np.floor(query[_V + i] * across - np.float32(128.0)))
        # Levels before this one hold 4^bits + 4^(bits - 1) + ... texels: bits 0, 2, 4 ... of a number.
        area = np.int32(np.int32(1) << np.int32(b + b))
        start = np.int32(base[i] + whole_area - 4 * (0x55555555 & np.int32(area - 1)))
        _find_four(b, start, u, v, i, taps)
        taps[_FINE_U + i] = np.int32(u & 255)
        taps[_FINE_V + i] = np.int32(v & 255)
        u = np.int32(np.int32(u - 128) >> 1)
        v = np.int32(np.int32(v - 128) >> 1)
        _find_four(np.int32(b - 1), np.int32(start + area), u, v, i + 4 * _PLANE, taps)
        taps[_COARSE_U + i] = np.int32(u & 255)
        taps[_COARSE_V + i] = np.int32(v & 255)


@njit(cache=True, error_model="numpy")
def _find_four(bits: Any, start: Any, u: Any, v: Any, at: int, taps: Any) -> None:
    """The places of the texels around (u, v), in 1/256 of a texel, of a level that starts at ``start``."""
    mask = np.int32(np.int32(np.int32(1) << bits) - 1)
    x0 = np.int32(np.int32(u >> 8) & mask)
    x1 = np.int32(np.int32(x0 + 1) & mask)
    y0 = np.int32(np.int32(v >> 8) & mask)
    y1 = np.int32(np.int32(y0 + 1) & mask)
    row0 = np.int32(start + np.int32(y0 << bits))
    row1 = np.int32(start + np.int32(y1 << bits))
    taps[at] = np.int32(row0 + x0)
    taps[at + _PLANE] = np.int32(row0 + x1)
    taps[at + 2 * _PLANE] = np.int32(row1 + x0)
    taps[at + 3 * _PLANE] = np.int32(row1 + x1)


@njit(nogil=True, cache=True, error_model="numpy")
def _blend_taps(count: int, taps: Any, seen: Any, query: Any) -> None:
    """The four channels of each sample from its texels; two lanes of a number hold two of them."""
    lanes = np.uint32(0x00FF00FF)
    for half in range(2):
        shift = np.uint32(8 * half)
        for i in range(count):
            fine = _blend_four(
                (seen[i] >> shift) & lanes,
                (seen[_PLANE + i] >> shift) & lanes,
                (seen[2 * _PLANE + i] >> shift) & lanes,
                (seen[3 * _PLANE + i] >> shift) & lanes,
                np.uint32(taps[_FINE_U + i]),
                np.uint32(taps[_FINE_V + i]),
            )
            coarse = _blend_four(
                (seen[4 * _PLANE + i] >> shift) & lanes,
                (seen[5 * _PLANE + i] >> shift) & lanes,
                (seen[6 * _PLANE + i] >> shift) & lanes,
                (seen[7 * _PLANE + i] >> shift) & lanes,
                np.uint32(taps[_COARSE_U + i]),
                np.uint32(taps[_COARSE_V + i]),
            )
            both = _blend_two(fine, coarse, np.uint32(taps[_COARSE + i]))
            low = np.float32(np.int32(both & np.uint32(255))) * np.float32(1.0 / 255.0)
            high = np.float32(np.int32(both >> np.uint32(16))) * np.float32(1.0 / 255.0)
            query[_FIRST + half * _PLANE + i] = low * low
            query[_THIRD + half * _PLANE + i] = high * high


@njit(cache=True, error_model="numpy")
def _blend_four(a: Any, b: Any, c: Any, d: Any, u: Any, v: Any) -> Any:
    return _blend_two(_blend_two(a, b, u), _blend_two(c, d, u), v)


@njit(cache=True, error_model="numpy")
def _blend_two(a: Any, b: Any, weight: Any) -> Any:
    """Two bytes in lanes of 16 bits each, weight of b in 1/256."""
    return np.uint32(((a * np.uint32(np.uint32(256) - weight) + b * weight) >> np.uint32(8)) & np.uint32(0x00FF00FF))


@njit(nogil=True, cache=True, error_model="numpy")
def _find_tones(
    light: Any, extent: float, most: int, count: int, on_map: Any, on_texture: Any, on_sky: Any, work: Any
) -> None:
    """Where in the tone curve the colours of a tile are: what is seen in its light, through haze."""
    limit, border = np.float32(most), np.float32(extent)
    none, one = np.float32(0.0), np.float32(1.0)
    unshaded = np.float32(-light[0, 2])
    for i in range(count):
        # The ground's sunlight is baked into its map, and beyond that there is no shade.
        beyond = max(abs(work[_NORTH + i]), abs(work[_EAST + i])) > border
        lit, baked = work[_SUN + i], on_map[_FOURTH + i]
        baked = unshaded if beyond else baked
        work[_SUN + i] = lit * (baked if work[_TILES + i] > none else one)
    for channel in range(3):
        sunlight = np.float32(light[1, channel])
        skylight = np.float32(light[2, channel])
        bounced = np.float32(light[3, channel])
        haze = np.float32(light[4, channel])
        at = _RED + channel * _PLANE
        found = _FIRST + channel * _PLANE
        for i in range(count):
            up, clear, tiles = work[_UP + i], work[_CLEAR + i], work[_TILES + i]
            tint, mapped, of_sky = work[at + i], on_map[found + i], np.float32(4.0) * on_sky[found + i]
            irradiance = sunlight * work[_SUN + i] + skylight * up + bounced * (one - up)
            colour = (mapped if tiles > none else tint) * np.float32(2.0) * on_texture[found + i]
            seen = colour * irradiance * clear + haze * (one - clear)
            value = of_sky if tiles < none else seen
            place = np.sqrt(value if value > none else none) * np.float32(1024.0)
            work[at + i] = place if place < limit else limit


@njit(cache=True, error_model="numpy")
def _log2(value: Any) -> Any:
    """Logarithm of a positive float32, to 1.2e-4, by a polynomial of its mantissa."""
    bits = np.float32(value).view(np.int32)
    m = np.int32((bits & 0x7FFFFF) | 0x3F800000).view(np.float32)
    of_m = _LOG2[0] + m * (_LOG2[1] + m * (_LOG2[2] + m * (_LOG2[3] + m * _LOG2[4])))
    return np.float32((bits >> 23) - 127) + of_m


@njit(cache=True, error_model="numpy")
def _exp2(value: Any) -> Any:
    """2 to the power of a float32 from -125 to 0, to 1e-4 of it."""
    whole = np.floor(value)
    f = value - whole
    of_f = _EXP2[0] + f * (_EXP2[1] + f * (_EXP2[2] + f * _EXP2[3]))
    return of_f * np.int32((np.int32(whole) + 127) << 23).view(np.float32)
