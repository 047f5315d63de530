"""The renderer's inner loops, compiled: set up triangles, fill a depth buffer, shade what is seen.

No fastmath: a shared edge must give the same crossing from both of its triangles (no holes). Each runs on the thread
that calls it and releases the GIL, so that several images are drawn side by side. Compiled for parallel rows, they took
three times as long to compile, and half as much processor time again to run.
"""
# Compiled loops are long: a call for each few lines would cost more than it explains.
# ruff: noqa: PLR0912, PLR0915

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any

import numpy as np
from numba import njit

from flockd.sim.world.baking import GROUND_MAP_BITS, sun_reaches
from flockd.sim.world.sky import SKY_BITS
from flockd.sim.world.textures import TEXTURE_BITS

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
        rows[t, 0] = 0
        rows[t, 1] = -1
        a = triangles[t, 0]
        b = triangles[t, 1]
        c = triangles[t, 2]
        ax, ay, az = q[a, 0], q[a, 1], q[a, 2]
        bx, by, bz = q[b, 0], q[b, 1], q[b, 2]
        cx, cy, cz = q[c, 0], q[c, 1], q[c, 2]
        if az <= 0.0 and bz <= 0.0 and cz <= 0.0:
            continue
        if (ax < 0.0 and bx < 0.0 and cx < 0.0) or (ay < 0.0 and by < 0.0 and cy < 0.0):
            continue
        if ax > width * az and bx > width * bz and cx > width * cz:
            continue
        if ay > height * az and by > height * bz and cy > height * cz:
            continue
        e0x = by * cz - bz * cy
        e0y = bz * cx - bx * cz
        e0z = bx * cy - by * cx
        determinant = ax * e0x + ay * e0y + az * e0z
        if determinant > -1e-9:  # seen from behind, or edge on
            continue
        top = 0
        bottom = height - 1
        if az > 1e-6 and bz > 1e-6 and cz > 1e-6:
            va = ay / az
            vb = by / bz
            vc = cy / cz
            top = max(top, math.ceil(max(-1.0, min(va, vb, vc)) - 0.5))
            bottom = min(bottom, math.floor(min(height + 1.0, max(va, vb, vc)) - 0.5))
            ua = ax / az
            ub = bx / bz
            uc = cx / cz
            if math.ceil(min(ua, ub, uc) - 0.5) > math.floor(max(ua, ub, uc) - 0.5):  # between pixel centres
                continue
        if top > bottom:
            continue
        e1x = cy * az - cz * ay
        e1y = cz * ax - cx * az
        e1z = cx * ay - cy * ax
        e2x = ay * bz - az * by
        e2y = az * bx - ax * bz
        e2z = ax * by - ay * bx
        rows[t, 0] = top
        rows[t, 1] = bottom
        p = planes[t]
        p[0], p[1], p[2] = -e0x, -e0y, -e0z
        p[3], p[4], p[5] = -e1x, -e1y, -e1z
        p[6], p[7], p[8] = -e2x, -e2y, -e2z
        p[9] = (e0x + e1x + e2x) / determinant
        p[10] = (e0y + e1y + e2y) / determinant
        p[11] = (e0z + e1z + e2z) / determinant


@njit(nogil=True, cache=True, error_model="numpy")
def fill(visible: Any, rows: Any, planes: Any, inverse_depth: Any, hit: Any) -> None:
    """Nearest triangle of each pixel: 1/z and its index (-1 for none), row spans from the edges' crossings."""
    height, width = hit.shape
    for y in range(height):
        for x in range(width):
            inverse_depth[y, x] = 0.0
            hit[y, x] = -1
    for k in range(visible.shape[0]):
        t = visible[k]
        p = planes[t]
        for y in range(rows[t, 0], rows[t, 1] + 1):
            v = y + 0.5
            low = 0.0
            high = width - 1.0
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
            x1 = math.floor(high)
            step = np.float32(p[9])
            start = np.float32(p[9] * (x0 + 0.5) + p[10] * v + p[11])
            for x in range(x0, x1 + 1):
                value = start + step * np.float32(x - x0)
                if value > inverse_depth[y, x]:
                    inverse_depth[y, x] = value
                    hit[y, x] = t


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
    size = 1 << bits
    mask = size - 1
    fu = u * (size * 256.0) - 128.0
    fv = v * (size * 256.0) - 128.0
    iu = math.floor(fu)
    iv = math.floor(fv)
    wu = np.uint64(iu & 255)
    wv = np.uint64(iv & 255)
    x0 = (iu >> 8) & mask
    y0 = (iv >> 8) & mask
    x1 = (x0 + 1) & mask
    row0 = base + (y0 << bits)
    row1 = base + (((y0 + 1) & mask) << bits)
    # Unsigned indices spare the check for negative ones.
    a = _blend(_spread(texels[np.uint64(row0 + x0)]), _spread(texels[np.uint64(row0 + x1)]), wu)
    b = _blend(_spread(texels[np.uint64(row1 + x0)]), _spread(texels[np.uint64(row1 + x1)]), wu)
    return _blend(a, b, wv)


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
def _light(light: Any, normal_d: float, cosine: float) -> Any:
    """Irradiance (r, g, b) of a surface: sun times ``cosine`` (shadow included) plus sky above and ground below."""
    up = 0.5 - 0.5 * normal_d
    return (
        light[1, 0] * cosine + light[2, 0] * up + light[3, 0] * (1.0 - up),
        light[1, 1] * cosine + light[2, 1] * up + light[3, 1] * (1.0 - up),
        light[1, 2] * cosine + light[2, 2] * up + light[3, 2] * (1.0 - up),
    )


