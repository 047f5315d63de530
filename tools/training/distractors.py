"""Random meshes of birds, balloons, kites, bags and masts: distractors that are no drones."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.core.messages import FloatArray
from flockd.sim.renderer.airframe import Solid
from flockd.sim.world.mesh import Mesh

_SKIN = 0
"""The machine texture of all of them: fine grain."""
_DOWN = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Distractor(Solid):
    """A mesh with its origin in the body; `size_m` is the longest side, of a mast without the pole."""

    wing: NDArray[np.int8]
    """(n,) 1 for vertices of a right wing, -1 of a left one, else 0."""
    shoulder_m: float
    """Half the distance between the wings' hinges."""

    def flapped(self, angle: float) -> Distractor:
        """The same with its wings raised by an angle, rad; without wings the same."""
        sideways, down = self.wing * self.vertices[:, 1] - self.shoulder_m, self.vertices[:, 2]
        outward = self.shoulder_m + sideways * math.cos(angle) + down * math.sin(angle)
        turned = np.column_stack(
            [self.vertices[:, 0], self.wing * outward, down * math.cos(angle) - sideways * math.sin(angle)]
        )
        vertices = np.where(self.wing[:, None] == 0, self.vertices, turned).astype(np.float32)
        return dataclasses.replace(self, vertices=vertices)


def bird(rng: Generator) -> Distractor:
    """Two wings, a body and a tail, 0.2 to 1.2 m from tip to tip; black, brown, grey or white."""
    span = math.exp(rng.uniform(math.log(0.2), math.log(1.2)))
    thick, length = span * rng.uniform(0.035, 0.06), span * rng.uniform(0.4, 0.65)
    base = np.array([(0.02, 0.02, 0.022), (0.09, 0.06, 0.035), (0.25, 0.25, 0.27), (0.7, 0.7, 0.68)][rng.integers(4)])
    base = base * rng.uniform(0.7, 1.2)
    tips, head, belly = (base * rng.uniform(0.15, 1.0), base * rng.uniform(0.3, 1.3), base * rng.uniform(0.7, 1.5))
    mesh = Mesh()
    along = (-0.5, -0.25, 0.0, 0.25, 0.35, 0.42, 0.47, 0.52)
    profile = zip(along, (0.3, 0.8, 1.0, 0.85, 0.55, 0.6, 0.4, 0.05), strict=True)
    mesh.loft(
        [_across(x * length, r * thick, r * thick) for x, r in profile],
        _SKIN,
        np.clip([base, base, belly, head, head, head, tips], 0.01, 0.85),
    )
    fan = span * rng.uniform(0.04, 0.12)
    tail = rng.uniform(0.6, 0.9) * length
    mesh.loft([_across(-tail, fan, 0.006 * span), _across(-0.4 * length, 0.3 * thick, 0.01 * span)], _SKIN, tips[None])
    body = mesh.count
    chord, sweep, droop = span * rng.uniform((0.09, -0.02, -0.06), (0.16, 0.16, 0.1))
    elbow = rng.uniform(0.35, 0.55)
    rings = []
    for share, width in ((0.0, 1.0), (elbow, 0.95), (0.8, 0.6), (1.0, 0.12)):
        y = 0.7 * thick + share * (span / 2 - 0.7 * thick)
        x = 0.1 * length + (0.3 * share if share <= elbow else 0.3 * elbow - (share - elbow)) * sweep
        z = droop * max(0.0, share - elbow)
        half, flat = chord * width / 2, 0.008 * span
        rings.append(np.array([(x, y, z + flat), (x + half, y, z), (x, y, z - flat), (x - half, y, z)]))
    colours = np.clip([base, base, tips], 0.01, 0.85)
    mesh.loft(rings, _SKIN, colours)
    wing = mesh.count - body
    mesh.loft([ring[::-1] * (1.0, -1.0, 1.0) for ring in rings], _SKIN, colours)
    return _finished(mesh, span, np.repeat([0, 1, -1], [body, wing, wing]), 0.7 * thick)


def balloon(rng: Generator) -> Distractor:
    """One to three balloons on a string."""
    mesh = Mesh()
    string = rng.uniform(0.3, 0.9)
    count = int(rng.choice([1, 1, 2, 3]))
    for _ in range(count):
        radius = rng.uniform(0.1, 0.18)
        centre = rng.normal(0, 0.12, 3) * (count > 1)
        mesh.blob(centre, radius * np.array([1.0, 1.0, rng.uniform(1.0, 1.3)]), 0.0, rng, _SKIN, _paint(rng), 0.4)
        foot = np.array([0.0, 0.0, 0.3])
        mesh.frustum(centre + radius * _DOWN, foot, (0.004, 0.003), 4, _SKIN, np.full(3, 0.4))
    mesh.frustum(
        np.array([0.0, 0.0, 0.3]), np.array([0.05, 0.0, 0.3 + string]), (0.003, 0.003), 4, _SKIN, np.full(3, 0.4)
    )
    return _finished(mesh, 0.35)


