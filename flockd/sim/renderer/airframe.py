"""Airframes as meshes: the parts that families of drones are put together from, and the mesh that comes out."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.core.messages import Float32Array, FloatArray
from flockd.sim.world import textures
from flockd.sim.world.mesh import Mesh
from flockd.sim.world.textures import PackedArray


@dataclass(frozen=True, eq=False)
class Solid:
    """The mesh of what flies, body FRD, metres."""

    vertices: Float32Array
    """(n, 3)"""
    triangles: NDArray[np.int32]
    """(m, 3)"""
    colours: Float32Array
    """(m, 3) linear albedo."""
    texture: NDArray[np.int32]
    """(m,) number of the machine texture."""
    uv: FloatArray
    """(m, 2, 4) texture coordinates in tiles from body (x, y, z, 1)."""
    size_m: float
    """Widest horizontal distance, of a drone from propeller tip to tip."""


@dataclass(frozen=True, eq=False)
class DroneModel(Solid):
    """One drone's, its origin at the centre of its bounding box."""

    family: int
    seed: int
    hubs: FloatArray
    """(n, 3) tops of the motors; of the families: front right, rear right, rear left, front left (plus frame: front,
    right, rear, left)."""
    extent: FloatArray
    """(2, 3) least and greatest corner, propellers at any angle; a family's own."""


MACHINE_TEXTURES = 3
BLACK = np.full(3, 0.02)
Point = tuple[float, float, float]
"""Metres, x, y and z of the builder's axes."""


@functools.cache
def machine_texels() -> PackedArray:
    """The packed pyramids of the machine textures, one after another; the same for all worlds."""
    rng = np.random.default_rng(7)
    return np.concatenate([textures.pack_pyramid(textures.speckle(rng)) for _ in range(MACHINE_TEXTURES)])


