"""What generated drones carry besides body, arms and rotors: guards, landing gear, payloads, lights."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.sim.airframe import Airframe, outline

Array = NDArray[Any]
Place = tuple[float, float, float]
_BLACK = np.full(3, 0.02)


def hanging_rotor(c: Airframe, place: Place, radius: float, motor: tuple[float, float]) -> None:
    """The lower rotor of a coaxial pair, under ``place``; ``motor``: radius and height."""
    x, y, z = place
    low = z + motor[1]
    c.rod((x, y, z), (x, y, low), motor[0], [c.metal], 8)
    hub = np.array([x, y, low])
    c.hubs.append(hub)
    c.radii.append(radius)
    drop = np.array([0, 0, 0.004 + 0.01 * radius])
    skin = int(c.skin[1])
    if c.disc:
        c.mesh.frustum(hub + drop + [0, 0, 0.004], hub + drop, (radius, radius), 16, skin, c.prop, (0.25, 0.25))
    else:
        width = 0.075 * radius + 0.004
        half = (math.sqrt(radius**2 - width**2), width, 0.002)
        c.mesh.box(hub + drop, half, c.rng.uniform(0, math.pi), skin, c.prop, (0.25, 0.25))


def add_guards(c: Airframe, kind: str, hubs: Array, radius: float) -> None:
    """`ducts` around every rotor, `rails` around all, `arcs` around each one's outer side, or `none`."""
    if kind == "ducts":
        for x, y, z in hubs:
            accent = c.front if x > 0 else c.rear
            c.ring(x, y, z - 0.1 * radius, 1.07 * radius, 1.16 * radius, 0.24 * radius, accent, c.body)
            c.beam((x - 1.1 * radius, y, z), (x + 1.1 * radius, y, z), (0.05 * radius, 0.04 * radius), [c.frame])
    elif kind in ("rails", "arcs"):
        arcs = [_outer_arc(hub, 1.14 * radius) for hub in hubs[np.argsort(np.arctan2(hubs[:, 1], hubs[:, 0]))]]
        for arc in arcs:
            accent = c.front if arc[1][0] > 0 else c.rear
            _chain(c, arc, 0.05 * radius, accent)
            middle = arc[len(arc) // 2]
            hub = (float(arc[:, 0].mean() * 0.9), float(arc[:, 1].mean() * 0.9), float(middle[2]))
            c.rod(hub, _place(middle), 0.04 * radius, [c.frame], 5)
        if kind == "rails":
            for first, second in zip(arcs, [*arcs[1:], arcs[0]], strict=True):
                c.rod(_place(first[-1]), _place(second[0]), 0.05 * radius, [c.frame], 5)


def _outer_arc(hub: Array, radius: float) -> Array:
    """(5, 3) points around the side of a rotor that faces away from the middle."""
    middle = math.atan2(hub[1], hub[0])
    angles = middle + np.radians([-80, -40, 0, 40, 80])
    return np.column_stack([hub[0] + radius * np.cos(angles), hub[1] + radius * np.sin(angles), np.full(5, hub[2])])


def _chain(c: Airframe, points: Array, thick: float, colour: Array) -> None:
    for a, b in itertools.pairwise(points):
        c.rod(_place(a), _place(b), thick, [colour], 5)


def _place(point: Array) -> Place:
    return float(point[0]), float(point[1]), float(point[2])


def add_landing_gear(c: Airframe, hubs: Array, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    """Legs under the motors, skids, stilts, or nothing."""
    kind = str(rng.choice(["none", "motors", "skids", "stilts", "loops"], p=[0.2, 0.25, 0.25, 0.2, 0.1]))
    tall, thick = reach * float(rng.uniform(0.25, 0.6)), reach * float(rng.uniform(0.014, 0.028))
    half, wide, low = body
    if kind == "motors":
        for x, y, z in hubs if len(hubs) <= 4 or rng.random() < 0.5 else hubs[::2]:
            c.rod((x, y, z), (x, y, z + tall), 1.2 * thick, [c.frame, c.front if x > 0 else c.rear], 6)
    elif kind == "stilts":
        spread = float(rng.uniform(1.0, 1.8))
        for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
            foot = (x * 0.7 * half * spread, y * 0.8 * wide * spread, tall)
            c.rod((x * 0.6 * half, y * 0.6 * wide, 0.4 * low), foot, thick, [c.frame, c.rear], 6)
    elif kind in ("skids", "loops"):
        side, long = wide * float(rng.uniform(0.9, 1.9)), half * float(rng.uniform(0.8, 1.4))
        for y in (-side, side):
            c.rod((-long, y, tall), (long, y, tall), 1.2 * thick, [c.rear, c.frame, c.front], 6)
            for x in (-0.5, 0.5) if kind == "skids" else (-1.0, 1.0):
                root = (x * 0.8 * half, 0.5 * y / side * wide, 0.3 * low)
                c.rod(root, (x * long, y, tall), thick, [c.frame, c.body], 6)


def add_payloads(c: Airframe, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    """None to three of them."""
    chosen = rng.choice(len(_PAYLOADS), int(rng.choice([0, 1, 2, 3], p=[0.15, 0.35, 0.35, 0.15])), replace=False)
    for k in chosen:
        _PAYLOADS[int(k)](c, reach, body, rng)


def _gimbal(c: Airframe, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    half, _, tall = body
    ball = reach * float(rng.uniform(0.07, 0.14))
    x, z = half * float(rng.uniform(0.2, 0.9)), 0.8 * tall + 1.5 * ball
    for y in (-1.15 * ball, 1.15 * ball):
        c.rod((x, y, 0.4 * tall), (x, y, z), 0.2 * ball, [c.metal], 6)
    c.ball((x, 0, z), ball, c.frame)
    c.rod((x + 0.8 * ball, 0, z), (x + 1.3 * ball, 0, z), 0.5 * ball, [_BLACK], 8)


def _parcel(c: Airframe, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    half, wide, tall = body
    sides = half * rng.uniform(0.5, 0.9), wide * rng.uniform(0.6, 1.1), tall * rng.uniform(0.7, 1.6)
    c.box((0, 0, 0.8 * tall + sides[2]), sides, np.array([0.33, 0.21, 0.11]) * c.rng.uniform(0.6, 1.5))


def _lidar(c: Airframe, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    tall, wide = body[2], reach * float(rng.uniform(0.08, 0.15))
    x, sign = body[0] * float(rng.uniform(-0.4, 0.6)), float(rng.choice([-1.0, 1.0]))
    a, b = (x, 0.0, sign * 1.0 * tall), (x, 0.0, sign * (1.1 * tall + 1.4 * wide))
    c.rod(*((a, b) if sign > 0 else (b, a)), wide, [c.metal, _BLACK, c.metal], 10)


def _antennas(c: Airframe, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    half, wide, tall = body
    long = reach * float(rng.uniform(0.3, 0.6))
    for y in (-1.0, 1.0) if rng.random() < 0.7 else (0.0,):
        root = (-0.8 * half, 0.4 * y * wide, -0.4 * tall)
        tip = (root[0] - 0.5 * long, root[1] + 0.3 * y * long, root[2] - 0.8 * long)
        c.rod(root, tip, 0.012 * reach, [c.frame, c.rear], 5)


def _satellite_mast(c: Airframe, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    top = -body[2] - reach * float(rng.uniform(0.15, 0.4))
    x = body[0] * float(rng.uniform(-0.8, 0.2))
    c.rod((x, 0, -0.5 * body[2]), (x, 0, top), 0.016 * reach, [c.frame], 5)
    c.rod((x, 0, top), (x, 0, top - 0.05 * reach), reach * float(rng.uniform(0.07, 0.12)), [c.body], 10)


def _battery(c: Airframe, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    half, wide, tall = body
    z = -1.5 * tall
    c.box((-0.1 * half, 0, z), (0.7 * half, 0.45 * wide, 0.45 * tall), c.rear * 0.6)
    c.box((-0.1 * half, 0, z), (0.08 * half, 0.47 * wide, 0.47 * tall), _BLACK)


def _tank(c: Airframe, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    half, wide, tall = body
    right = [(0.6 * half, 0.6 * wide), (0.3 * half, wide), (-0.5 * half, wide), (-0.7 * half, 0.6 * wide)]
    rings = [outline(right, tall * z, s) for z, s in ((0.5, 0.8), (0.9, 1.0), (1.9, 0.9), (2.3, 0.5))]
    c.loft(rings, [c.front, np.full(3, 0.6), np.full(3, 0.5)])


_PAYLOADS = (_gimbal, _gimbal, _parcel, _lidar, _antennas, _satellite_mast, _battery, _tank)


def add_lights(c: Airframe, hubs: Array, reach: float, rng: Generator) -> None:
    """Lamps under the arms' ends, or none: green or white ahead, red astern, or in the drone's own colours."""
    if rng.random() < 0.55:
        return
    own = bool(rng.random() < 0.4)
    ahead = c.front if own else np.array([[0.15, 0.8, 0.2], [0.85, 0.85, 0.85]][int(rng.integers(2))])
    astern = c.rear if own else np.array([0.85, 0.06, 0.04])
    size = reach * float(rng.uniform(0.02, 0.04))
    for x, y, z in hubs:
        place = (0.93 * x, 0.93 * y, z + 0.06 * reach)
        c.rod(place, (place[0], place[1], place[2] + size), size, [ahead if x > 0 else astern], 6)