@njit(cache=True, error_model="numpy")
def _encode(tone: Any, value: float) -> Any:
    """Linear light to a display byte through the tone curve, which is tabulated over the square root."""
    index = int(math.sqrt(max(0.0, value)) * 1024.0)
    return tone[min(index, tone.shape[0] - 1)]


@njit(cache=True, error_model="numpy")
def _put(rgb: Any, y: int, x: int, tone: Any, red: float, green: float, blue: float) -> None:
    """Linear light into a pixel of the image."""
    rgb[y, x, 0] = _encode(tone, red)
    rgb[y, x, 1] = _encode(tone, green)
    rgb[y, x, 2] = _encode(tone, blue)


@njit(nogil=True, cache=True, error_model="numpy")
def shade_scene(hit: Any, planes: Any, eye: Any, scene: Any, blobs: Any, rgb: Any, depth: Any) -> None:
    """Colour and metric depth of every pixel from its triangle index, inf for sky.

    ``blobs`` (k, 9): a drone's place, radius and darkness; left, top, right and bottom of where its shadow may be.
    """
    inverse_K, R, origin = eye.inverse_K, eye.R, eye.origin
    light, tone, texture_area = scene.light, scene.tone, ((4 << (2 * TEXTURE_BITS)) - 1) // 3
    sun, size, limit = light[0], 1 << GROUND_MAP_BITS, 0.5 - 0.51 / (1 << SKY_BITS)  # off the opposite border
    sharper, of_map = math.log2(eye.focal) + 0.4, GROUND_MAP_BITS - math.log2(2.0 * scene.extent_m)
    for y in range(hit.shape[0]):
        for x in range(hit.shape[1]):
            t = hit[y, x]
            cx = inverse_K[0, 0] * (x + 0.5) + inverse_K[0, 1] * (y + 0.5) + inverse_K[0, 2]
            cy = inverse_K[1, 1] * (y + 0.5) + inverse_K[1, 2]
            rn = R[0, 0] * cx + R[0, 1] * cy + R[0, 2]
            re = R[1, 0] * cx + R[1, 1] * cy + R[1, 2]
            rd = R[2, 0] * cx + R[2, 1] * cy + R[2, 2]
            if t < 0:  # on the sky's map: an octahedral one of the upper half
                depth[y, x] = np.inf
                scale = 0.5 / max(1e-9, abs(rn) + abs(re) + max(0.0, -rd))
                u = max(-limit, min(limit, (rn + re) * scale)) + 0.5
                v = max(-limit, min(limit, (rn - re) * scale)) + 0.5
                found = sample(scene.sky, 0, SKY_BITS, u, v, 0.0)
                _put(rgb, y, x, tone, 4.0 * _byte(found, 0), 4.0 * _byte(found, 32), 4.0 * _byte(found, 16))
                continue
            z = 1.0 / (planes[t, 9] * (x + 0.5) + planes[t, 10] * (y + 0.5) + planes[t, 11])
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
                red, green, blue, baked = _byte(mapped, 0), _byte(mapped, 32), _byte(mapped, 16), _byte(mapped, 48)
                # The ground's sunlight is baked into its map, and beyond that there is no shade.
                lit *= -sun[2] if max(abs(n), abs(e)) > scene.extent_m else baked
                ground = scene.ground_kind[min(int(v * size), size - 1), min(int(u * size), size - 1)]
                kind, tiles = int(scene.ground_detail[ground, 0]), scene.ground_detail[ground, 1]
                u, v, level, nd = e * tiles, n * tiles, level + scene.ground_detail[ground, 2], -1.0
            else:
                red, green, blue, of = scene.tint[t, 0], scene.tint[t, 1], scene.tint[t, 2], scene.uv[t]
                u = of[0, 0] * n + of[0, 1] * e + of[0, 2] * d + of[0, 3]
                v = of[1, 0] * n + of[1, 1] * e + of[1, 2] * d + of[1, 3]
                level += scene.level[t]
                cosine = max(0.0, nn * sun[0] + ne * sun[1] + nd * sun[2])
                if cosine > 0.0:
                    at = n + 0.08 * nn, e + 0.08 * ne, d + 0.08 * nd
                    cosine *= sun_reaches(scene.shadow_map, scene.shadow_frame, at[0], at[1], at[2])
                lit *= cosine
            fine = sample(scene.texels, kind * texture_area, TEXTURE_BITS, u, v, level)
            of_red, of_green, of_blue = _light(light, nd, lit)
            clear = math.exp(-scene.fog_per_m * z * length)
            red = 2.0 * red * _byte(fine, 0) * of_red * clear + light[4, 0] * (1.0 - clear)
            green = 2.0 * green * _byte(fine, 32) * of_green * clear + light[4, 1] * (1.0 - clear)
            blue = 2.0 * blue * _byte(fine, 16) * of_blue * clear + light[4, 2] * (1.0 - clear)
            _put(rgb, y, x, tone, red, green, blue)


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
    seen = np.empty(9, dtype=np.int64)
    at = np.empty((9, 2), dtype=np.int64)
    for y in range(height):
        for x in range(width):
            t = hit[y, x]
            if (
                (x == 0 or hit[y, x - 1] == t)
                and (x + 1 == width or hit[y, x + 1] == t)
                and (y == 0 or hit[y - 1, x] == t)
                and (y + 1 == height or hit[y + 1, x] == t)
            ):
                continue
            edge = False
            for k in range(4):
                i = x + (k == 0) - (k == 1)
                j = y + (k == 2) - (k == 3)
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
            count = 1
            seen[0] = t
            at[0, 0] = y
            at[0, 1] = x
            for j in range(max(0, y - 1), min(height, y + 2)):
                for i in range(max(0, x - 1), min(width, x + 2)):
                    known = False
                    for k in range(count):
                        known = known or seen[k] == hit[j, i]
                    if not known:
                        seen[count] = hit[j, i]
                        at[count, 0] = j
                        at[count, 1] = i
                        count += 1
            red = 0.0
            green = 0.0
            blue = 0.0
            for sample_number in range(4):
                u = x + 0.125 + 0.25 * sample_number
                v = y + 0.125 + 0.25 * ((2 * sample_number + 1) % 5)
                best = -1
                nearest = 0.0
                for k in range(count):
                    if seen[k] < 0:
                        if best < 0:
                            best = k
                        continue
                    p = planes[seen[k]]
                    if (
                        p[0] * u + p[1] * v + p[2] >= 0.0
                        and p[3] * u + p[4] * v + p[5] >= 0.0
                        and p[6] * u + p[7] * v + p[8] >= 0.0
                    ):
                        inverse = p[9] * u + p[10] * v + p[11]
                        if inverse > nearest:
                            nearest = inverse
                            best = k
                best = max(0, best)  # covered by something that no pixel shows: as the pixel itself
                j = at[best, 0]
                i = at[best, 1]
                red += 0.25 * linear[sharp[j, i, 0]]
                green += 0.25 * linear[sharp[j, i, 1]]
                blue += 0.25 * linear[sharp[j, i, 2]]
            _put(rgb, y, x, tone, red, green, blue)


