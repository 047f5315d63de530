"""The renderer's inner loops, compiled: set up triangles, fill a depth buffer, shade what is seen.

No fastmath: a shared edge must give the same crossing from both of its triangles (no holes). Each runs on the thread
that calls it and releases the GIL, so that several images are drawn side by side. Compiled for parallel rows, they took
three times as long to compile, and half as much processor time again to run.

The world's pixels are sorted by row into sky, ground and things, and each kind is shaded by a loop without branches, in
float32: LLVM makes vectors of it, table lookups included, which takes a third of the time. Iterating over an array
within such a loop, or unpacking one, prevents that.
"""
# Compiled loops are long: a call for each few lines would cost more than it explains.

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any

import numpy as np
from numba import njit
from numba.core.compiler import CompilerBase, DefaultPassBuilder

from flockd.sim.world.baking import GROUND_MAP_BITS, sun_reaches
from flockd.sim.world.sky import SKY_BITS
from flockd.sim.world.textures import TEXTURE_BITS


class _Apart(CompilerBase):
    """For functions whose arrays do not overlap: only then does LLVM make vectors of loops that look things up."""

    def define_pipelines(self) -> Any:
        """The usual one."""
        self.state.flags.noalias = True
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]  # type: ignore[no-untyped-call]


_loop = njit(nogil=True, cache=True, error_model="numpy", pipeline_class=_Apart)
_part = njit(cache=True, error_model="numpy", forceinline=True)
f32, i32, u32 = np.float32, np.int32, np.uint32  # numba's operations give the widest type of their numbers
_TEXTURE_AREA = ((4 << (2 * TEXTURE_BITS)) - 1) // 3
"""Texels of a texture's pyramid."""
SUBSAMPLES = 3
"""Drone colours are sampled 3x3 per pixel; the middle sample is the pixel's centre."""
Eye = namedtuple("Eye", ["K", "inverse_K", "R", "origin", "focal"])
"""A pinhole camera in the world: `Renderer.render` says of what shapes; `R` is from optical axes to NED."""
Scene = namedtuple(
    "Scene",
    "faces texels ground_map ground_kind ground_detail extent_m shadow_map shadow_frame light fog_per_m sky tone",
)
"""What colours of a `World` are made of, by the names and with the shapes that it has there, in float32.

`faces` (m, 16): each triangle's normal, tint, log2 of texels per metre, texture and uv.
"""
Thing = namedtuple("Thing", ["identity", "faces", "texels"])
"""What is laid over an image: a drone of a pose, and its number there. `texels` are its machine textures."""


@njit(nogil=True, cache=True, error_model="numpy")
def set_up_triangles(
    vertices: Any, triangles: Any, P: Any, origin: Any, width: int, height: int, rows: Any, planes: Any, visible: Any
) -> int:
    """How many triangles can be seen, which, and their row ranges and plane coefficients.

    ``planes[t]`` holds three edge functions (a, b, c), positive inside, and 1/z, each linear in (u, v, 1). They are
    homogeneous (cross products of the corners), so a triangle that reaches behind the camera needs no clipping.
    """
    q, beyond, count = np.empty(vertices.shape), np.empty(len(vertices), np.uint8), 0
    _project(vertices, P, origin, float(width), float(height), q, beyond)
    for t in range(triangles.shape[0]):
        i, j, k = u32(triangles[t, 0]), u32(triangles[t, 1]), u32(triangles[t, 2])
        if beyond[i] & beyond[j] & beyond[k]:
            continue
        a, b, c = (q[i, 0], q[i, 1], q[i, 2]), (q[j, 0], q[j, 1], q[j, 2]), (q[k, 0], q[k, 1], q[k, 2])
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = a, b, c
        first = _cross(b, c)
        determinant = ax * first[0] + ay * first[1] + az * first[2]
        if determinant > -1e-9:  # seen from behind, or edge on
            continue
        top, bottom = 0, height - 1
        if az > 1e-6 and bz > 1e-6 and cz > 1e-6:
            va, vb, vc = ay / az, by / bz, cy / cz
            top = max(top, math.ceil(max(-1.0, min(va, vb, vc)) - 0.5))
            bottom = min(bottom, math.floor(min(height + 1.0, max(va, vb, vc)) - 0.5))
            ua, ub, uc = ax / az, bx / bz, cx / cz
            if math.ceil(min(ua, ub, uc) - 0.5) > math.floor(max(ua, ub, uc) - 0.5):  # between pixel centres
                continue
        if top > bottom:
            continue
        visible[count], rows[t, 0], rows[t, 1] = t, top, bottom
        count += 1
        second, third, p = _cross(c, a), _cross(a, b), planes[t]
        p[0], p[1], p[2] = -first[0], -first[1], -first[2]
        p[3], p[4], p[5] = -second[0], -second[1], -second[2]
        p[6], p[7], p[8] = -third[0], -third[1], -third[2]
        p[9] = (first[0] + second[0] + third[0]) / determinant
        p[10] = (first[1] + second[1] + third[1]) / determinant
        p[11] = (first[2] + second[2] + third[2]) / determinant
    return count


