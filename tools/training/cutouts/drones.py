"""The drones that cut-outs show: real airframes, consumer shells, generated multirotors; all in one form.

Read by Blender's Python, beside which trimesh, pycollada, pillow and numba are installed.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from tools.measure.cycles.airframes import Airframe, Rotor, airframe
from tools.measure.cycles.plan import painted
from tools.training.cutouts.shells import shell, vivid
from tools.training.cutouts.sources import HELD_OUT, SOURCES
from tools.training.drone_generator import DRAWN_SIZE_M, generated_drone

Array = NDArray[Any]
_SHAPES = 600
"""Generated shapes that there are cut-outs of."""
_LIGHT = np.array([0.2126, 0.7152, 0.0722])
_WHITE_FROM = 0.35
"""Mean albedo of a drone that counts as white."""


@dataclass(frozen=True, eq=False)
class Drone:
    """What is put into the scene, its propellers apart."""

    name: str
    kind: str
    """One of `plan.KINDS`."""
    airframe: Airframe
    finish: Array
    """(m, 3) roughness, metallic and glow of its triangles."""
    is_white: bool

    @property
    def is_held_out(self) -> bool:
        """No network may learn from it."""
        return self.name in HELD_OUT

    @functools.cached_property
    def albedo(self) -> Array:
        """(3,) mean linear albedo over its surface."""
        return _mean_albedo(self.airframe)


def real_drone(meshes: Path, name: str, rng: Generator) -> Drone:
    """A real airframe, in its own paint or another."""
    shape = _read(meshes, name)
    paint = str(rng.choice(["its own", "white", "dark", "hue"], p=[0.4, 0.42, 0.13, 0.05]))
    colours = shape.colours
    if paint == "hue":
        colours = 0.3 * colours + 0.7 * vivid(rng)
    elif paint == "white":
        # Motors and carbon often stay dark on white drones.
        keep = rng.random() < 0.5
        dark = (colours.mean(axis=1) < 0.025)[:, None] & keep
        colours = np.where(dark, colours, painted(colours, "white") * rng.uniform(0.75, 1.1))
    elif paint == "dark":
        colours = painted(colours, "dark")
    return _drone(name, "real", shape, np.clip(colours, 0.01, 0.85), _finish(colours, rng))


def shell_drone(kind: str, seed: int) -> Drone:
    """A consumer shell of `shells.KINDS`."""
    made = shell(kind, seed)
    shape = _about_middle(
        made.vertices, made.triangles, made.finish[:, :3], made.hubs, [made.propeller_radius_m] * len(made.hubs)
    )
    return Drone(kind, "shell", shape, made.finish[:, 3:], made.is_white)


def generated(number: int, seed: int, rng: Generator) -> Drone:
    """A multirotor of `drone_generator`, its propellers taken off."""
    model = generated_drone(number % _SHAPES, seed)
    apart = np.linalg.norm(model.hubs[:, None, :2] - model.hubs[None, :, :2], axis=2).max()
    radius = float(model.size_m - apart) / 2.0
    vertices, triangles = model.vertices.astype(float), model.triangles
    corners = vertices[triangles]
    # Where `Airframe.rotor` and `hanging_rotor` put propellers, at the size that shapes are drawn at.
    unit = model.size_m / DRAWN_SIZE_M
    lift = 0.004 * unit + 0.01 * radius
    is_propeller = np.zeros(len(triangles), bool)
    for hub in model.hubs:
        off = corners - hub
        near = (np.hypot(off[..., 0], off[..., 1]) < 1.03 * radius).all(axis=1)
        for side in (1.0, -1.0):
            z = side * off[..., 2]
            is_propeller |= near & ((z > 0.5 * lift) & (z < lift + 0.0095 * unit)).all(axis=1)
    colours = model.colours[~is_propeller].astype(float)
    if rng.random() < 0.3:
        colours = painted(colours, "white")
    shape = _about_middle(vertices, triangles[~is_propeller], colours, model.hubs, [radius] * len(model.hubs))
    return _drone(f"generated {number % _SHAPES}", "generated", shape, colours, _finish(colours, rng))


@functools.cache
def _read(meshes: Path, name: str) -> Airframe:
    return airframe(meshes, name, SOURCES)


def _drone(name: str, kind: str, shape: Airframe, colours: Array, finish: Array) -> Drone:
    made = Airframe(shape.vertices, shape.triangles, colours, shape.rotors)
    return Drone(name, kind, made, finish, bool(_mean_albedo(made) @ _LIGHT > _WHITE_FROM))


def _finish(colours: Array, rng: Generator) -> Array:
    """(m, 3): each colour of a drone has a roughness of its own, and some are metal."""
    _, which = np.unique(np.round(colours, 2), axis=0, return_inverse=True)
    kinds = int(which.max()) + 1
    rough, metal = rng.uniform(0.15, 0.7, kinds), (rng.random(kinds) < 0.12) * 1.0
    which = which.reshape(-1)
    return np.stack([rough[which], metal[which], np.zeros(len(which))], axis=1)


def _mean_albedo(shape: Airframe) -> Array:
    a, b, c = (shape.vertices[shape.triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.asarray(area @ shape.colours / area.sum())


def _about_middle(
    vertices: Array, triangles: Array, colours: Array, hubs: Sequence[Any] | Array, radii: Sequence[float]
) -> Airframe:
    """With its origin in the middle of its box, propellers and all."""
    kept, where = np.unique(triangles, return_inverse=True)
    vertices, triangles = vertices[kept], where.reshape(-1, 3)
    places, reach = np.asarray(hubs, float), np.array([[r, r, 0.0] for r in radii])
    everything = np.vstack([vertices, places - reach, places + reach])
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2.0
    rotors = tuple(Rotor(hub - middle, radius) for hub, radius in zip(places, radii, strict=True))
    return Airframe(vertices - middle, triangles, colours, rotors)


def propeller(radius_m: float, turn: float, blades: int, bend: float, sense: float) -> tuple[Array, Array]:
    """Corners (n, 3) and triangles of a propeller about the origin, FRD; ``turn`` from forward, rad.

    ``bend``: how far a folding propeller of two blades is off the straight line, rad. ``sense``: 1 or -1.
    """
    along = np.array([0.04, 0.12, 0.25, 0.4, 0.6, 0.8, 0.95, 1.0])
    chord = np.array([0.07, 0.1, 0.17, 0.185, 0.155, 0.12, 0.08, 0.03]) * (0.9 if blades == 2 else 0.75)
    twist = np.radians([10.0, 18.0, 22.0, 19.0, 14.0, 11.0, 9.0, 8.0]) * sense
    share = np.array([-0.5, 0.0, 0.5])
    x = np.repeat(along[:, None], 3, axis=1)
    y = chord[:, None] * share * np.cos(twist)[:, None]
    z = chord[:, None] * share * np.sin(twist)[:, None] - 0.012 * (np.abs(share) < 0.1)
    one = radius_m * np.stack([x, y, z], axis=2).reshape(-1, 3)
    k, j = np.meshgrid(np.arange(len(along) - 1), np.arange(2), indexing="ij")
    a = (3 * k + j).ravel()
    faces = np.vstack([np.stack([a, a + 1, a + 4], axis=1), np.stack([a, a + 4, a + 3], axis=1)])
    corners, triangles = [], []
    for n in range(blades):
        angle = turn + 2 * math.pi * n / blades + (bend if n else 0.0)
        c, s = math.cos(angle), math.sin(angle)
        corners.append(one @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))
        triangles.append(faces + n * len(one))
    return np.vstack(corners), np.vstack(triangles)


def swept(radius_m: float, turn: float, width: float, blades: int) -> tuple[Array, Array]:
    """What a propeller sweeps while a shutter is open: sectors ``width`` wide, rad, at most the whole disc."""
    wide = min(width, 2 * math.pi / blades)
    corners, triangles = [], []
    for n in range(blades):
        angles = turn + 2 * math.pi * n / blades + np.linspace(0.0, wide, 25)
        ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(25)], axis=1)
        corners.append(radius_m * np.vstack([0.08 * ring, ring]))
        k = np.arange(24)
        faces = np.vstack([np.stack([k, k + 1, k + 26], axis=1), np.stack([k, k + 26, k + 25], axis=1)])
        triangles.append(faces + 50 * n)
    return np.vstack(corners), np.vstack(triangles)
