"""Seeded tileable textures: fractal noise and patterns, as packed mip pyramids for the renderer.

A texture is linear light, (size, size, 3) float32 in 0..1 with a mean near 0.5 (the renderer doubles it), and repeats
without a seam. Its width is one tile, whatever that is in metres.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.core.messages import Float32Array, FloatArray

TEXTURE_BITS = 9
SIZE = 1 << TEXTURE_BITS
PackedArray = NDArray[np.uint32]


def pack_pyramid(texture: Float32Array) -> PackedArray:
    """All mip levels of a (2^k, 2^k, 3 or 4) texture, finest first, flat, four bytes in a word (red lowest).

    Averages are taken in linear light; bytes hold its square root.
    """
    level = texture
    levels = []
    while True:
        code = (np.sqrt(np.clip(level, 0.0, 1.0)) * np.float32(255.0) + np.float32(0.5)).astype(np.uint32)
        packed = code[..., 0] | code[..., 1] << np.uint32(8) | code[..., 2] << np.uint32(16)
        if texture.shape[2] == 4:
            packed |= code[..., 3] << np.uint32(24)
        levels.append(packed.ravel())
        if level.shape[0] == 1:
            return np.concatenate(levels)
        rows = level[0::2] + level[1::2]
        level = (rows[:, 0::2] + rows[:, 1::2]) * np.float32(0.25)


def fractal_noise(
    rng: Generator, size: int = SIZE, *, slope: float = 1.0, finest: float = 2.0, coarsest: float = 0.5,
    stretch: float = 1.0,
) -> Float32Array:  # fmt: skip
    """Tileable noise (size, size), mean 0, standard deviation 1.

    ``slope``: amplitude falls as frequency^-slope (0 white, 1 natural, 2 smooth). Wavelengths from ``finest`` pixels to
    ``coarsest`` tiles. ``stretch`` > 1 draws it out along rows.
    """
    spectrum = np.fft.rfft2(rng.standard_normal((size, size), dtype=np.float32))
    fy = np.fft.fftfreq(size)[:, None].astype(np.float32)
    fx = np.fft.rfftfreq(size)[None, :].astype(np.float32)
    frequency = np.hypot(fx * np.float32(stretch), fy / np.float32(stretch))
    frequency[0, 0] = 1.0
    gain = np.power(frequency, np.float32(-slope))
    gain *= np.exp(-((frequency * np.float32(finest) / 2) ** 4)) * (frequency * size * coarsest >= 0.5)
    gain[0, 0] = 0.0
    noise = np.fft.irfft2(spectrum * gain, s=(size, size)).astype(np.float32)
    return np.asarray(noise / noise.std(), dtype=np.float32)


def _grid() -> tuple[Float32Array, Float32Array]:
    """Row and column of each texel's centre in 0..1, (SIZE, 1) and (1, SIZE)."""
    axis = (np.arange(SIZE, dtype=np.float32) + np.float32(0.5)) / np.float32(SIZE)
    return axis[:, None], axis[None, :]


def _coloured(value: Float32Array, tint: Float32Array | None = None, amount: float = 0.0) -> Float32Array:
    """Grey (size, size) as colour, its hue moved by a second noise."""
    value = value.astype(np.float32)
    rgb = np.repeat(value[..., None], 3, axis=2)
    if tint is not None:
        rgb *= 1.0 + amount * tint[..., None] * np.array([1.0, 0.1, -1.0], dtype=np.float32)
    return np.asarray(np.clip(rgb * (0.5 / max(1e-3, float(value.mean()))), 0.02, 1.0), dtype=np.float32)


def _cells(rng: Generator, least: int, most: int, darkest: float) -> tuple[Float32Array, Float32Array]:
    """Tileable Worley cells on a jittered square grid: 0 at their borders, and a shade of each from `darkest` to 1."""
    count = int(rng.integers(least, most))
    jitter = rng.random((count, count, 2), dtype=np.float32)
    rows, columns = _grid()
    nearest = np.full((SIZE, SIZE), 9.0, dtype=np.float32)
    second = nearest.copy()
    cell = np.zeros((SIZE, SIZE), dtype=np.int64)
    base_row, base_column = (np.floor(axis * count).astype(np.int64) for axis in (rows, columns))
    for dr, dc in itertools.product((-1, 0, 1), repeat=2):
        row, column = base_row + dr, base_column + dc
        point = jitter[row % count, column % count]
        distance = np.hypot(rows * count - row - point[..., 0], columns * count - column - point[..., 1])
        closer = distance < nearest
        second = np.where(closer, nearest, np.minimum(second, distance)).astype(np.float32)
        nearest = np.where(closer, distance, nearest).astype(np.float32)
        cell = np.where(closer, row % count * count + column % count, cell)
    return second - nearest, rng.uniform(darkest, 1.0, cell.max() + 1).astype(np.float32)[cell]