@_loop
def _project(points: Any, P: Any, origin: Any, width: float, height: float, q: Any, beyond: Any) -> None:
    """Homogeneous pixels, and a bit each for behind the camera, left, above, right and below of the image."""
    for i in range(points.shape[0]):
        n, e, d = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        x, y = P[0, 0] * n + P[0, 1] * e + P[0, 2] * d, P[1, 0] * n + P[1, 1] * e + P[1, 2] * d
        z = P[2, 0] * n + P[2, 1] * e + P[2, 2] * d
        q[i, 0], q[i, 1], q[i, 2] = x, y, z
        beyond[i] = (z <= 0.0) | (x < 0.0) << 1 | (y < 0.0) << 2 | (x > width * z) << 3 | (y > height * z) << 4


@_part
def _cross(a: Any, b: Any) -> Any:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@_part
def _at(planes: Any, t: Any, begin: int, x: float, y: float) -> Any:
    """A triangle's edge function or 1/z, the one whose coefficients begin there."""
    return planes[u32(t), begin] * x + planes[u32(t), begin + 1] * y + planes[u32(t), begin + 2]


@njit(nogil=True, cache=True, error_model="numpy")
def fill(visible: Any, rows: Any, planes: Any, inverse_depth: Any, hit: Any) -> None:
    """Nearest triangle of each pixel: 1/z and its index (-1 for none), row spans from the edges' crossings."""
    width = hit.shape[1]
    inverse_depth[:], hit[:] = 0.0, -1
    for t in visible:
        for y in range(rows[t, 0], rows[t, 1] + 1):
            v = y + 0.5
            low, high = 0.0, width - 1.0
            for e in range(0, 9, 3):
                slope = planes[t, e]
                rest = planes[t, e + 1] * v + planes[t, e + 2]
                if slope > 0.0:
                    low = max(low, -rest / slope - 0.5)
                elif slope < 0.0:
                    high = min(high, -rest / slope - 0.5)
                elif rest < 0.0:
                    high = -1.0
            if low > high:
                continue
            x0 = math.ceil(low)
            step, start = f32(planes[t, 9]), f32(_at(planes, t, 9, x0 + 0.5, v))
            for x in range(x0, math.floor(high) + 1):
                value = start + step * f32(x - x0)
                if value > inverse_depth[y, x]:
                    inverse_depth[y, x], hit[y, x] = value, t


@_part
def _blend(a: Any, b: Any, weight: Any) -> Any:
    """Two bytes of a and b, in 16 bits each, mixed, weight of b in 1/256."""
    return u32(((a * u32(256 - weight) + b * weight) >> u32(8)) & u32(0x00FF00FF))


@_part
def _bilinear(texels: Any, base: Any, bits: Any, iu: Any, iv: Any) -> Any:
    """First and third byte, second and fourth of one level at (iu, iv) in 1/256 of a texel, repeating."""
    mask, lanes, odd = i32((1 << bits) - 1), u32(0x00FF00FF), u32(8)
    x0, y0 = i32((iu >> 8) & mask), i32((iv >> 8) & mask)
    x1, row0, row1 = i32((x0 + 1) & mask), i32(base + (y0 << bits)), i32(base + (i32((y0 + 1) & mask) << bits))
    wide, high = u32(iu & 255), u32(iv & 255)
    # Unsigned indices spare the check for negative ones.
    a, b, c, d = texels[u32(row0 + x0)], texels[u32(row0 + x1)], texels[u32(row1 + x0)], texels[u32(row1 + x1)]
    return (
        _blend(_blend(a & lanes, b & lanes, wide), _blend(c & lanes, d & lanes, wide), high),
        _blend(
            _blend((a >> odd) & lanes, (b >> odd) & lanes, wide), _blend((c >> odd) & lanes, (d >> odd) & lanes, wide),
            high,
        ),
    )  # fmt: skip


