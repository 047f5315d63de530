"""Camera drones as people buy them, drawn from a seed: smooth shells, sizes in the ranges that makers publish.

Kinds: "Phantom-like" (0.35 m between motors), "Mavic-like" (0.335 to 0.38), "Mini-like" (0.21), "Inspire-like" (0.6)
and "FPV-like" (0.2 to 0.25). No maker's mesh is in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from tools.training.cutouts.solids import Finish, Solids

Array = NDArray[Any]
Colour = tuple[float, float, float]
Hub = tuple[float, float, float]
WHITE_SHARE = 0.5
_LENS = Finish((0.01, 0.01, 0.015), 0.08)
_RUBBER = Finish((0.02, 0.02, 0.02), 0.6)


@dataclass(frozen=True, eq=False)
class Shell:
    """A drone without its propellers; body FRD, metres."""

    vertices: Array
    triangles: Array
    finish: Array
    """(m, 6) as of `Solids.mesh`."""
    hubs: tuple[Hub, ...]
    propeller_radius_m: float
    is_white: bool


@dataclass(frozen=True)
class _Paint:
    """What one drone is painted with."""

    body: Finish
    second: Finish
    """Arms' ends, legs, motors' feet."""
    dark: Finish
    metal: Finish
    accent: Finish
    is_white: bool


def shell(kind: str, seed: int) -> Shell:
    """One drone of a kind in `KINDS`."""
    rng = np.random.Generator(np.random.PCG64([seed, sum(kind.encode())]))
    paint = _paint(rng)
    solids = Solids()
    hubs, radius = KINDS[kind](solids, paint, rng)
    return Shell(*solids.mesh(), tuple(hubs), radius, paint.is_white)


def _paint(rng: Generator) -> _Paint:
    rough = float(rng.uniform(0.15, 0.6))
    is_white = bool(rng.random() < WHITE_SHARE)
    if is_white:
        body = np.full(3, rng.uniform(0.5, 0.85)) * rng.uniform(0.95, 1.0, 3)
    elif rng.random() < 0.8:
        body = np.full(3, np.exp(rng.uniform(math.log(0.02), math.log(0.3)))) * rng.uniform(0.93, 1.0, 3)
    else:
        body = vivid(rng)
    second = body if rng.random() < 0.6 else body * rng.uniform(0.3, 0.8)
    dark = np.full(3, rng.uniform(0.012, 0.06))
    metal = Finish(_colour(np.full(3, rng.uniform(0.3, 0.7))), float(rng.uniform(0.2, 0.5)), 1.0)
    accent = Finish(_colour(vivid(rng)), rough)
    return _Paint(
        Finish(_colour(body), rough),
        Finish(_colour(second), rough),
        Finish(_colour(dark), float(rng.uniform(0.3, 0.7))),
        metal if rng.random() < 0.6 else Finish(_colour(dark), 0.4, 0.5),
        accent,
        is_white,
    )


def vivid(rng: Generator) -> Array:
    """(3,) a strong colour of any hue, linear."""
    hue = rng.uniform(0, 2 * math.pi)
    rgb = np.clip(0.5 + 0.7 * np.cos(hue + np.array([0.0, -2.1, 2.1])), 0.0, 1.0)
    pale = rng.uniform(0.0, 0.5)
    return np.asarray(np.clip(((1.0 - pale) * rgb**2 + pale * 0.4) * rng.uniform(0.2, 0.75), 0.01, 0.8))


def _colour(rgb: Array) -> Colour:
    return float(rgb[0]), float(rgb[1]), float(rgb[2])


def _lamp(rng: Generator, ahead: bool) -> Finish:
    """An LED under an arm, lit or not."""
    colour = (0.9, 0.05, 0.03) if ahead == bool(rng.random() < 0.8) else (0.1, 0.85, 0.15)
    return Finish(colour, 0.2, 0.0, float(rng.uniform(1.0, 6.0)) if rng.random() < 0.5 else 0.0)


def _motor(s: Solids, p: _Paint, hub: Hub, radius: float, height: float) -> None:
    """A motor whose top is at ``hub``, with the cap that holds the propeller."""
    x, y, z = hub
    s.drum((x, y, z + height), 0.92 * radius, 0.45 * height, p.dark)
    s.drum((x, y, z + 0.62 * height), radius, 0.62 * height, p.metal)
    s.drum((x, y, z), 0.4 * radius, 0.35 * radius, p.dark)


def _camera(s: Solids, p: _Paint, place: Hub, size: float, rng: Generator) -> None:
    """A camera on a gimbal's arm that looks ahead, its nose up to 40 degrees down."""
    x, y, z = place
    box = rng.random() < 0.5
    body = p.dark if rng.random() < 0.7 else p.body
    s.bar(
        [(x - 0.9 * size, y, z - 1.6 * size), (x - size, y + 0.9 * size, z - 0.7 * size), (x, y + 1.15 * size, z)],
        [(0.3 * size, 0.3 * size)] * 3,
        p.dark,
    )
    s.ball(place, (size, 0.9 * size, 0.9 * size), body, corner=3.5 if box else 2.0)
    down = rng.uniform(0.0, 0.7)
    ahead, below = math.cos(down) * size, math.sin(down) * size
    s.bar(
        [(x + 0.7 * ahead, y, z + 0.7 * below), (x + 1.25 * ahead, y, z + 1.25 * below)],
        [(0.62 * size, 0.62 * size), (0.55 * size, 0.55 * size)],
        p.dark,
        corner=2.0,
        cap=0.1,
        is_curve=False,
    )
    s.ball((x + 1.22 * ahead, y, z + 1.22 * below), (0.25 * size, 0.45 * size, 0.45 * size), _LENS)