def grass(rng: Generator) -> Float32Array:
    """Blades and tufts."""
    fine = fractal_noise(rng, slope=0.4, stretch=float(rng.uniform(1.0, 1.6)))
    tufts = fractal_noise(rng, slope=1.2)
    return _coloured(np.exp(0.45 * fine + 0.4 * tufts), fractal_noise(rng, slope=1.0), 0.15)


def soil(rng: Generator) -> Float32Array:
    """Earth with clods."""
    clods = fractal_noise(rng, slope=float(rng.uniform(0.8, 1.3)))
    stones = np.maximum(0.0, fractal_noise(rng, slope=0.5, finest=6.0) - 1.6)
    return _coloured(np.exp(0.42 * clods) + 0.35 * stones, fractal_noise(rng, slope=1.5), 0.08)


def gravel(rng: Generator) -> Float32Array:
    """Pebbles of many greys."""
    edge, shade = _cells(rng, 24, 60, 0.45)
    value = shade * (0.35 + 0.65 * np.minimum(1.0, 3.0 * edge))
    return _coloured(value * np.exp(0.08 * fractal_noise(rng)), fractal_noise(rng, slope=0.3), 0.06)


def asphalt(rng: Generator) -> Float32Array:
    """Fine grain with cracks and repairs."""
    grain = fractal_noise(rng, slope=0.15)
    wear = fractal_noise(rng, slope=1.5)
    value = np.exp(0.26 * grain + 0.22 * wear)
    cracks = np.abs(fractal_noise(rng, slope=1.3, finest=3.0))
    value *= np.where(cracks < rng.uniform(0.005, 0.04), 0.55, 1.0)
    return _coloured(value)


def stone_cells(rng: Generator) -> Float32Array:
    """Irregular flagstones or dried mud."""
    edge, shade = _cells(rng, 4, 9, 0.5)
    value = shade * np.where(edge < 0.06, 0.45, 1.0) * np.exp(0.2 * fractal_noise(rng, slope=0.8))
    return _coloured(value, fractal_noise(rng, slope=1.4), 0.1)


def _courses(rng: Generator, rows: int, columns: int, *, offset: float, joint: float) -> Float32Array:
    """Laid rectangles: each its own shade, dark or light joints."""
    r, c = _grid()
    row = np.floor(r * rows).astype(np.int64)
    shifted = (c * columns + offset * (row % 2)) % columns
    column = np.floor(shifted).astype(np.int64)
    shade = rng.uniform(0.55, 1.0, (rows, columns)).astype(np.float32)[row, column % columns]
    across = np.minimum((r * rows) % 1.0, 1.0 - (r * rows) % 1.0) / rows
    along = np.minimum(shifted % 1.0, 1.0 - shifted % 1.0) / columns
    border = np.minimum(across, along) < joint
    return np.where(border, np.float32(rng.choice([0.4, 0.55, 1.05])), shade).astype(np.float32)


def bricks(rng: Generator) -> Float32Array:
    """A running bond."""
    columns = int(rng.integers(4, 9))
    value = _courses(rng, 2 * round(columns * rng.uniform(0.9, 1.5)), columns, offset=0.5, joint=0.006)
    return _coloured(value * np.exp(0.18 * fractal_noise(rng, slope=0.7)), fractal_noise(rng, slope=1.0), 0.08)


def paving(rng: Generator) -> Float32Array:
    """Slabs."""
    count = int(rng.integers(3, 9))
    value = _courses(rng, count, count, offset=float(rng.choice([0.0, 0.5])), joint=0.005)
    return _coloured(value * np.exp(0.18 * fractal_noise(rng, slope=0.8)), fractal_noise(rng, slope=1.5), 0.05)


def planks(rng: Generator) -> Float32Array:
    """Boards along the columns, with grain."""
    value = _courses(rng, 2, int(rng.integers(6, 16)), offset=0.0, joint=0.004)
    grain = fractal_noise(rng, slope=0.9, stretch=0.3)
    return _coloured(value * np.exp(0.14 * grain), fractal_noise(rng, slope=1.2, stretch=0.5), 0.1)


def plaster(rng: Generator) -> Float32Array:
    """Rendered wall or concrete, weathered."""
    value = np.exp(0.07 * fractal_noise(rng, slope=0.5) + 0.11 * fractal_noise(rng, slope=1.6, stretch=0.6))
    return _coloured(value, fractal_noise(rng, slope=1.5), 0.04)


def roof_tiles(rng: Generator) -> Float32Array:
    """Overlapping rows, each tile lit from its lower edge."""
    rows, columns = int(rng.integers(6, 13)), int(rng.integers(6, 13))
    value = _courses(rng, rows, columns, offset=0.5, joint=0.004)
    r, _ = _grid()
    return _coloured(value * (0.65 + 0.5 * ((r * rows) % 1.0)) * np.exp(0.1 * fractal_noise(rng, slope=0.8)))


