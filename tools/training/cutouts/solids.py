"""Smooth solids as triangles: hulls along a path, star-shaped shells, balls; each triangle with colour and finish.

Axes are a body's FRD, metres. Pure numpy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
_SIDES, _CAP = 20, 5


@dataclass(frozen=True)
class Finish:
    """How a surface throws light back."""

    colour: tuple[float, float, float]
    """Linear albedo."""
    roughness: float = 0.4
    metallic: float = 0.0
    glow: float = 0.0
    """Radiance of a lamp, in units of what a white surface shows in full light."""


class Solids:
    """Triangles as they are collected."""

    def __init__(self) -> None:
        self._vertices: list[Array] = []
        self._triangles: list[Array] = []
        self._finish: list[Array] = []
        self._count = 0

    def add(self, vertices: Array, triangles: Array, finish: Finish) -> slice:
        """Corners (n, 3) and triangles (m, 3); where these triangles are among all."""
        before = sum(len(some) for some in self._triangles)
        row = (*finish.colour, finish.roughness, finish.metallic, finish.glow)
        self._vertices.append(vertices)
        self._triangles.append(triangles + self._count)
        self._finish.append(np.tile(row, (len(triangles), 1)))
        self._count += len(vertices)
        return slice(before, before + len(triangles))

    def mesh(self) -> tuple[Array, Array, Array]:
        """Corners (n, 3), triangles (m, 3), and (m, 6) red, green, blue, roughness, metallic, glow."""
        return np.vstack(self._vertices), np.vstack(self._triangles), np.vstack(self._finish)

    def hull(
        self, stations: Sequence[Sequence[float]], finish: Finish, *, corner: float = 2.6, cap: float = 0.5
    ) -> None:
        """A body along x through stations (x, y, z, half width, half height), rounded at both ends.

        ``corner``: exponent of the section's superellipse, 2 round, 5 nearly a box. ``cap``: length of the round ends
        as a share of the end's half height.
        """
        x = np.asarray(stations, float)
        fine = _smooth(x, 4)
        self._tube(fine[:, :3], fine[:, 3:5], finish, corner, cap, across=np.array([0.0, 1.0, 0.0]))

    def bar(
        self,
        path: Sequence[Sequence[float]],
        half: Sequence[tuple[float, float]],
        finish: Finish,
        *,
        corner: float = 2.5,
        cap: float = 0.6,
        is_curve: bool = True,
    ) -> None:
        """A bar along points (n, 3); ``half``: its half width (level) and half height at each point."""
        both = np.hstack([np.asarray(path, float), np.asarray(half, float)])
        fine = _smooth(both, 5) if is_curve else both
        self._tube(fine[:, :3], fine[:, 3:5], finish, corner, cap)

    def drum(self, foot: Sequence[float], radius: float, height: float, finish: Finish) -> None:
        """An upright cylinder with a rounded edge; it stands on ``foot`` and is ``height`` high."""
        x, y, z = foot
        self.bar([(x, y, z), (x, y, z - height)], [(radius, radius)] * 2, finish, corner=2.0, cap=0.12, is_curve=False)

    def ball(self, centre: Sequence[float], half: Sequence[float], finish: Finish, *, corner: float = 2.0) -> None:
        """A superellipsoid of these half sizes."""
        u, v = np.linspace(-math.pi / 2, math.pi / 2, 13), np.linspace(0, 2 * math.pi, _SIDES, endpoint=False)
        share = 2.0 / corner
        ring = np.stack([_power(np.cos(v), share), _power(np.sin(v), share)], axis=1)
        points = [
            np.column_stack([ring * _power(np.cos(a), share), np.full(_SIDES, _power(np.sin(a), share))]) for a in u
        ]
        corners = np.vstack(points) * np.asarray(half) + np.asarray(centre)
        self.add(corners, _grid(len(u), _SIDES), finish)

    def star(
        self, outline: Array, top: Array, bottom: Array, angles: Array, finish: Finish, centre: Sequence[float]
    ) -> tuple[slice, Array]:
        """A shell over a star-shaped plan.

        ``outline`` (n,): radius at ``angles``; ``top``, ``bottom`` (k, n): heights above and below ``centre`` at k
        shares of that radius, 1 last. Gives its triangles and (m, 2) each one's angle and radius.
        """
        k = len(top)
        shares = np.sin(np.linspace(0, math.pi / 2, k))[:, None]
        x, y = shares * outline * np.cos(angles), shares * outline * np.sin(angles)
        upper = np.stack([x, y, -top], axis=2)
        lower = np.stack([x, y, bottom], axis=2)[::-1]
        corners = np.concatenate([upper, lower]).reshape(-1, 3)
        triangles = _grid(2 * k, len(angles))
        middle = corners[triangles].mean(axis=1)
        where = self.add(corners + np.asarray(centre), triangles, finish)
        return where, np.stack([np.arctan2(middle[:, 1], middle[:, 0]), np.hypot(middle[:, 0], middle[:, 1])], axis=1)

    def paint(self, where: slice, chosen: Array, finish: Finish) -> None:
        """Paint ``chosen`` ones, a mask, of the triangles that `star` added last."""
        row = (*finish.colour, finish.roughness, finish.metallic, finish.glow)
        rows = self._finish[-1].copy()
        if where.stop - where.start != len(rows):
            raise ValueError("only what was added last can be painted")
        rows[chosen] = row
        self._finish[-1] = rows

    def _tube(
        self, path: Array, half: Array, finish: Finish, corner: float, cap: float, across: Array | None = None
    ) -> None:
        """Rings of a superellipse along a path, closed by round caps."""
        along = np.gradient(path, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        steep = np.abs(along[:, 2]) > 0.95
        level = np.cross(np.where(steep.all(), [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]), along)
        if across is not None:
            level = np.tile(across, (len(path), 1))
        level /= np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
        up = np.cross(along, level)
        turns = np.linspace(0, 2 * math.pi, _SIDES, endpoint=False)
        share = 2.0 / corner
        section = np.stack([_power(np.cos(turns), share), _power(np.sin(turns), share)], axis=1)
        bends = np.linspace(0, math.pi / 2, _CAP)
        rings = []
        places = [(0, -np.sin(b), np.cos(b)) for b in bends[::-1]]
        places += [(k, 0.0, 1.0) for k in range(1, len(path) - 1)]
        places += [(len(path) - 1, np.sin(b), np.cos(b)) for b in bends]
        for k, out, shrink in places:
            middle = path[k] + cap * out * half[k].min() * along[k]
            flat = section * half[k] * max(float(shrink), 1e-3)
            rings.append(middle + flat[:, :1] * level[k] + flat[:, 1:] * up[k])
        self.add(np.vstack(rings), _grid(len(rings), _SIDES), finish)


def _grid(rings: int, around: int) -> Array:
    """Triangles between rings that follow each other."""
    k, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    a, b = k * around + j, k * around + (j + 1) % around
    quads = np.stack([a, b, b + around, a + around], axis=2).reshape(-1, 4)
    return np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _smooth(points: Array, steps: int) -> Array:
    """Catmull and Rom's spline through rows, ``steps`` a span; two rows: the straight line."""
    p = np.vstack([2 * points[0] - points[1], points, 2 * points[-1] - points[-2]])
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    spans = []
    for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True):
        spans.append(0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3))
    return np.vstack([*spans, points[-1:]])


def _power(value: Any, share: float) -> Any:
    """The power that keeps its sign."""
    return np.sign(value) * np.abs(value) ** share