@njit(nogil=True, cache=True, error_model="numpy")
def lay_over(
    hit: Any,
    inverse_depth: Any,
    planes: Any,
    left: int,
    top: int,
    eye: Any,
    thing: Any,
    scene: Any,
    linear: Any,
    rgb: Any,
    depth: Any,
    ids: Any,
) -> None:
    """Lay one drone over the image by coverage, from its 3x3 supersampled triangle indices within a rectangle.

    Depth and identity come from the middle sample, the pixel's centre.
    """
    s = SUBSAMPLES
    inverse_K, R, origin, texture_bits = eye.inverse_K, eye.R, eye.origin, TEXTURE_BITS
    R_ned_body, position, normals, uv, colours = thing.rotation, thing.position, thing.normals, thing.uv, thing.colours
    light, tone = scene.light, scene.tone
    count = hit.shape[0] // s
    sun = light[0]
    texture_area = ((4 << (2 * texture_bits)) - 1) // 3
    texture_size = float(1 << texture_bits)
    for row in range(count):
        y = top + row
        for column in range(hit.shape[1] // s):
            x = left + column
            limit = 0.0
            if depth[y, x] < np.inf:
                limit = 1.0 / depth[y, x]
            covered = 0
            sum_red = 0.0
            sum_green = 0.0
            sum_blue = 0.0
            last = -1
            red = 0.0
            green = 0.0
            blue = 0.0
            for j in range(s):
                for i in range(s):
                    t = hit[row * s + j, column * s + i]
                    if t < 0 or inverse_depth[row * s + j, column * s + i] <= limit:
                        continue
                    covered += 1
                    if t != last:
                        last = t
                        a = column * s + i + 0.5
                        b = row * s + j + 0.5
                        z = 1.0 / (planes[t, 9] * a + planes[t, 10] * b + planes[t, 11])
                        u = left + a / s
                        v = top + b / s
                        cx = inverse_K[0, 0] * u + inverse_K[0, 1] * v + inverse_K[0, 2]
                        cy = inverse_K[1, 1] * v + inverse_K[1, 2]
                        rn = (R[0, 0] * cx + R[0, 1] * cy + R[0, 2]) * z
                        re = (R[1, 0] * cx + R[1, 1] * cy + R[1, 2]) * z
                        rd = (R[2, 0] * cx + R[2, 1] * cy + R[2, 2]) * z
                        away = math.sqrt(rn * rn + re * re + rd * rd)
                        nn, ne, nd = normals[t, 0], normals[t, 1], normals[t, 2]
                        n = origin[0] + rn - position[0]
                        e = origin[1] + re - position[1]
                        d = origin[2] + rd - position[2]
                        bx = R_ned_body[0, 0] * n + R_ned_body[1, 0] * e + R_ned_body[2, 0] * d
                        by = R_ned_body[0, 1] * n + R_ned_body[1, 1] * e + R_ned_body[2, 1] * d
                        bz = R_ned_body[0, 2] * n + R_ned_body[1, 2] * e + R_ned_body[2, 2] * d
                        tu = uv[t, 0, 0] * bx + uv[t, 0, 1] * by + uv[t, 0, 2] * bz + uv[t, 0, 3]
                        tv = uv[t, 1, 0] * bx + uv[t, 1, 1] * by + uv[t, 1, 2] * bz + uv[t, 1, 3]
                        facing = max(0.05, -(rn * nn + re * ne + rd * nd) / away)
                        # Tiles per metre are the same both ways on a drone.
                        tile = abs(uv[t, 0, 0]) + abs(uv[t, 0, 1]) + abs(uv[t, 0, 2])
                        fineness = math.log2(z / eye.focal / math.sqrt(facing) * texture_size * tile)
                        fine = sample(thing.texels, thing.texture[t] * texture_area, texture_bits, tu, tv, fineness)
                        cosine = nn * sun[0] + ne * sun[1] + nd * sun[2]
                        if cosine > 0.0:
                            cosine *= sun_reaches(
                                scene.shadow_map, scene.shadow_frame, n + position[0], e + position[1], d + position[2]
                            )
                        red, green, blue = _light(light, nd, max(0.0, cosine))
                        clear = math.exp(-scene.fog_per_m * away)
                        red = red * 2.0 * colours[t, 0] * _byte(fine, 0) * clear + light[4, 0] * (1.0 - clear)
                        green = green * 2.0 * colours[t, 1] * _byte(fine, 32) * clear + light[4, 1] * (1.0 - clear)
                        blue = blue * 2.0 * colours[t, 2] * _byte(fine, 16) * clear + light[4, 2] * (1.0 - clear)
                    sum_red += red
                    sum_green += green
                    sum_blue += blue
            if covered == 0:
                continue
            share = 1.0 / (s * s)
            rest = 1.0 - covered * share
            red = linear[rgb[y, x, 0]] * rest + sum_red * share
            green = linear[rgb[y, x, 1]] * rest + sum_green * share
            blue = linear[rgb[y, x, 2]] * rest + sum_blue * share
            _put(rgb, y, x, tone, red, green, blue)
            middle_y = row * s + s // 2
            middle_x = column * s + s // 2
            t = hit[middle_y, middle_x]
            if t >= 0 and inverse_depth[middle_y, middle_x] > limit:
                depth[y, x] = 1.0 / (planes[t, 9] * (middle_x + 0.5) + planes[t, 10] * (middle_y + 0.5) + planes[t, 11])
                ids[y, x] = thing.identity