def corrugated(rng: Generator) -> Float32Array:
    """Ribbed sheet with streaks."""
    _, c = _grid()
    ribs = 0.8 + 0.25 * np.sin(2 * np.pi * c * int(rng.integers(8, 24)))
    value = ribs * np.exp(0.12 * fractal_noise(rng, slope=1.2, stretch=0.4))
    return _coloured(value, np.maximum(0.0, fractal_noise(rng, slope=1.3, stretch=0.5)), 0.12)


def leaves(rng: Generator) -> Float32Array:
    """Foliage with deep gaps."""
    edge, shade = _cells(rng, 18, 44, 0.3)
    value = shade * np.minimum(1.0, 0.25 + 2.5 * edge) * np.exp(0.35 * fractal_noise(rng, slope=1.0))
    return _coloured(value, fractal_noise(rng, slope=0.9), 0.15)


def bark(rng: Generator) -> Float32Array:
    """Vertical ridges."""
    return _coloured(np.exp(0.35 * fractal_noise(rng, slope=0.8, stretch=0.35)), fractal_noise(rng, slope=1.5), 0.06)


def speckle(rng: Generator) -> Float32Array:
    """A machine's surface: nearly even, scuffed, with a few panel lines and labels."""
    value = np.exp(0.1 * fractal_noise(rng, slope=1.0) + 0.04 * fractal_noise(rng, slope=0.2)).astype(np.float32)
    r, c = _grid()
    for _ in range(14):
        y, x = rng.random(2)
        high, wide = rng.uniform(0.01, 0.09, 2)
        inside = (np.abs((r - y + 0.5) % 1.0 - 0.5) < high) & (np.abs((c - x + 0.5) % 1.0 - 0.5) < wide)
        value = np.where(inside, value * np.float32(rng.choice([0.5, 0.75, 1.3, 1.6])), value)
    for count in rng.integers(2, 5, 2):
        axis = r if rng.random() < 0.5 else c
        value = np.where(np.abs((axis * count) % 1.0 - 0.5) < 0.012, value * np.float32(0.6), value)
    return _coloured(value)


def facade(rng: Generator, wall: Float32Array, colour: FloatArray) -> Float32Array:
    """Two by two window bays in a coloured wall; a tile is two bays wide and two floors high, rows run downwards."""
    bay = SIZE // 2
    image = wall * colour.astype(np.float32)
    frame_colour = rng.uniform(0.05, 0.75) * np.ones(3) * rng.uniform(0.8, 1.0, 3)
    glass = np.array([0.05, 0.07, 0.09]) * rng.uniform(0.5, 3.0)
    wide, high = rng.uniform(0.25, 0.85), rng.uniform(0.3, 0.75)
    panes_x, panes_y = int(rng.integers(1, 4)), int(rng.integers(1, 3))
    sill = bool(rng.random() < 0.6)
    y0, y1 = int(bay * (0.5 - high / 2)), int(bay * (0.5 + high / 2))
    x0, x1 = int(bay * (0.5 - wide / 2)), int(bay * (0.5 + wide / 2))
    edge = max(2, int(bay * rng.uniform(0.012, 0.03)))
    for top, left in itertools.product((0, bay), repeat=2):
        window = image[top + y0 : top + y1, left + x0 : left + x1]
        h, w = window.shape[:2]
        reflection = np.linspace(1.6, 0.7, h, dtype=np.float32)[:, None, None]
        window[:] = np.clip(glass * rng.uniform(0.6, 1.7) * reflection, 0.0, 1.0)
        if rng.random() < 0.4:  # a blind or curtain
            window[: int(h * rng.uniform(0.2, 1.0))] = rng.uniform(0.2, 0.6) * rng.uniform(0.8, 1.0, 3)
        for k in range(panes_x + 1):
            window[:, k * (w - edge) // panes_x :][:, :edge] = frame_colour
        for k in range(panes_y + 1):
            window[k * (h - edge) // panes_y :][:edge] = frame_colour
        if sill:
            image[top + y1 : top + y1 + 2 * edge, left + x0 - edge : left + x1 + edge] = frame_colour * 0.7
    if rng.random() < 0.5:  # a band between floors
        image[bay - 2 * edge : bay] *= rng.uniform(0.5, 1.5)
        image[-2 * edge :] *= rng.uniform(0.5, 1.5)
    return np.clip(image, 0.01, 1.0).astype(np.float32)


GROUNDS: Sequence[Callable[[Generator], Float32Array]] = (grass, soil, gravel, asphalt, paving, bricks, stone_cells)
WALLS: Sequence[Callable[[Generator], Float32Array]] = (bricks, plaster, planks, corrugated, stone_cells)
ROOFS: Sequence[Callable[[Generator], Float32Array]] = (roof_tiles, corrugated, plaster, planks)