@_part
def sample(texels: Any, base: Any, bits: Any, u: Any, v: Any, level: Any) -> Any:
    """Trilinear colour at (u, v) in tiles, repeating, its bytes spread: the first in bits 0 to 15, then 3rd, 2nd, 4th.

    ``level`` 0 is the finest of ``bits`` + 1 levels, stored in turn from ``base``.
    """
    level = min(max(level, f32(0.0)), f32(bits))
    whole = max(i32(0), min(i32(level), i32(bits - 1)))  # also of NaN
    weight, left = u32((level - f32(whole)) * f32(256.0)), i32(bits - whole)
    across, area = f32(i32(i32(256) << left)), i32(i32(1) << i32(2 * left))
    iu, iv = i32(np.floor(u * across - f32(128.0))), i32(np.floor(v * across - f32(128.0)))
    # Levels before this one hold 4^bits + 4^(bits-1) + ... texels: every second bit of a number.
    start = i32(base + 4 * (0x55555555 & (1 << 2 * bits) - 1) - 4 * (0x55555555 & i32(area - 1)))
    fine = _bilinear(texels, start, left, iu, iv)
    coarse = _bilinear(texels, i32(start + area), i32(left - 1), i32((iu - 128) >> 1), i32((iv - 128) >> 1))
    odd = np.uint64(_blend(fine[1], coarse[1], weight))
    return np.uint64(_blend(fine[0], coarse[0], weight)) | odd << np.uint64(32)


@_part
def _byte(spread: Any, shift: int) -> Any:
    """One channel of a spread colour, linear light: textures are stored as square roots."""
    value = f32(i32((spread >> np.uint64(shift)) & np.uint64(255))) * f32(1.0 / 255.0)
    return value * value


@_part
def _log2(value: Any) -> Any:
    """Of a positive float32, to 1.2e-4, by a polynomial of its mantissa."""
    bits = f32(value).view(i32)
    m = i32((bits & 0x7FFFFF) | 0x3F800000).view(f32)
    return f32((bits >> 23) - 127) + (
        f32(-2.49835315) + m * (f32(4.02921139) + m * (f32(-2.07833517) + m * (f32(0.62603218) - m * f32(0.07844068))))
    )


@_part
def _exp2(value: Any) -> Any:
    """2 to the power of a float32 from -125 to 0, to 1e-4 of it."""
    whole = np.floor(value)
    f = value - whole
    of_f = f32(0.99990029) + f * (f32(0.69632477) + f * (f32(0.22469316) + f * f32(0.07896726)))
    return of_f * i32((i32(whole) + 127) << 23).view(f32)


@_part
def _seen(scene: Any, colour: Any, fine: Any, normal_d: Any, lit: Any, away: Any) -> Any:
    """Linear light (r, g, b) of a surface's colour and texel, in the sun's share ``lit``, through so much haze.

    On it falls sun, sky from above and light from the ground.
    """
    light, up = scene.light, f32(0.5) - f32(0.5) * f32(normal_d)
    clear = _exp2(max(f32(-125.0), f32(-1.0 / math.log(2.0)) * scene.fog_per_m * f32(away)))
    red = light[1, 0] * f32(lit) + light[2, 0] * up + light[3, 0] * (f32(1.0) - up)
    green = light[1, 1] * f32(lit) + light[2, 1] * up + light[3, 1] * (f32(1.0) - up)
    blue = light[1, 2] * f32(lit) + light[2, 2] * up + light[3, 2] * (f32(1.0) - up)
    clear_2, haze = f32(2.0) * clear, f32(1.0) - clear
    return (
        colour[0] * _byte(fine, 0) * red * clear_2 + light[4, 0] * haze,
        colour[1] * _byte(fine, 32) * green * clear_2 + light[4, 1] * haze,
        colour[2] * _byte(fine, 16) * blue * clear_2 + light[4, 2] * haze,
    )