def _phantom(s: Solids, p: _Paint, rng: Generator) -> tuple[list[Hub], float]:
    """One white shell of body and arms, two loops to stand on, a camera between them."""
    apart = 0.35 * rng.uniform(0.95, 1.05)
    radius = 0.1194 * rng.uniform(0.96, 1.04)
    reach, tall = apart / 2, rng.uniform(0.03, 0.042)
    wide, waist = rng.uniform(0.15, 0.24), rng.uniform(0.072, 0.09)
    angles = np.linspace(-math.pi, math.pi, 144, endpoint=False)
    off = np.abs((angles + math.pi) % (math.pi / 2) - math.pi / 4)
    outline = waist + (reach + 0.018 - waist) * np.exp(-((off / wide) ** 2.2))
    shares = np.sin(np.linspace(0, math.pi / 2, 14))[:, None]
    r = shares * outline
    arm = rng.uniform(0.012, 0.016)
    dome = arm + (tall - arm) * np.exp(-((r / (0.75 * waist)) ** rng.uniform(2.0, 3.0)))
    edge = np.clip(1 - shares ** rng.uniform(3.0, 5.0), 0, 1) ** 0.5
    rise = 0.010 * (r / reach) ** 2
    where, polar = s.star(
        outline, dome * edge + rise, (0.55 + 0.25 * rng.random()) * dome * edge - rise, angles, p.body, (0, 0, 0)
    )
    style = rng.random()
    if style < 0.6:
        first = rng.uniform(0.45, 0.62) * reach
        band = (polar[:, 1] > first) & (polar[:, 1] < first + rng.uniform(0.08, 0.3) * reach)
        ahead = np.abs(polar[:, 0]) < math.pi / 2
        s.paint(where, band & (ahead if style < 0.35 else np.full(len(ahead), True)), p.accent)
    hubs = [(x * reach / 2**0.5, y * reach / 2**0.5, -arm - 0.022) for x in (1, -1) for y in (1, -1)]
    for hub in hubs:
        _motor(s, p, hub, 0.0145, 0.02)
        s.drum((hub[0], hub[1], 0.003), 0.009, 0.008, _lamp(rng, hub[0] > 0))
    _loops(s, p if rng.random() < 0.8 else _with_dark_legs(p), reach, tall, rng)
    s.ball((0.0, 0.0, 0.62 * tall), (0.05, 0.04, 0.02), p.second, corner=3.0)
    s.ball((0.03, 0.0, 0.95 * tall), (0.032, 0.026, 0.007), p.dark, corner=3.0)
    _camera(s, p, (0.035, 0.0, 0.95 * tall + 0.035), rng.uniform(0.016, 0.022), rng)
    s.ball((-waist * 0.92, 0, 0), (0.012, 0.03, 0.014), p.dark, corner=3.0)
    return hubs, float(radius)


def _with_dark_legs(p: _Paint) -> _Paint:
    return _Paint(p.body, p.dark, p.dark, p.metal, p.accent, p.is_white)


