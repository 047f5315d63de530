"""What generated drones carry besides body, arms and rotors: guards, landing gear, payloads, lights."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.sim.renderer.airframe import Airframe

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


def add_ducts(c: Airframe, hubs: Array, radius: float) -> None:
    """Around every rotor."""
    for x, y, z in hubs:
        accent = c.front if x > 0 else c.rear
        c.ring(x, y, z - 0.1 * radius, 1.07 * radius, 1.16 * radius, 0.24 * radius, accent, c.body)
        c.beam((x - 1.1 * radius, y, z), (x + 1.1 * radius, y, z), (0.05 * radius, 0.04 * radius), [c.frame])


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


def _antennas(c: Airframe, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    half, wide, tall = body
    long = reach * float(rng.uniform(0.3, 0.6))
    for y in (-1.0, 1.0) if rng.random() < 0.7 else (0.0,):
        root = (-0.8 * half, 0.4 * y * wide, -0.4 * tall)
        tip = (root[0] - 0.5 * long, root[1] + 0.3 * y * long, root[2] - 0.8 * long)
        c.rod(root, tip, 0.012 * reach, [c.frame, c.rear], 5)


def _battery(c: Airframe, reach: float, body: tuple[float, float, float], rng: Generator) -> None:
    half, wide, tall = body
    z = -1.5 * tall
    c.box((-0.1 * half, 0, z), (0.7 * half, 0.45 * wide, 0.45 * tall), c.rear * 0.6)
    c.box((-0.1 * half, 0, z), (0.08 * half, 0.47 * wide, 0.47 * tall), _BLACK)


_PAYLOADS = (_gimbal, _gimbal, _parcel, _antennas, _battery)


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