@_part
def _ray(eye: Any, u: Any, v: Any) -> Any:
    """Through a pixel: right and down of 1 m ahead of the camera, and the ray north, east and down."""
    inverse_K, R = eye.inverse_K, eye.R
    cx = inverse_K[0, 0] * u + inverse_K[0, 1] * v + inverse_K[0, 2]
    cy = inverse_K[1, 1] * v + inverse_K[1, 2]
    n, e = R[0, 0] * cx + R[0, 1] * cy + R[0, 2], R[1, 0] * cx + R[1, 1] * cy + R[1, 2]
    return f32(cx), f32(cy), f32(n), f32(e), f32(R[2, 0] * cx + R[2, 1] * cy + R[2, 2])


@_part
def _toned(tone: Any, linear: Any) -> Any:
    """Linear light (r, g, b) through the tone curve, which is tabulated over the square root; packed."""
    most = u32(tone.shape[0] - 1)
    red = min(most, u32(np.sqrt(max(f32(0.0), linear[0])) * f32(1024.0)))
    green = min(most, u32(np.sqrt(max(f32(0.0), linear[1])) * f32(1024.0)))
    blue = min(most, u32(np.sqrt(max(f32(0.0), linear[2])) * f32(1024.0)))
    return u32(tone[red] | tone[green] << 8 | tone[blue] << 16)


@_part
def _put(rgb: Any, y: Any, x: Any, packed: Any) -> None:
    rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2] = packed & 255, (packed >> 8) & 255, (packed >> 16) & 255


@njit(nogil=True, cache=True, error_model="numpy")
def shade_scene(hit: Any, planes: Any, eye: Any, scene: Any, blobs: Any, shown: Any, depth: Any) -> None:
    """Colour, packed, and metric depth of every pixel from its triangle index, inf for sky.

    ``blobs`` (k, 9): a drone's place, radius and darkness; left, top, right and bottom of where its shadow may be.
    """
    width, tone, blobs = hit.shape[1], scene.tone.astype(i32), blobs.astype(f32)
    columns, free = np.empty((3, width), dtype=u32), np.empty(width, dtype=f32)
    skies, grounds, things = columns[0], columns[1], columns[2]
    eye = Eye(eye.K, eye.inverse_K, eye.R, eye.origin, 2.0**0.4 * eye.focal)  # a little sharper
    for y in range(hit.shape[0]):
        m, g, k = _sort(hit[y], planes, scene.faces, y + 0.5, depth[y], skies, grounds, things)
        _cast_shadows(blobs, scene.light[0], eye, y, depth[y], free)
        _shade_sky(skies[:m], eye, y, scene.sky, tone, shown[y])
        _shade_ground(grounds[:g], eye, y, (hit[y], depth[y], free), scene, tone, shown[y])
        _shade_things(things[:k], eye, y, (hit[y], depth[y], free), scene, tone, shown[y])


@_loop
def _sort(hit: Any, planes: Any, faces: Any, v: float, depth: Any, skies: Any, grounds: Any, things: Any) -> Any:
    """How many pixels of a row are sky, ground and things; their columns, and all depths."""
    m, g, k, last, ground, slope, rest, start = 0, 0, 0, -1, False, 0.0, 0.0, 0.0
    for x in range(hit.shape[0]):
        t = hit[x]
        if t < 0:
            depth[x], skies[m] = np.inf, x
            m += 1
            continue
        if t != last:
            last, ground = t, faces[t, 7] < 0.0
            slope, rest, start = planes[t, 9], planes[t, 10] * v, planes[t, 11]
        depth[x] = 1.0 / (slope * (x + 0.5) + rest + start)
        if ground:
            grounds[g] = x
            g += 1
        else:
            things[k] = x
            k += 1
    return m, g, k


