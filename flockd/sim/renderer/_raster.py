"""The renderer's inner loops, compiled: set up triangles, fill a depth buffer, shade what is seen.

No fastmath: a shared edge must give the same crossing from both of its triangles (no holes). Each runs on the thread
that calls it and releases the GIL, so that several images are drawn side by side. Compiled for parallel rows, they took
three times as long to compile, and half as much processor time again to run.
"""
# Compiled loops are long: a call for each few lines would cost more than it explains.

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any

import numpy as np
from numba import njit

from flockd.sim.world.baking import GROUND_MAP_BITS, sun_reaches
from flockd.sim.world.sky import SKY_BITS
from flockd.sim.world.textures import TEXTURE_BITS

_TEXTURE_AREA = ((4 << (2 * TEXTURE_BITS)) - 1) // 3
"""Texels of a texture's pyramid."""
SUBSAMPLES = 3
"""Drone colours are sampled 3x3 per pixel; the middle sample is the pixel's centre."""
Eye = namedtuple("Eye", ["K", "inverse_K", "R", "origin", "focal"])
"""A pinhole camera in the world: `Renderer.render` says of what shapes; `R` is from optical axes to NED."""
Scene = namedtuple(
    "Scene",
    "normals texture uv level tint texels ground_map ground_kind ground_detail extent_m shadow_map shadow_frame light "
    "fog_per_m sky tone",
)
"""What colours of a `World` are made of, by the names and with the shapes that it has there."""
Thing = namedtuple("Thing", ["identity", "rotation", "position", "normals", "texture", "uv", "colours", "texels"])
"""What is laid over an image: a drone of a pose, and its number there.

`normals` are NED, `uv` is in body axes, `texels` are its machine textures.
"""


@njit(nogil=True, cache=True, error_model="numpy")
def set_up_triangles(q: Any, triangles: Any, width: int, height: int, rows: Any, planes: Any) -> None:
    """Row range and plane coefficients of each triangle that can be seen; rows (0, -1) for the others.

    ``planes[t]`` holds three edge functions (a, b, c), positive inside, and 1/z, each linear in (u, v, 1). They are
    homogeneous (cross products of the corners), so a triangle that reaches behind the camera needs no clipping.
    """
    for t in range(triangles.shape[0]):
        rows[t, 0], rows[t, 1] = 0, -1
        a, b, c = q[triangles[t, 0]], q[triangles[t, 1]], q[triangles[t, 2]]
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (a[0], a[1], a[2]), (b[0], b[1], b[2]), (c[0], c[1], c[2])
        if az <= 0.0 and bz <= 0.0 and cz <= 0.0:
            continue
        if (ax < 0.0 and bx < 0.0 and cx < 0.0) or (ay < 0.0 and by < 0.0 and cy < 0.0):
            continue
        if ax > width * az and bx > width * bz and cx > width * cz:
            continue
        if ay > height * az and by > height * bz and cy > height * cz:
            continue
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
        rows[t, 0], rows[t, 1] = top, bottom
        second, third, p = _cross(c, a), _cross(a, b), planes[t]
        p[0], p[1], p[2] = -first[0], -first[1], -first[2]
        p[3], p[4], p[5] = -second[0], -second[1], -second[2]
        p[6], p[7], p[8] = -third[0], -third[1], -third[2]
        p[9] = (first[0] + second[0] + third[0]) / determinant
        p[10] = (first[1] + second[1] + third[1]) / determinant
        p[11] = (first[2] + second[2] + third[2]) / determinant


@njit(cache=True, error_model="numpy")
def _cross(a: Any, b: Any) -> Any:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, error_model="numpy")
def _at(plane: Any, begin: int, x: float, y: float) -> float:
    """A plane's edge function or 1/z, the one whose coefficients begin there."""
    return float(plane[begin] * x + plane[begin + 1] * y + plane[begin + 2])