def kite(rng: Generator) -> Distractor:
    """A diamond of cloth on two spars, with a tail of ribbons."""
    size = rng.uniform(0.4, 1.0)
    high, low, wide = 0.35 * size, 0.65 * size, rng.uniform(0.3, 0.45) * size
    mesh = Mesh()
    cloth = np.array([(high, 0.0, 0.0), (0.0, wide, 0.0), (-low, 0.0, 0.0), (0.0, -wide, 0.0)])
    cloth[:, 2] = -0.12 * np.abs(cloth[:, 1])
    mesh.loft([cloth - 0.003 * _DOWN, cloth + 0.003 * _DOWN], _SKIN, _paint(rng)[None])
    wood = np.full(3, rng.uniform(0.05, 0.4))
    mesh.frustum(np.array([high, 0, 0.01]), np.array([-low, 0, 0.01]), (0.006, 0.006), 4, _SKIN, wood)
    mesh.frustum(np.array([0, -wide, 0.0]), np.array([0, wide, 0.0]), (0.006, 0.006), 4, _SKIN, wood)
    ribbon, at = _paint(rng), np.array([-low, 0.0, 0.0])
    for _ in range(int(rng.integers(3, 8))):
        after = at + size * np.array([-0.12, rng.normal(0, 0.05), rng.normal(0, 0.03)])
        mesh.frustum(at, after, (0.004, 0.004), 4, _SKIN, ribbon)
        mesh.box(after, (0.012, 0.05 * size, 0.002), float(rng.normal(0, 0.4)), _SKIN, ribbon)
        at = after
    return _finished(mesh, size)


def bag(rng: Generator) -> Distractor:
    """A plastic bag in the wind, its handles up."""
    size = rng.uniform(0.25, 0.5)
    colour = np.full(3, rng.uniform(0.4, 0.8)) if rng.random() < 0.6 else _paint(rng)
    mesh = Mesh()
    mesh.blob(np.zeros(3), size * rng.uniform(0.25, 0.5, 3), 0.3, rng, _SKIN, colour, 0.4)
    for y in (-0.2, 0.2):
        corners = size * np.array([(-0.1, y, -0.05), (-0.08, y, -0.5), (0.08, y, -0.5), (0.1, y, -0.05)])
        for a, b in itertools.pairwise(corners):
            mesh.frustum(a, b, (0.03 * size, 0.03 * size), 4, _SKIN, colour)
    return _finished(mesh, size)


def mast(rng: Generator, length_m: float) -> Distractor:
    """A lamp post: lamps on a cross of arms, origin there, and a pole of this length below."""
    arms = int(rng.integers(2, 5))
    reach, drop = rng.uniform(0.2, 0.45), rng.uniform(-0.1, 0.1)
    paint, glass = np.full(3, rng.uniform(0.03, 0.4)), np.full(3, rng.uniform(0.3, 0.8))
    mesh = Mesh()
    mesh.frustum(np.array([0, 0, length_m]), np.array([0, 0, -0.08]), (0.06, 0.035), 8, _SKIN, paint)
    for angle in np.arange(arms) * 2 * math.pi / arms:
        tip = np.array([reach * math.cos(angle), reach * math.sin(angle), drop])
        mesh.frustum(np.zeros(3), tip, (0.016, 0.013), 6, _SKIN, paint)
        mesh.box(tip, (0.11, 0.05, 0.02), float(angle), _SKIN, paint)
        mesh.box(tip + 0.025 * _DOWN, (0.09, 0.04, 0.008), float(angle), _SKIN, glass)
    return _finished(mesh, 2 * reach + 0.2)


def _finished(mesh: Mesh, size_m: float, wing: NDArray[np.int64] | None = None, shoulder_m: float = 0.0) -> Distractor:
    return Distractor(
        vertices=np.vstack(mesh.vertices).astype(np.float32),
        triangles=np.vstack(mesh.triangles).astype(np.int32),
        colours=np.concatenate(mesh.tint).astype(np.float32),
        texture=np.concatenate(mesh.texture).astype(np.int32),
        uv=np.concatenate(mesh.uv),
        wing=(np.zeros(mesh.count) if wing is None else wing).astype(np.int8),
        shoulder_m=shoulder_m,
        size_m=size_m,
    )


def _across(x: float, half_width: float, half_height: float) -> FloatArray:
    """Ring of 6 points about the nose's axis."""
    angle = np.arange(6) * math.pi / 3
    return np.column_stack([np.full(6, x), half_width * np.cos(angle), half_height * np.sin(angle)])


def _paint(rng: Generator) -> FloatArray:
    """A random colour."""
    return np.asarray(np.clip(rng.uniform(0.05, 0.8) * rng.uniform(0.1, 1.0, 3), 0.02, 0.8))