@_loop
def _cast_shadows(blobs: Any, sun: Any, eye: Any, y: int, depth: Any, free: Any) -> None:
    """Share of sunlight that drones leave to each pixel of a row.

    Of a disc whose edge softens with distance, as the sun is not a point.
    """
    one, none, (on, oe, od) = f32(1.0), f32(0.0), eye.origin
    free[:] = one
    for k in range(blobs.shape[0]):
        bn, be, bd = f32(blobs[k, 0] - on), f32(blobs[k, 1] - oe), f32(blobs[k, 2] - od)
        radius, dark = blobs[k, 3], blobs[k, 4]
        for x in range(u32(blobs[k, 5]), u32(blobs[k, 7] if blobs[k, 6] <= y < blobs[k, 8] else none)):
            (_, _, n, e, d), z = _ray(eye, i32(x) + 0.5, y + 0.5), depth[x]
            n, e, d = bn - n * z, be - e * z, bd - d * z
            along = n * sun[0] + e * sun[1] + d * sun[2]
            off = np.sqrt(max(none, n * n + e * e + d * d - along * along))
            soft = f32(0.35) * radius + f32(0.01) * along
            covered = max(none, min(one, (radius + f32(0.5) * soft - off) / soft))
            free[x] *= one - dark * (covered if along > none else none)


@_loop
def _shade_sky(columns: Any, eye: Any, y: int, sky: Any, tone: Any, shown: Any) -> None:
    """From its map, an octahedral one of the upper half."""
    limit = f32(0.5 - 0.51 / (1 << SKY_BITS))  # off the opposite border
    for i in range(columns.shape[0]):
        x = columns[i]
        _, _, n, e, d = _ray(eye, i32(x) + 0.5, y + 0.5)
        scale = f32(0.5) / max(f32(1e-9), abs(n) + abs(e) + max(f32(0.0), -d))
        u = max(-limit, min(limit, (n + e) * scale)) + f32(0.5)
        v = max(-limit, min(limit, (n - e) * scale)) + f32(0.5)
        found, bright = sample(sky, 0, SKY_BITS, u, v, f32(0.0)), f32(4.0)
        shown[x] = _toned(tone, (bright * _byte(found, 0), bright * _byte(found, 32), bright * _byte(found, 16)))


@_loop
def _shade_ground(columns: Any, eye: Any, y: int, row: Any, scene: Any, tone: Any, shown: Any) -> None:
    """From its map of colours and sunlight, which is mirrored beyond its borders, and its detail."""
    (hit, depth, free), scale, half, size = row, f32(0.5) / scene.extent_m, f32(0.5), 1 << GROUND_MAP_BITS
    of_map, unshaded = f32(GROUND_MAP_BITS - math.log2(2.0 * scene.extent_m)), -scene.light[0, 2]
    for i in range(columns.shape[0]):
        x = columns[i]
        n, e, _, level, away = _met(eye, i32(x) + 0.5, y + 0.5, scene.faces, u32(hit[x]), depth[x])
        u, v = _mirrored(e * scale + half), _mirrored(n * scale + half)
        mapped = sample(scene.ground_map, 0, GROUND_MAP_BITS, u, v, level + of_map)
        # The ground's sunlight is baked into its map, and beyond that there is no shade.
        lit = free[x] * (unshaded if max(abs(n), abs(e)) > scene.extent_m else _byte(mapped, 48))
        column, line = min(u32(u * f32(size)), u32(size - 1)), min(u32(v * f32(size)), u32(size - 1))
        kind, of = u32(scene.ground_kind[line, column]), scene.ground_detail
        first, tiles, level = i32(i32(of[kind, 0]) * _TEXTURE_AREA), of[kind, 1], level + of[kind, 2]
        fine = sample(scene.texels, first, TEXTURE_BITS, e * tiles, n * tiles, level)
        colour = _byte(mapped, 0), _byte(mapped, 32), _byte(mapped, 16)
        shown[x] = _toned(tone, _seen(scene, colour, fine, f32(-1.0), lit, away))


@_loop
def _shade_things(columns: Any, eye: Any, y: int, row: Any, scene: Any, tone: Any, shown: Any) -> None:
    hit, depth, free = row
    for i in range(columns.shape[0]):
        x = columns[i]
        u, v = i32(x) + 0.5, y + 0.5
        of = _of_thing(scene, scene.faces, scene.texels, u32(hit[x]), eye, u, v, depth[x], free[x])
        shown[x] = _toned(tone, of)


