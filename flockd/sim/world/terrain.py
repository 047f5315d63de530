"""The ground's shape: gentle waves on a grid of triangles, flat beyond it to the horizon."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from flockd.core.messages import FloatArray, IntArray

CELL_M = 2.0
HORIZON_M = 1500.0


def relief(rng: Generator, extent: float, deviation_m: float) -> FloatArray:
    """Heights (cells + 1, cells + 1), up positive, rows north: waves of 8-40 m, mean 0, zero along the border."""
    cells = max(2, round(2 * extent / CELL_M))
    axis = np.linspace(-extent, extent, cells + 1)
    heights, _ = _waves(rng, axis, 24, (8.0, 40.0))
    border = np.clip((extent - np.abs(axis)) / 12.0, 0.0, 1.0)
    fade = border[:, None] * border[None, :]
    heights -= (heights * fade).sum() / fade.sum()
    heights *= fade
    return np.asarray(heights * (deviation_m / heights.std()))


def _waves(rng: Generator, axis: FloatArray, count: int, lengths_m: tuple[float, float]) -> tuple[FloatArray, float]:
    """The sum of so many waves on the grid of an axis, as high as they are long, and its height at the origin."""
    heights, at_origin = np.zeros((len(axis), len(axis))), 0.0
    for _ in range(count):
        wavelength = math.exp(rng.uniform(math.log(lengths_m[0]), math.log(lengths_m[1])))
        heading, phase = rng.uniform(0.0, 2.0 * math.pi, 2)
        k = 2.0 * math.pi / wavelength
        heights += wavelength * np.cos(k * (math.cos(heading) * axis[:, None] + math.sin(heading) * axis) + phase)
        at_origin += wavelength * math.cos(phase)
    return heights, at_origin


def grid_height(heights: FloatArray, extent: float, north: FloatArray, east: FloatArray) -> FloatArray:
    """Heights (n,) m at points (n,) m north and east, on the two triangles of each cell; 0 beyond the grid."""
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


def ground_mesh(heights: FloatArray, extent: float) -> tuple[FloatArray, IntArray]:
    """The grid, and a flat skirt from its border to the horizon."""
    cells = heights.shape[0] - 1
    axis = np.linspace(-extent, extent, cells + 1)
    north, east = np.meshgrid(axis, axis, indexing="ij")
    grid = np.stack([north, east, -heights], axis=-1).reshape(-1, 3)
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    inner = np.vstack([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
    ring = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    outer = grid[ring] * (HORIZON_M / extent) * np.array([1.0, 1.0, 0.0])
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


WAVELENGTHS_M = (80.0, 140.0)
WAVES = 6
LEVEL_M, FULL_M = 6.0, 30.0
"""The ground is level as near as this to the origin, and has its full relief beyond that."""
BORDER_M = 40.0
"""Over which the hills fade to level ground at the border."""
DRAWS = 60
"""How many are drawn, of which the highest hills are taken: about one in ten is as steep everywhere as it may be."""


def hills(rng: Generator, extent: float, hills_m: float, slope: float) -> FloatArray:
    """Heights (cells + 1, cells + 1) as `terrain.relief` has them, up positive, rows north; 0 at the origin.

    ``hills_m`` lie between the lowest and the highest point, or less where the ground would rise by more than ``slope``
    for each metre somewhere on the triangles that `ground_mesh` makes of it.
    """
    axis = np.linspace(-extent, extent, max(2, round(2 * extent / CELL_M)) + 1)
    border = _smooth((extent - np.abs(axis)) / BORDER_M)
    inner = _smooth((np.hypot(axis[:, None], axis) - LEVEL_M) / (FULL_M - LEVEL_M))
    drawn = []
    for _ in range(DRAWS):
        heights, at_origin = _waves(rng, axis, WAVES, WAVELENGTHS_M)
        heights = (heights - at_origin) * border[:, None] * border * inner
        north, east = (np.diff(heights, axis=k) / float(axis[1] - axis[0]) for k in (0, 1))
        steepest = max(np.hypot(north[:, :-1], east[1:]).max(), np.hypot(north[:, 1:], east[:-1]).max())
        drawn.append(heights * min(hills_m / float(np.ptp(heights)), slope / float(steepest)))
    return max(drawn, key=lambda heights: float(np.ptp(heights)))


def _smooth(share: FloatArray) -> FloatArray:
    """0 below 0, 1 above 1, and between them a rise that begins and ends level."""
    share = np.clip(share, 0.0, 1.0)
    return np.asarray(share**2 * (3.0 - 2.0 * share))