def _loops(s: Solids, p: _Paint, reach: float, tall: float, rng: Generator) -> None:
    deep, out = rng.uniform(0.105, 0.14), rng.uniform(0.075, 0.1)
    long, thick = rng.uniform(0.055, 0.08), rng.uniform(0.0055, 0.0085)
    for side in (1.0, -1.0):
        path = [
            (0.75 * long, side * 0.55 * out, 0.4 * tall),
            (0.9 * long, side * 0.8 * out, 0.55 * deep),
            (1.0 * long, side * 0.97 * out, 0.9 * deep),
            (0.85 * long, side * out, deep),
            (-0.85 * long, side * out, deep),
            (-1.0 * long, side * 0.97 * out, 0.9 * deep),
            (-0.9 * long, side * 0.8 * out, 0.55 * deep),
            (-0.75 * long, side * 0.55 * out, 0.4 * tall),
        ]
        s.bar(path, [(thick, thick)] * len(path), p.second, corner=2.4)


def _mavic(s: Solids, p: _Paint, rng: Generator) -> tuple[list[Hub], float]:
    return _folding(s, p, rng, apart=rng.uniform(0.335, 0.38), radius=rng.uniform(0.105, 0.12))


def _mini(s: Solids, p: _Paint, rng: Generator) -> tuple[list[Hub], float]:
    return _folding(s, p, rng, apart=rng.uniform(0.205, 0.25), radius=rng.uniform(0.059, 0.076))


def _folding(s: Solids, p: _Paint, rng: Generator, *, apart: float, radius: float) -> tuple[list[Hub], float]:
    """A slim box, front arms high, rear arms low, its camera in the nose."""
    u = apart / 0.354
    half, wide, tall = u * rng.uniform(0.095, 0.115), u * rng.uniform(0.036, 0.046), u * rng.uniform(0.027, 0.038)
    nose, tail = rng.uniform(0.6, 0.85), rng.uniform(0.65, 0.95)
    corner = rng.uniform(2.8, 4.5)
    s.hull(
        [
            (-half, 0, 0, tail * wide, 0.75 * tall),
            (-0.75 * half, 0, 0, 0.95 * wide, 0.96 * tall),
            (0, 0, 0, wide, tall),
            (0.5 * half, 0, 0.02 * tall, 0.95 * wide, 0.95 * tall),
            (0.85 * half, 0, 0.0, nose * wide, 0.7 * tall),
            (half, 0, -0.05 * tall, 0.8 * nose * wide, 0.45 * tall),
        ],
        p.body,
        corner=corner,
    )
    # The battery's lid, another colour or the same.
    s.hull(
        [
            (-0.9 * half, 0, -0.62 * tall, 0.55 * wide, 0.4 * tall),
            (0.45 * half, 0, -0.68 * tall, 0.5 * wide, 0.38 * tall),
        ],
        p.second,
        corner=4.0,
    )
    s.hull(
        [(-0.7 * half, 0, 0.75 * tall, 0.6 * wide, 0.3 * tall), (0.4 * half, 0, 0.75 * tall, 0.6 * wide, 0.3 * tall)],
        p.dark if rng.random() < 0.5 else p.second,
        corner=4.0,
    )
    for side in (1.0, -1.0):
        s.ball((0.97 * half, side * 0.5 * nose * wide, -0.15 * tall), (0.1 * tall, 0.18 * tall, 0.18 * tall), _LENS)
        s.ball((-0.99 * half, side * 0.4 * wide, -0.1 * tall), (0.1 * tall, 0.16 * tall, 0.16 * tall), _LENS)
    _camera(s, p, (0.98 * half, 0, 0.5 * tall), u * rng.uniform(0.014, 0.02), rng)
    aspect = rng.uniform(0.68, 0.95)
    y_front = apart / 2 * math.cos(math.atan(aspect)) * rng.uniform(1.0, 1.08)
    x_front = apart / 2 * math.sin(math.atan(aspect))
    y_rear, x_rear = y_front * rng.uniform(0.82, 0.98), x_front * rng.uniform(0.95, 1.1)
    up, low = rng.uniform(0.3, 0.7) * tall, rng.uniform(0.2, 0.6) * tall
    thick = u * rng.uniform(0.0075, 0.0105)
    hubs: list[Hub] = []
    for x, y, z, root in ((x_front, y_front, -up, 0.72 * half), (-x_rear, y_rear, low, -0.62 * half)):
        for side in (1.0, -1.0):
            bend = root + 0.12 * (x - root)
            s.bar(
                [
                    (root, side * 0.75 * wide, z),
                    (bend, side * 1.15 * wide, z),
                    (0.5 * (x + bend), side * 0.55 * (y + wide), z),
                    (x, side * y, z),
                ],
                [
                    (1.25 * thick, 1.5 * thick),
                    (1.5 * thick, 1.5 * thick),
                    (0.95 * thick, thick),
                    (1.1 * thick, 1.1 * thick),
                ],
                p.body,
                corner=3.0,
            )
            s.drum((x, side * y, z + 1.1 * thick), 1.5 * thick, 2.2 * thick, p.second)
            top = z - 1.1 * thick - u * 0.013
            hubs.append((x, side * y, top))
            _motor(s, p, hubs[-1], u * 0.0125, u * 0.014)
            if x > 0 or rng.random() < 0.3:
                deep = u * rng.uniform(0.03, 0.05) if x > 0 else u * 0.015
                s.bar(
                    [(x, side * y, z), (x + 0.1 * deep, side * y, z + deep)],
                    [(0.7 * thick, 0.9 * thick), (0.4 * thick, 0.6 * thick)],
                    p.second,
                    is_curve=False,
                )
            s.drum((x, side * y, z + 1.35 * thick), 0.6 * thick, 0.4 * thick, _lamp(rng, x > 0))
            if rng.random() < 0.1:
                s.bar(
                    [
                        (0.6 * x + 0.4 * bend, side * (0.6 * y + 0.4 * wide), z),
                        (0.75 * x + 0.25 * bend, side * (0.75 * y + 0.25 * wide), z),
                    ],
                    [(1.06 * thick, 1.12 * thick)] * 2,
                    p.accent,
                    is_curve=False,
                    corner=3.0,
                )
    return hubs, float(radius)