@_part
def _of_thing(scene: Any, faces: Any, texels: Any, t: Any, eye: Any, u: Any, v: Any, z: Any, free: Any) -> Any:
    """Linear light (r, g, b) of a triangle's texture and tint, of the sun's share that drones leave it."""
    n, e, d, level, away = _met(eye, u, v, faces, t, z)
    nn, ne, nd, sun, beside = faces[t, 0], faces[t, 1], faces[t, 2], scene.light[0], f32(0.08)
    tu = faces[t, 8] * n + faces[t, 9] * e + faces[t, 10] * d + faces[t, 11]
    tv = faces[t, 12] * n + faces[t, 13] * e + faces[t, 14] * d + faces[t, 15]
    at = n + beside * nn, e + beside * ne, d + beside * nd
    lit = max(f32(0.0), nn * sun[0] + ne * sun[1] + nd * sun[2]) * free
    lit *= sun_reaches(scene.shadow_map, scene.shadow_frame, at[0], at[1], at[2])
    fine = sample(texels, i32(i32(faces[t, 7]) * _TEXTURE_AREA), TEXTURE_BITS, tu, tv, level + faces[t, 6])
    return _seen(scene, (faces[t, 3], faces[t, 4], faces[t, 5]), fine, nd, lit, away)


@_part
def _met(eye: Any, u: Any, v: Any, faces: Any, t: Any, z: Any) -> Any:
    """Where a pixel's ray meets a triangle, north, east and down; log2 of the pixel's footprint in metres; how far.

    The footprint is midway between its short side and its long one, which grazing views stretch.
    """
    (cx, cy, n, e, d), at = _ray(eye, u, v), eye.origin
    length = np.sqrt(cx * cx + cy * cy + f32(1.0))
    facing = max(f32(0.02) * length, -(n * faces[t, 0] + e * faces[t, 1] + d * faces[t, 2]))
    level = f32(0.5) * _log2(z * z * length / facing) - f32(math.log2(eye.focal))
    return f32(at[0]) + n * z, f32(at[1]) + e * z, f32(at[2]) + d * z, level, z * length


@_part
def _mirrored(share: Any) -> Any:
    """Beyond 0 and 1 a map goes on as its mirror image."""
    return f32(1.0) - abs(f32(1.0) - (share - f32(2.0) * np.floor(f32(0.5) * share)))