@njit(nogil=True, cache=True, error_model="numpy")
def fill(visible: Any, rows: Any, planes: Any, inverse_depth: Any, hit: Any) -> None:
    """Nearest triangle of each pixel: 1/z and its index (-1 for none), row spans from the edges' crossings."""
    width = hit.shape[1]
    inverse_depth[:], hit[:] = 0.0, -1
    for t in visible:
        p = planes[t]
        for y in range(rows[t, 0], rows[t, 1] + 1):
            v = y + 0.5
            low, high = 0.0, width - 1.0
            for e in range(0, 9, 3):
                slope = p[e]
                rest = p[e + 1] * v + p[e + 2]
                if slope > 0.0:
                    low = max(low, -rest / slope - 0.5)
                elif slope < 0.0:
                    high = min(high, -rest / slope - 0.5)
                elif rest < 0.0:
                    high = -1.0
            if low > high:
                continue
            x0 = math.ceil(low)
            step, start = np.float32(p[9]), np.float32(_at(p, 9, x0 + 0.5, v))
            for x in range(x0, math.floor(high) + 1):
                value = start + step * np.float32(x - x0)
                if value > inverse_depth[y, x]:
                    inverse_depth[y, x], hit[y, x] = value, t


@njit(cache=True, error_model="numpy")
def _spread(packed: Any) -> Any:
    """Four packed bytes, each in 16 bits of its own: the first, third, second and fourth from below."""
    wide = np.uint64(packed)
    return (wide | wide << np.uint64(24)) & np.uint64(0x00FF00FF00FF00FF)


@njit(cache=True, error_model="numpy")
def _blend(a: Any, b: Any, weight: Any) -> Any:
    """Four spread bytes of a and b mixed, weight of b in 1/256."""
    lanes = np.uint64(0x00FF00FF00FF00FF)
    return ((a * (np.uint64(256) - weight) + b * weight) >> np.uint64(8)) & lanes


@njit(cache=True, error_model="numpy")
def _bilinear(texels: Any, base: int, bits: int, u: float, v: float) -> Any:
    """Spread colour of one level at (u, v) in tiles, repeating."""
    mask = (1 << bits) - 1
    fu, fv = u * ((1 << bits) * 256.0) - 128.0, v * ((1 << bits) * 256.0) - 128.0
    iu, iv = math.floor(fu), math.floor(fv)
    x0, y0 = (iu >> 8) & mask, (iv >> 8) & mask
    x1, row0, row1 = (x0 + 1) & mask, base + (y0 << bits), base + (((y0 + 1) & mask) << bits)
    # Unsigned indices spare the check for negative ones.
    wide, high = np.uint64(iu & 255), np.uint64(iv & 255)
    a = _blend(_spread(texels[np.uint64(row0 + x0)]), _spread(texels[np.uint64(row0 + x1)]), wide)
    b = _blend(_spread(texels[np.uint64(row1 + x0)]), _spread(texels[np.uint64(row1 + x1)]), wide)
    return _blend(a, b, high)