def _inspire(s: Solids, p: _Paint, rng: Generator) -> tuple[list[Hub], float]:
    """A tall nose, a boom to each side and raised, and along its end a tube with two motors."""
    apart, radius = rng.uniform(0.56, 0.62), rng.uniform(0.155, 0.19)
    x_motor, y_motor = 0.33 * apart, 0.375 * apart
    up = rng.uniform(0.03, 0.09)
    half, wide, tall = rng.uniform(0.13, 0.17), rng.uniform(0.05, 0.065), rng.uniform(0.045, 0.06)
    s.hull(
        [
            (-half, 0, -0.1 * tall, 0.5 * wide, 0.45 * tall),
            (-0.6 * half, 0, 0, 0.85 * wide, 0.85 * tall),
            (0.1 * half, 0, 0, wide, tall),
            (0.65 * half, 0, 0.05 * tall, 0.85 * wide, 0.8 * tall),
            (half, 0, 0.15 * tall, 0.5 * wide, 0.45 * tall),
        ],
        p.body,
        corner=rng.uniform(2.3, 3.2),
    )
    s.hull(
        [
            (-0.95 * half, 0, -0.5 * tall, 0.6 * wide, 0.4 * tall),
            (-0.1 * half, 0, -0.7 * tall, 0.65 * wide, 0.45 * tall),
        ],
        p.second if rng.random() < 0.5 else p.dark,
        corner=3.5,
    )
    tube = p.dark if rng.random() < 0.7 else p.body
    x_boom = 0.05 * half
    hubs: list[Hub] = []
    for side in (1.0, -1.0):
        s.bar(
            [
                (x_boom, side * 0.8 * wide, 0.2 * tall),
                (x_boom, side * 1.5 * wide, 0.1 * tall - 0.2 * up),
                (x_boom, side * y_motor, -up),
            ],
            [(0.016, 0.013), (0.012, 0.012), (0.01, 0.01)],
            tube,
            corner=2.2,
        )
        s.ball((x_boom, side * y_motor, -up), (0.03, 0.016, 0.018), p.body, corner=3.0)
        s.bar(
            [(-x_motor, side * y_motor, -up), (x_motor, side * y_motor, -up)],
            [(0.009, 0.009)] * 2,
            tube,
            corner=2.0,
            is_curve=False,
        )
        for x in (x_motor, -x_motor):
            s.ball((x, side * y_motor, -up), (0.024, 0.019, 0.017), p.body, corner=2.6)
            hubs.append((x, side * y_motor, -up - 0.034))
            _motor(s, p, hubs[-1], 0.02, 0.026)
            s.bar(
                [(x, side * y_motor, -up), (x * 1.02, side * y_motor, -up + rng.uniform(0.05, 0.08))],
                [(0.008, 0.008), (0.005, 0.005)],
                p.second,
                is_curve=False,
            )
            s.drum((x, side * y_motor, -up + 0.022), 0.007, 0.006, _lamp(rng, x > 0))
    _camera(s, p, (0.75 * half, 0.0, tall + 0.04), rng.uniform(0.028, 0.036), rng)
    s.ball((half, 0, 0.05 * tall), (0.008, 0.55 * wide, 0.012), _LENS)
    return hubs, float(radius)