@njit(nogil=True, cache=True, error_model="numpy")
def smooth_edges(hit: Any, grounds: int, planes: Any, linear: Any, tone: Any, sharp: Any, rgb: Any) -> None:
    """Blend colours along edges by coverage: four samples in a pixel ask which of the 3x3 pixels' triangles covers it.

    A sample takes the colour of the pixel where its triangle was seen, so nothing is shaded twice. The first
    ``grounds`` triangles are the ground. ``sharp`` (h, w, 4) has a byte more than ``rgb``, which comes as its copy.
    """
    height, width = hit.shape
    words, marked = np.zeros(-(-width // 8), np.uint64), np.empty(width + 1, u32)
    near, row, column = np.empty(9, i32), np.empty(9, i32), np.empty(9, i32)
    for y in range(height):
        above, below = hit[max(0, y - 1)], hit[min(height - 1, y + 1)]
        for x in marked[: _mark_edges(grounds, hit[y], above, below, words, marked)]:
            t, edge = hit[y, x], False
            for k in range(4):
                i, j = x + (k == 0) - (k == 1), y + (k == 2) - (k == 3)
                if i < 0 or j < 0 or i >= width or j >= height or not _differ(grounds, t, hit[j, i]):
                    continue
                change = 0.0
                for channel in range(3):
                    change += abs(float(sharp[j, i, channel]) - float(sharp[y, x, channel]))
                edge = edge or change > 24.0
            if not edge:
                continue
            others = 0
            for j in range(max(0, y - 1), min(height, y + 2)):
                for i in range(max(0, x - 1), min(width, x + 2)):
                    if hit[j, i] != t and (others == 0 or hit[j, i] != near[others - 1]):
                        near[others], row[others], column[others] = hit[j, i], j, i
                        others += 1
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(4):
                u, v = x + 0.125 + 0.25 * k, y + 0.125 + 0.25 * ((2 * k + 1) % 5)
                # The pixel's own triangle first. Where none covers the sample: a neighbour's sky, else the pixel.
                j, i, nearest = y, x, _covering(planes, t, u, v)
                for one in range(others):
                    inverse = _covering(planes, near[one], u, v)
                    if inverse > nearest or (nearest == 0.0 and near[one] < 0 <= hit[j, i]):
                        j, i, nearest = row[one], column[one], inverse
                red += 0.25 * linear[sharp[j, i, 0]]
                green += 0.25 * linear[sharp[j, i, 1]]
                blue += 0.25 * linear[sharp[j, i, 2]]
            _put(rgb, y, x, _toned(tone, (red, green, blue)))


@_loop
def _mark_edges(grounds: int, row: Any, above: Any, below: Any, words: Any, marked: Any) -> Any:
    """In how many places a row differs from its pixel beside, above or below, and where; ``words`` have 8 of each."""
    differs, count = words.view(np.bool_), 0
    for x in range(row.shape[0]):
        differs[x] = _differ(grounds, row[x], above[x]) | _differ(grounds, row[x], below[x])
    for x in range(1, row.shape[0]):
        differs[x] |= _differ(grounds, row[x], row[x - 1])
    for x in range(row.shape[0] - 1):
        differs[x] |= _differ(grounds, row[x], row[x + 1])
    for word in range(words.shape[0]):
        if words[word]:  # seldom
            for x in range(8 * word, 8 * word + 8):
                marked[count] = x
                count += differs[x]
    return count


@_part
def _differ(grounds: int, t: Any, other: Any) -> Any:
    """Whether two pixels show different surfaces: all triangles of the ground are one."""
    return (t != other) & ((t >= grounds) | (other >= grounds) | (t < 0) | (other < 0))


@_part
def _covering(planes: Any, t: Any, u: float, v: float) -> Any:
    """1/z of a triangle there; 0 beside it, and of the sky."""
    one = max(t, 0)
    inside = (
        (_at(planes, one, 0, u, v) >= 0.0) & (_at(planes, one, 3, u, v) >= 0.0) & (_at(planes, one, 6, u, v) >= 0.0)
    )
    return max(0.0, _at(planes, one, 9, u, v)) if inside & (t >= 0) else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def lay_over(
    hit: Any, inverse_depth: Any, planes: Any, left: int, top: int, eye: Any, thing: Any, scene: Any, linear: Any,
    rgb: Any, depth: Any, ids: Any,
) -> None:  # fmt: skip
    """Lay one drone over the image by coverage, from its 3x3 supersampled triangle indices within a rectangle.

    Depth and identity come from the middle sample, the pixel's centre.
    """
    s, share = SUBSAMPLES, 1.0 / (SUBSAMPLES * SUBSAMPLES)
    for row in range(hit.shape[0] // s):
        y = top + row
        for column in range(hit.shape[1] // s):
            x = left + column
            limit = 1.0 / depth[y, x] if depth[y, x] < np.inf else 0.0
            covered, last, colour = 0, -1, (0.0, 0.0, 0.0)
            red, green, blue = 0.0, 0.0, 0.0
            for j in range(row * s, row * s + s):
                for i in range(column * s, column * s + s):
                    t = hit[j, i]
                    if t < 0 or inverse_depth[j, i] <= limit:
                        continue
                    covered += 1
                    if t != last:
                        last, z = t, f32(1.0 / _at(planes, t, 9, i + 0.5, j + 0.5))
                        u, v = left + (i + 0.5) / s, top + (j + 0.5) / s
                        colour = _of_thing(scene, thing.faces, thing.texels, u32(t), eye, u, v, z, f32(1.0))
                    red, green, blue = red + colour[0], green + colour[1], blue + colour[2]
            if covered == 0:
                continue
            rest = 1.0 - covered * share
            red = linear[rgb[y, x, 0]] * rest + red * share
            green = linear[rgb[y, x, 1]] * rest + green * share
            blue = linear[rgb[y, x, 2]] * rest + blue * share
            _put(rgb, y, x, _toned(scene.tone, (red, green, blue)))
            j, i = row * s + s // 2, column * s + s // 2
            if hit[j, i] >= 0 and inverse_depth[j, i] > limit:
                depth[y, x] = 1.0 / _at(planes, hit[j, i], 9, i + 0.5, j + 0.5)
                ids[y, x] = thing.identity
