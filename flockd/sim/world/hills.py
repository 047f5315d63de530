"""Hills: a smooth ground of limited slope, level around the origin, where drones begin, and along its border."""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from flockd.core.messages import FloatArray
from flockd.sim.world.terrain import CELL_M

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
    for each metre somewhere.
    """
    cells = max(2, round(2 * extent / CELL_M))
    axis = np.linspace(-extent, extent, cells + 1)
    drawn = [_drawn(rng, axis, extent) for _ in range(DRAWS)]
    scaled = [_scaled(heights, hills_m, slope, float(axis[1] - axis[0])) for heights in drawn]
    return max(scaled, key=_relief_m)


def steepest(heights: FloatArray, cell_m: float) -> float:
    """The largest slope of the triangles that `terrain.ground_mesh` makes of heights."""
    north, east = np.diff(heights, axis=0) / cell_m, np.diff(heights, axis=1) / cell_m
    halves = (np.hypot(north[:, :-1], east[1:]), np.hypot(north[:, 1:], east[:-1]))
    return float(max(half.max() for half in halves))


def _drawn(rng: Generator, axis: FloatArray, extent: float) -> FloatArray:
    north, east = axis[:, None], axis[None, :]
    heights = np.zeros((len(axis), len(axis)))
    at_origin = 0.0
    for _ in range(WAVES):
        wavelength = math.exp(rng.uniform(*np.log(WAVELENGTHS_M)))
        heading, phase = rng.uniform(0.0, 2.0 * math.pi, 2)
        k = 2.0 * math.pi / wavelength
        heights += wavelength * np.cos(k * (math.cos(heading) * north + math.sin(heading) * east) + phase)
        at_origin += wavelength * math.cos(phase)
    border = _smooth((extent - np.abs(axis)) / BORDER_M)
    inner = _smooth((np.hypot(north, east) - LEVEL_M) / (FULL_M - LEVEL_M))
    return np.asarray((heights - at_origin) * border[:, None] * border[None, :] * inner)


def _smooth(share: FloatArray) -> FloatArray:
    """0 below 0, 1 above 1, and between them a rise that begins and ends level."""
    share = np.clip(share, 0.0, 1.0)
    return np.asarray(share**2 * (3.0 - 2.0 * share))


def _scaled(heights: FloatArray, hills_m: float, slope: float, cell_m: float) -> FloatArray:
    return heights * min(hills_m / _relief_m(heights), slope / steepest(heights, cell_m))


def _relief_m(heights: FloatArray) -> float:
    return float(heights.max() - heights.min())