def _fpv(s: Solids, p: _Paint, rng: Generator) -> tuple[list[Hub], float]:
    """Flat arms from a narrow frame, a canopy or a battery on top, a camera in the nose that looks up."""
    apart, radius = rng.uniform(0.2, 0.26), rng.uniform(0.06, 0.07)
    half, wide, tall = apart * rng.uniform(0.33, 0.42), apart * rng.uniform(0.09, 0.13), apart * rng.uniform(0.08, 0.12)
    spread = math.radians(rng.uniform(40.0, 55.0))
    thick, arm = apart * rng.uniform(0.011, 0.02), apart * rng.uniform(0.028, 0.045)
    hubs: list[Hub] = []
    frame = p.dark if rng.random() < 0.7 else p.body
    for x in (1.0, -1.0):
        for y in (1.0, -1.0):
            place = (x * apart / 2 * math.cos(spread), y * apart / 2 * math.sin(spread), 0.0)
            s.bar(
                [(0.25 * x * half, 0.3 * y * wide, 0.0), place],
                [(1.2 * arm, thick), (0.9 * arm, thick)],
                frame,
                corner=4.0,
                is_curve=False,
            )
            s.drum((place[0], place[1], thick), 1.2 * arm, 2 * thick, frame)
            hubs.append((place[0], place[1], -thick - 0.016))
            _motor(s, p, hubs[-1], 0.0135, 0.016)
            s.bar([place, (place[0], place[1], tall * 0.9)], [(0.006, 0.006), (0.004, 0.004)], p.second, is_curve=False)
    if rng.random() < 0.65:
        s.hull(
            [
                (-0.9 * half, 0, -0.25 * tall, 0.8 * wide, 0.5 * tall),
                (-0.2 * half, 0, -0.75 * tall, wide, 0.95 * tall),
                (0.5 * half, 0, -0.5 * tall, 0.9 * wide, 0.85 * tall),
                (0.95 * half, 0, -0.2 * tall, 0.6 * wide, 0.5 * tall),
            ],
            p.body,
            corner=rng.uniform(2.3, 4.0),
        )
        s.hull(
            [
                (-0.7 * half, 0, -1.2 * tall, 0.5 * wide, 0.35 * tall),
                (0.1 * half, 0, -1.5 * tall, 0.45 * wide, 0.3 * tall),
            ],
            p.accent,
            corner=4.0,
        )
    else:
        for z in (0.0, -1.1 * tall):
            s.hull([(-half, 0, z, 0.8 * wide, thick), (half, 0, z, 0.8 * wide, thick)], frame, corner=6.0)
        s.hull(
            [
                (-0.5 * half, 0, -0.55 * tall, 0.5 * wide, 0.4 * tall),
                (0.5 * half, 0, -0.55 * tall, 0.5 * wide, 0.4 * tall),
            ],
            p.second,
            corner=5.0,
        )
        s.hull(
            [
                (-0.6 * half, 0, -1.75 * tall, 0.75 * wide, 0.55 * tall),
                (0.4 * half, 0, -1.75 * tall, 0.75 * wide, 0.55 * tall),
            ],
            p.accent,
            corner=7.0,
        )
        for x in (1.0, -1.0):
            for y in (1.0, -1.0):
                s.bar(
                    [(0.85 * x * half, 0.6 * y * wide, 0.0), (0.85 * x * half, 0.6 * y * wide, -1.1 * tall)],
                    [(0.003, 0.003)] * 2,
                    p.metal,
                    is_curve=False,
                )
    _camera(s, p, (0.98 * half, 0.0, -0.45 * tall), 0.011, rng)
    if rng.random() < 0.6:
        s.bar([(-half, 0, -0.5 * tall), (-1.3 * half, 0, -1.6 * tall)], [(0.003, 0.003)] * 2, p.dark, is_curve=False)
        s.ball((-1.3 * half, 0, -1.7 * tall), (0.008, 0.008, 0.01), p.dark)
    return hubs, float(radius)


KINDS: dict[str, Callable[[Solids, _Paint, Generator], tuple[list[Hub], float]]] = {
    "Phantom-like": _phantom,
    "Mavic-like": _mavic,
    "Mini-like": _mini,
    "Inspire-like": _inspire,
    "FPV-like": _fpv,
}
SHARES = {"Phantom-like": 0.3, "Mavic-like": 0.3, "Mini-like": 0.15, "Inspire-like": 0.13, "FPV-like": 0.12}
"""How often each is drawn."""
