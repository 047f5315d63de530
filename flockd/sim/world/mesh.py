"""Solids as triangles: boxes, cylinders, cones and lumps, with their materials.

Axes are right-handed with z down (NED, or a body's FRD). Outer faces wind counter-clockwise seen from outside.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.core.messages import FloatArray, IntArray

Tile = tuple[float, float]
"""Width and height of a texture, m."""


def unit(v: FloatArray) -> FloatArray:
    """Vectors (..., 3), scaled to length 1."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def _icosphere() -> tuple[FloatArray, IntArray]:
    """A sphere of 80 triangles."""
    g = (1 + 5**0.5) / 2
    v = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g), (0, -1, -g), (0, 1, -g),
         (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]  # fmt: skip
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6),
             (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10),
             (8, 6, 7), (9, 8, 1)]  # fmt: skip
    points = [tuple(p) for p in unit(np.array(v, float))]
    index = {p: i for i, p in enumerate(points)}

    def middle(a: int, b: int) -> int:
        p = tuple(unit(np.array(points[min(a, b)]) + np.array(points[max(a, b)])))
        if p not in index:
            index[p] = len(points)
            points.append(p)
        return index[p]

    split = []
    for a, b, c in faces:
        ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
        split += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return np.array(points), np.array(split)


_SPHERE = _icosphere()


def face_normals(vertices: FloatArray, triangles: IntArray | NDArray[np.int32]) -> FloatArray:
    """Outward unit normals (m, 3); zero for a triangle without area."""
    corner = vertices[triangles]
    normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    return np.asarray(normals / np.maximum(1e-15, np.linalg.norm(normals, axis=1, keepdims=True)))


class Mesh:
    """Collects triangles; vertices are numbered from ``first_vertex``."""

    def __init__(self, first_vertex: int = 0) -> None:
        self.vertices: list[FloatArray] = []
        self.triangles: list[IntArray] = []
        self.texture: list[IntArray] = []
        self.uv: list[FloatArray] = []
        self.tint: list[FloatArray] = []
        self.count = first_vertex

    def add(
        self, vertices: FloatArray, triangles: IntArray, texture: int, tint: FloatArray, tile: Tile,
        origin: FloatArray | None = None,
    ) -> None:  # fmt: skip
        """Triangles of one texture, ``tile`` metres wide and high; columns level, rows downhill from ``origin``."""
        normal = face_normals(vertices, triangles)
        level = np.abs(normal[:, 2]) > 0.98
        across = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)
        across[level] = (0.0, 1.0, 0.0)
        across = unit(across)
        downhill = np.cross(normal, across)
        downhill *= np.where(downhill[:, 2:] < 0, -1.0, 1.0)
        base = vertices[0] if origin is None else origin
        uv = np.empty((len(triangles), 2, 4))
        uv[:, 0, :3] = across / tile[0]
        uv[:, 1, :3] = downhill / tile[1]
        uv[:, :, 3] = -uv[:, :, :3] @ base
        self.vertices.append(vertices)
        self.triangles.append(triangles + self.count)
        self.count += len(vertices)
        self.texture.append(np.full(len(triangles), texture))
        self.uv.append(uv)
        self.tint.append(np.broadcast_to(tint, (len(triangles), 3)))

    def box(
        self, centre: FloatArray, half: tuple[float, float, float], heading: float, texture: int, tint: FloatArray,
        tile: Tile = (2.0, 2.0),
    ) -> None:  # fmt: skip
        """A closed box; ``half`` along the heading, across it, and vertically."""
        signs = np.array([(x, y, z) for z in (1, -1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))], float)
        self.add(turn(signs * half, heading) + centre, _BOX, texture, tint, tile)

    def frustum(
        self, base: FloatArray, tip: FloatArray, radius: tuple[float, float], sides: int, texture: int,
        tint: FloatArray, tile: Tile = (1.0, 2.0),
    ) -> None:  # fmt: skip
        """A closed cylinder or cone (tip radius 0) between two points; ``tint`` (3,), or (n, 3) in n equal bands."""
        axis = unit(tip - base)
        side = unit(np.cross(axis, np.array([0.3, 0.9, 0.1])))
        angle = np.arange(sides) * 2 * math.pi / sides
        ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(axis, side)
        bands = np.atleast_2d(tint)
        share = np.linspace(0.0, 1.0, len(bands) + 1)[:, None, None]
        rings = base + share * (tip - base) + (radius[0] + share * (radius[1] - radius[0])) * ring
        self.loft(list(rings), texture, bands, tile, ends=np.stack([base, tip]))

    def loft(
        self, rings: list[FloatArray], texture: int, tint: FloatArray, tile: Tile = (1.0, 1.0), *,
        ends: FloatArray | None = None,
    ) -> None:  # fmt: skip
        """A closed skin over rings (n, 3) of equally many points, right-handed about the way from first to last.

        ``tint`` (len(rings) - 1, 3): of the bands between the rings. ``ends`` (2, 3): middles of the first and the last
        ring, where these are not the means of their points.
        """
        sides = len(rings[0])
        k = np.arange(sides)
        following = (k + 1) % sides
        faces = []
        for low in range(0, (len(rings) - 1) * sides, sides):
            faces.append(np.stack([k, following, k + sides], 1) + low)
            faces.append(np.stack([following, following + sides, k + sides], 1) + low)
        last, middle = (len(rings) - 1) * sides, len(rings) * sides
        faces.append(np.stack([following, k, np.full(sides, middle)], 1))
        faces.append(np.stack([k + last, following + last, np.full(sides, middle + 1)], 1))
        colours = np.vstack([np.repeat(tint, 2 * sides, axis=0), np.repeat(tint[[0, -1]], sides, axis=0)])
        middles = np.stack([rings[0].mean(0), rings[-1].mean(0)]) if ends is None else ends
        vertices, triangles = np.vstack([*rings, middles]), np.vstack(faces)
        if not np.ptp(rings[-1], axis=0).any():  # a point has no cap
            keep = np.linalg.norm(face_normals(vertices, triangles), axis=1) > 0.5
            triangles, colours = triangles[keep], colours[keep]
        self.add(vertices, triangles, texture, colours, tile)

    def blob(
        self, centre: FloatArray, radii: FloatArray, rough: float, rng: Generator, texture: int, tint: FloatArray,
        tile: float, *, half_height: float = 0.0,
    ) -> None:  # fmt: skip
        """A lumpy ellipsoid, its halves drawn apart upright; each facet a slightly different shade."""
        sphere, faces = _SPHERE
        lumpy = sphere * (1.0 + rough * rng.uniform(-1, 1, (len(sphere), 1)))
        shades = tint * rng.uniform(0.85, 1.15, (len(faces), 1))
        skin = turn(lumpy, rng.uniform(0, 6.28)) * radii
        skin[:, 2] += half_height * np.sign(np.where(np.abs(skin[:, 2]) < 1e-9, 0.0, skin[:, 2]))
        self.add(skin + centre, faces, texture, shades, (tile, tile))


# fmt: off
_BOX = np.array([
    (0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6), (0, 5, 1), (0, 4, 5),
    (1, 6, 2), (1, 5, 6), (2, 7, 3), (2, 6, 7), (3, 4, 0), (3, 7, 4),
])
# fmt: on


def turn(points: FloatArray, heading: float) -> FloatArray:
    """Points (n, 3) turned clockwise from north by ``heading``."""
    c, s = math.cos(heading), math.sin(heading)
    return np.asarray(points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]))