class Airframe:
    """A drone as it is put together, nose along +x, z down, in its builder's own origin."""

    def __init__(self, rng: Generator) -> None:
        self.rng = rng
        self.mesh = Mesh()
        self.hubs: list[FloatArray] = []
        self.radii: list[float] = []
        base = float(rng.choice([rng.uniform(0.02, 0.06), rng.uniform(0.12, 0.3), rng.uniform(0.5, 0.75)]))
        self.body = np.clip(base * rng.uniform(0.85, 1.15, 3), 0.01, 0.8)
        if rng.random() < 0.3:
            self.body = _vivid(rng) * 0.8
        self.frame = np.full(3, rng.uniform(0.015, 0.07)) if rng.random() < 0.7 else np.full(3, rng.uniform(0.3, 0.7))
        self.front, self.rear = _vivid(rng), _vivid(rng)
        self.metal = np.full(3, rng.uniform(0.05, 0.5))
        # Slow or fast: two blades, or the disc they blur into.
        self.disc = bool(rng.random() < 0.5)
        self.prop = np.full(3, rng.uniform(0.03, 0.5)) if rng.random() < 0.7 else _vivid(rng) * 0.7
        self.skin = rng.integers(0, MACHINE_TEXTURES, 2)

    def corners(self, x: float, y: float) -> list[tuple[float, float, FloatArray]]:
        """Front right, rear right, rear left, front left, each with the colour of its end."""
        return [(x, y, self.front), (-x, y, self.rear), (-x, -y, self.rear), (x, -y, self.front)]

    def box(self, centre: Point, half: Point, colour: FloatArray, heading: float = 0.0) -> None:
        """A level box of these half sizes, turned by ``heading`` in rad."""
        self.mesh.box(np.array(centre), half, heading, int(self.skin[0]), colour, (0.3, 0.3))

    def rod(self, a: Point, b: Point, radius: float, colours: list[FloatArray], sides: int = 6) -> None:
        """A tube in equal lengths of the given colours."""
        radii, tints = (radius, radius), np.array(colours)
        self.mesh.frustum(np.array(a), np.array(b), radii, sides, int(self.skin[1]), tints, (0.2, 0.2))

    def beam(self, a: Point, b: Point, half: tuple[float, float], colours: list[FloatArray]) -> None:
        """A level box beam in equal lengths of the given colours; half width and half height."""
        start, end = np.array(a), np.array(b)
        step = (end - start) / len(colours)
        heading, length = math.atan2(step[1], step[0]), float(np.hypot(step[0], step[1]))
        for k, colour in enumerate(colours):
            x, y, z = start + step * (k + 0.5)
            self.box((x, y, z), (length / 2, *half), colour, heading)

    def loft(self, rings: list[FloatArray], colours: list[FloatArray]) -> None:
        """A closed skin over rings (n, 3), the first on top, each clockwise seen from above; see ``Mesh.loft``."""
        self.mesh.loft(rings, int(self.skin[0]), np.array(colours), (0.3, 0.3))

    def ball(self, centre: Point, radius: float, colour: FloatArray) -> None:
        """A sphere of four bands, open at both poles."""
        slope = np.radians([-70, -35, 0, 35, 70])
        rings = [oval(r, r, z) + centre for r, z in zip(radius * np.cos(slope), radius * np.sin(slope), strict=True)]
        self.loft(rings, [colour] * (len(rings) - 1))

    def ring(
        self, at: Point, radii: tuple[float, float], half_height: float, first: FloatArray, second: FloatArray
    ) -> None:
        """A short upright tube with a wall, every third segment in the first colour; inner and outer radius."""
        sides, (inner, outer) = 12, radii
        angle = np.arange(sides) * 2 * math.pi / sides
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        profile = ((outer, half_height), (outer, -half_height), (inner, -half_height), (inner, half_height))
        vertices = np.vstack([np.column_stack([ring * r + at[:2], np.full(sides, at[2] + up)]) for r, up in profile])
        faces = [
            (a + k, *corners)
            for k in range(sides)
            for a, b in ((0, 12), (12, 24), (24, 36), (36, 0))
            for corners in ((b + (k + 1) % sides, a + (k + 1) % sides), (b + k, b + (k + 1) % sides))
        ]
        tint = np.repeat([first if k % 3 == 0 else second for k in range(sides)], 8, axis=0)
        self.mesh.add(vertices, np.array(faces), int(self.skin[0]), tint, (0.3, 0.3))

    def rotor(self, x: float, y: float, z: float, radius: float, motor: tuple[float, float], *, accent: bool) -> None:
        """A motor standing on (x, y, z), with its propeller. ``motor``: radius and height."""
        top = z - motor[1]
        end = (self.front if x > 0 else self.rear) if accent else self.metal
        self.rod((x, y, z), (x, y, top), motor[0], [self.metal, end], 8)
        hub = np.array([x, y, top])
        self.hubs.append(hub)
        self.radii.append(radius)
        angle, skin = self.rng.uniform(0, math.pi), int(self.skin[1])
        foot = hub - np.array([0, 0, 0.004 + 0.01 * radius])
        if self.disc:
            self.mesh.frustum(foot, foot - [0, 0, 0.004], (radius, radius), 16, skin, self.prop, (0.25, 0.25))
        else:
            width = 0.075 * radius + 0.004
            half = math.sqrt(radius**2 - width**2), width, 0.002
            self.mesh.box(foot, half, angle, skin, self.prop, (0.25, 0.25))

    def model(self, family: int, seed: int) -> DroneModel:
        """The mesh, moved to the centre of its bounding box."""
        vertices = np.vstack(self.mesh.vertices)
        hubs = np.array(self.hubs)
        reach = np.array(self.radii)[:, None] * np.array([1.0, 1.0, 0.0])
        low = np.minimum(vertices.min(0), (hubs - reach).min(0))
        high = np.maximum(vertices.max(0), (hubs + reach).max(0))
        # The rotor disc's own thickness is there whichever way the propeller is drawn.
        low[2] = min(low[2], float((hubs[:, 2] - 0.008 - 0.01 * np.array(self.radii)).min()))
        centre = (low + high) / 2
        apart = np.linalg.norm(hubs[:, None, :2] - hubs[None, :, :2], axis=-1)
        uv = np.concatenate(self.mesh.uv)
        uv[:, :, 3] += uv[:, :, :3] @ centre + self.rng.uniform(0, 1, 2)
        return DroneModel(
            family=family,
            seed=seed,
            vertices=(vertices - centre).astype(np.float32),
            triangles=np.vstack(self.mesh.triangles).astype(np.int32),
            colours=np.concatenate(self.mesh.tint).astype(np.float32),
            texture=np.concatenate(self.mesh.texture).astype(np.int32),
            uv=uv,
            hubs=hubs - centre,
            extent=np.stack([low, high]) - centre,
            size_m=float((apart + np.add.outer(self.radii, self.radii)).max()),
        )


def _vivid(rng: Generator) -> FloatArray:
    """A strong colour of any hue."""
    hue = rng.uniform(0, 2 * math.pi)
    rgb = 0.5 + 0.5 * np.cos(hue + np.array([0.0, -2.1, 2.1]))
    return np.asarray(np.clip(rgb * rng.uniform(0.3, 0.8) + rng.uniform(0.0, 0.1), 0.02, 0.85))


def oval(along: float, across: float, z: float) -> FloatArray:
    """Ring of 12 points on an ellipse of these half widths."""
    angle = np.arange(12) * math.pi / 6
    return np.column_stack([along * np.cos(angle), across * np.sin(angle), np.full(12, z)])


def outline(right: list[tuple[float, float]], z: float, scale: float = 1.0) -> FloatArray:
    """Ring through the points of the right half, nose to tail, and their mirror images."""
    points = np.array(right + [(x, -y) for x, y in reversed(right)])
    return np.column_stack([points * scale, np.full(len(points), z)])