@njit(cache=True, error_model="numpy")
def sample(texels: Any, base: int, bits: int, u: float, v: float, level: float) -> Any:
    """Trilinear spread colour; ``level`` 0 is the finest of ``bits`` + 1 levels, stored in turn from ``base``."""
    if level <= 0.0:
        return _bilinear(texels, base, bits, u, v)
    whole = int(level)
    if whole >= bits:
        return _spread(texels[base + ((4 << (2 * bits)) - 1) // 3 - 1])
    # Levels before this one hold 4^bits + 4^(bits-1) + ... texels.
    start = base + ((4 << (2 * bits)) - (4 << (2 * (bits - whole)))) // 3
    fine = _bilinear(texels, start, bits - whole, u, v)
    weight = np.uint64((level - whole) * 256.0)
    coarse = _bilinear(texels, start + (1 << (2 * (bits - whole))), bits - whole - 1, u, v)
    return _blend(fine, coarse, weight)


@njit(cache=True, error_model="numpy")
def _byte(spread: Any, shift: int) -> float:
    """One channel of a spread colour, linear light: textures are stored as square roots."""
    value = float((spread >> np.uint64(shift)) & np.uint64(255)) * (1.0 / 255.0)
    return value * value


@njit(cache=True, error_model="numpy")
def _seen(scene: Any, colour: Any, fine: Any, normal_d: float, lit: float, away: float) -> Any:
    """Linear light (r, g, b) of a surface's colour and texel, in the sun's share ``lit``, through so much haze.

    On it falls sun, sky from above and light from the ground.
    """
    light, up, clear = scene.light, 0.5 - 0.5 * normal_d, math.exp(-scene.fog_per_m * away)
    red = light[1, 0] * lit + light[2, 0] * up + light[3, 0] * (1.0 - up)
    green = light[1, 1] * lit + light[2, 1] * up + light[3, 1] * (1.0 - up)
    blue = light[1, 2] * lit + light[2, 2] * up + light[3, 2] * (1.0 - up)
    return (
        2.0 * colour[0] * _byte(fine, 0) * red * clear + light[4, 0] * (1.0 - clear),
        2.0 * colour[1] * _byte(fine, 32) * green * clear + light[4, 1] * (1.0 - clear),
        2.0 * colour[2] * _byte(fine, 16) * blue * clear + light[4, 2] * (1.0 - clear),
    )


@njit(cache=True, error_model="numpy")
def _ray(eye: Any, u: float, v: float) -> Any:
    """Through a pixel: right and down of 1 m ahead of the camera, and the ray north, east and down."""
    inverse_K, R = eye.inverse_K, eye.R
    cx = inverse_K[0, 0] * u + inverse_K[0, 1] * v + inverse_K[0, 2]
    cy = inverse_K[1, 1] * v + inverse_K[1, 2]
    return (
        cx, cy, R[0, 0] * cx + R[0, 1] * cy + R[0, 2], R[1, 0] * cx + R[1, 1] * cy + R[1, 2],
        R[2, 0] * cx + R[2, 1] * cy + R[2, 2],
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _put(rgb: Any, y: int, x: int, tone: Any, linear: Any) -> None:
    """Linear light (r, g, b) into a pixel, through the tone curve, which is tabulated over the square root."""
    for channel in range(3):
        index = int(math.sqrt(max(0.0, linear[channel])) * 1024.0)
        rgb[y, x, channel] = tone[min(index, tone.shape[0] - 1)]


@njit(nogil=True, cache=True, error_model="numpy")
def shade_scene(hit: Any, planes: Any, eye: Any, scene: Any, blobs: Any, rgb: Any, depth: Any) -> None:
    """Colour and metric depth of every pixel from its triangle index, inf for sky.

    ``blobs`` (k, 9): a drone's place, radius and darkness; left, top, right and bottom of where its shadow may be.
    """
    origin, tone, sun, size = eye.origin, scene.tone, scene.light[0], 1 << GROUND_MAP_BITS
    limit = 0.5 - 0.51 / (1 << SKY_BITS)  # off the opposite border
    sharper, of_map = math.log2(eye.focal) + 0.4, GROUND_MAP_BITS - math.log2(2.0 * scene.extent_m)
    for y in range(hit.shape[0]):
        for x in range(hit.shape[1]):
            t = hit[y, x]
            cx, cy, rn, re, rd = _ray(eye, x + 0.5, y + 0.5)
            if t < 0:  # on the sky's map: an octahedral one of the upper half
                depth[y, x] = np.inf
                scale = 0.5 / max(1e-9, abs(rn) + abs(re) + max(0.0, -rd))
                u = max(-limit, min(limit, (rn + re) * scale)) + 0.5
                v = max(-limit, min(limit, (rn - re) * scale)) + 0.5
                found = sample(scene.sky, 0, SKY_BITS, u, v, 0.0)
                _put(rgb, y, x, tone, (4.0 * _byte(found, 0), 4.0 * _byte(found, 32), 4.0 * _byte(found, 16)))
                continue
            z = 1.0 / _at(planes[t], 9, x + 0.5, y + 0.5)
            depth[y, x] = z
            n, e, d = origin[0] + rn * z, origin[1] + re * z, origin[2] + rd * z
            nn, ne, nd = scene.normals[t, 0], scene.normals[t, 1], scene.normals[t, 2]
            length = math.sqrt(cx * cx + cy * cy + 1.0)
            facing = max(0.02 * length, -(rn * nn + re * ne + rd * nd))
            # A pixel's footprint: midway between its short side and its long one, which grazing views stretch; a
            # little sharper than that.
            level = 0.5 * math.log2(z * z * length / facing) - sharper
            lit = 1.0
            for k in range(blobs.shape[0]):
                if blobs[k, 5] <= x < blobs[k, 7] and blobs[k, 6] <= y < blobs[k, 8]:
                    lit *= _left_by(blobs[k], sun, n, e, d)
            kind = scene.texture[t]
            if kind < 0:
                u, v = _mirrored(0.5 * e / scene.extent_m + 0.5), _mirrored(0.5 * n / scene.extent_m + 0.5)
                mapped = sample(scene.ground_map, 0, GROUND_MAP_BITS, u, v, level + of_map)
                colour = _byte(mapped, 0), _byte(mapped, 32), _byte(mapped, 16)
                # The ground's sunlight is baked into its map, and beyond that there is no shade.
                lit *= -sun[2] if max(abs(n), abs(e)) > scene.extent_m else _byte(mapped, 48)
                ground = scene.ground_kind[min(int(v * size), size - 1), min(int(u * size), size - 1)]
                kind, tiles = int(scene.ground_detail[ground, 0]), scene.ground_detail[ground, 1]
                u, v, level, nd = e * tiles, n * tiles, level + scene.ground_detail[ground, 2], -1.0
            else:
                colour, of = (scene.tint[t, 0], scene.tint[t, 1], scene.tint[t, 2]), scene.uv[t]
                u = of[0, 0] * n + of[0, 1] * e + of[0, 2] * d + of[0, 3]
                v = of[1, 0] * n + of[1, 1] * e + of[1, 2] * d + of[1, 3]
                level += scene.level[t]
                cosine = max(0.0, nn * sun[0] + ne * sun[1] + nd * sun[2])
                if cosine > 0.0:
                    at = n + 0.08 * nn, e + 0.08 * ne, d + 0.08 * nd
                    cosine *= sun_reaches(scene.shadow_map, scene.shadow_frame, at[0], at[1], at[2])
                lit *= cosine
            fine = sample(scene.texels, kind * _TEXTURE_AREA, TEXTURE_BITS, u, v, level)
            _put(rgb, y, x, tone, _seen(scene, colour, fine, nd, lit, z * length))


@njit(cache=True, error_model="numpy")
def _mirrored(share: float) -> float:
    """Beyond 0 and 1 a map goes on as its mirror image."""
    return 1.0 - abs(1.0 - (share - 2.0 * math.floor(0.5 * share)))


@njit(cache=True, error_model="numpy")
def _left_by(blob: Any, sun: Any, n: float, e: float, d: float) -> float:
    """Share of sunlight that a drone leaves: of a disc whose edge softens with distance, as the sun is not a point."""
    bn, be, bd = blob[0] - n, blob[1] - e, blob[2] - d
    along = bn * sun[0] + be * sun[1] + bd * sun[2]
    if along <= 0.0:
        return 1.0
    off = math.sqrt(max(0.0, bn * bn + be * be + bd * bd - along * along))
    soft = 0.35 * blob[3] + 0.01 * along
    return float(1.0 - blob[4] * max(0.0, min(1.0, (blob[3] + 0.5 * soft - off) / soft)))


@njit(nogil=True, cache=True, error_model="numpy")
def smooth_edges(hit: Any, texture: Any, planes: Any, linear: Any, tone: Any, sharp: Any, rgb: Any) -> None:
    """Blend colours along edges by coverage: four samples in a pixel ask which of the 3x3 pixels' triangles covers it.

    A sample takes the colour of the pixel where its triangle was seen, so nothing is shaded twice. ``rgb`` comes as a
    copy of ``sharp``.
    """
    height, width = hit.shape
    for y in range(height):
        for x in range(width):
            t, edge = hit[y, x], False
            for k in range(4):
                i, j = x + (k == 0) - (k == 1), y + (k == 2) - (k == 3)
                if i < 0 or j < 0 or i >= width or j >= height or hit[j, i] == t:
                    continue
                if t >= 0 and hit[j, i] >= 0 and texture[t] < 0 and texture[hit[j, i]] < 0:
                    continue  # the ground runs on
                change = 0.0
                for channel in range(3):
                    change += abs(float(sharp[j, i, channel]) - float(sharp[y, x, channel]))
                edge = edge or change > 24.0
            if not edge:
                continue
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(4):
                u, v = x + 0.125 + 0.25 * k, y + 0.125 + 0.25 * ((2 * k + 1) % 5)
                # The pixel's own triangle first. Where none covers the sample: a neighbour's sky, else the pixel.
                best, nearest = (y, x), _covering(planes, t, u, v)
                for j in range(max(0, y - 1), min(height, y + 2)):
                    for i in range(max(0, x - 1), min(width, x + 2)):
                        inverse = _covering(planes, hit[j, i], u, v)
                        if inverse > nearest or (nearest == 0.0 and hit[j, i] < 0 <= hit[best[0], best[1]]):
                            best, nearest = (j, i), inverse
                j, i = best
                red += 0.25 * linear[sharp[j, i, 0]]
                green += 0.25 * linear[sharp[j, i, 1]]
                blue += 0.25 * linear[sharp[j, i, 2]]
            _put(rgb, y, x, tone, (red, green, blue))


@njit(cache=True, error_model="numpy")
def _covering(planes: Any, t: int, u: float, v: float) -> float:
    """1/z of a triangle there; 0 beside it, and of the sky."""
    if t < 0 or _at(planes[t], 0, u, v) < 0.0 or _at(planes[t], 3, u, v) < 0.0 or _at(planes[t], 6, u, v) < 0.0:
        return 0.0
    return max(0.0, _at(planes[t], 9, u, v))


@njit(nogil=True, cache=True, error_model="numpy")
def lay_over(
    hit: Any, inverse_depth: Any, planes: Any, left: int, top: int, eye: Any, thing: Any, scene: Any, linear: Any,
    rgb: Any, depth: Any, ids: Any,
) -> None:  # fmt: skip
    """Lay one drone over the image by coverage, from its 3x3 supersampled triangle indices within a rectangle.

    Depth and identity come from the middle sample, the pixel's centre.
    """
    s, origin, R, position, uv = SUBSAMPLES, eye.origin, thing.rotation, thing.position, thing.uv
    sun, share = scene.light[0], 1.0 / (s * s)
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
                        last, z = t, 1.0 / _at(planes[t], 9, i + 0.5, j + 0.5)
                        _, _, rn, re, rd = _ray(eye, left + (i + 0.5) / s, top + (j + 0.5) / s)
                        rn, re, rd = rn * z, re * z, rd * z
                        away = math.sqrt(rn * rn + re * re + rd * rd)
                        nn, ne, nd = thing.normals[t, 0], thing.normals[t, 1], thing.normals[t, 2]
                        n, e = origin[0] + rn - position[0], origin[1] + re - position[1]
                        d = origin[2] + rd - position[2]
                        bx = R[0, 0] * n + R[1, 0] * e + R[2, 0] * d
                        by = R[0, 1] * n + R[1, 1] * e + R[2, 1] * d
                        bz = R[0, 2] * n + R[1, 2] * e + R[2, 2] * d
                        tu = uv[t, 0, 0] * bx + uv[t, 0, 1] * by + uv[t, 0, 2] * bz + uv[t, 0, 3]
                        tv = uv[t, 1, 0] * bx + uv[t, 1, 1] * by + uv[t, 1, 2] * bz + uv[t, 1, 3]
                        facing = max(0.05, -(rn * nn + re * ne + rd * nd) / away)
                        # Tiles per metre are the same both ways on a drone.
                        tile = abs(uv[t, 0, 0]) + abs(uv[t, 0, 1]) + abs(uv[t, 0, 2])
                        level = math.log2(z / eye.focal / math.sqrt(facing) * float(1 << TEXTURE_BITS) * tile)
                        fine = sample(thing.texels, thing.texture[t] * _TEXTURE_AREA, TEXTURE_BITS, tu, tv, level)
                        lit = max(0.0, nn * sun[0] + ne * sun[1] + nd * sun[2])
                        if lit > 0.0:
                            at = n + position[0], e + position[1], d + position[2]
                            lit *= sun_reaches(scene.shadow_map, scene.shadow_frame, at[0], at[1], at[2])
                        colour = _seen(scene, thing.colours[t], fine, nd, lit, away)
                    red, green, blue = red + colour[0], green + colour[1], blue + colour[2]
            if covered == 0:
                continue
            rest = 1.0 - covered * share
            red = linear[rgb[y, x, 0]] * rest + red * share
            green = linear[rgb[y, x, 1]] * rest + green * share
            blue = linear[rgb[y, x, 2]] * rest + blue * share
            _put(rgb, y, x, scene.tone, (red, green, blue))
            j, i = row * s + s // 2, column * s + s // 2
            if hit[j, i] >= 0 and inverse_depth[j, i] > limit:
                depth[y, x] = 1.0 / _at(planes[hit[j, i]], 9, i + 0.5, j + 0.5)
                ids[y, x] = thing.identity
