"""Random multirotors: hundreds of shapes, so that networks do not overfit to a dozen.

Four to eight rotors on arms in many layouts, bodies, guards, landing gear, payloads and lights, 0.15 to 1.2 m from tip
to tip. A shape's size is its own, as of the simulator's families; only paint and propeller angles differ within it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from flockd.sim.renderer.airframe import BLACK, Airframe, DroneModel, outline, oval

Array = NDArray[Any]
Place = tuple[float, float, float]
FIRST_GENERATED = 1000
"""Family numbers of generated shapes begin here."""
SIZES_M = (0.15, 1.2)
DRAWN_SIZE_M = 0.6
"""A shape is put together at this size and then scaled: propellers and plates are thinner on small drones."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Layout of one shape; metres, body FRD."""

    hubs: Array
    """(n, 3) where the arms end."""
    radius: float
    """Radius of the propellers."""
    is_coaxial: bool
    """A second rotor hangs under each arm."""
    has_booms: bool
    """Two beams along the body carry the rotors, instead of an arm for each."""
    reach: float
    """Mean distance of the arms' ends from the middle."""
    body: tuple[float, float, float]
    """Half length, half width, half height."""


def generated_drone(shape: int, seed: int) -> DroneModel:
    """Shape number ``shape``, colours and propeller angles from ``seed``."""
    if shape < 0:
        raise ValueError(f"shape must not be negative: {shape}")
    craft = Airframe(np.random.default_rng([FIRST_GENERATED + shape, seed]))
    rng = np.random.default_rng([FIRST_GENERATED, shape])
    has_ducts = bool(rng.random() < 0.12)
    plan = _plan(rng, room=0.84 if has_ducts else 1.0)
    _BODIES[int(rng.integers(len(_BODIES)))](craft, plan, rng)
    (_booms if plan.has_booms else _arms)(craft, plan, rng)
    _rotors(craft, plan, rng)
    if has_ducts:
        add_ducts(craft, plan.hubs, plan.radius)
    add_landing_gear(craft, plan.hubs, plan.reach, plan.body, rng)
    add_payloads(craft, plan.reach, plan.body, rng)
    add_lights(craft, plan.hubs, plan.reach, rng)
    model = craft.model(FIRST_GENERATED + shape, seed)
    return _scaled(model, float(np.exp(rng.uniform(*np.log(SIZES_M)))) / model.size_m)


def _scaled(model: DroneModel, factor: float) -> DroneModel:
    uv = model.uv.copy()
    uv[:, :, :3] /= factor
    return replace(
        model,
        vertices=model.vertices * np.float32(factor),
        uv=uv,
        hubs=model.hubs * factor,
        extent=model.extent * factor,
        size_m=model.size_m * factor,
    )


def _plan(rng: Generator, room: float) -> Plan:
    """Layout and sizes; ``room``: share of the space that propellers may take."""
    shares = np.array([one.share for one in _LAYOUTS])
    layout = _LAYOUTS[int(rng.choice(len(_LAYOUTS), p=shares / shares.sum()))]
    places = np.asarray(layout.places(rng), float)
    apart = np.linalg.norm(places[:, None, :2] - places[None, :, :2], axis=2)
    nearest = float((apart + 1e9 * np.eye(len(places))).min())
    radius = nearest * float(rng.uniform(0.35, 0.47)) * room
    if layout.is_coaxial:
        radius = min(radius, 0.62)
    scale = DRAWN_SIZE_M / float((apart + 2 * radius).max())
    hubs, radius = places * scale, radius * scale
    reach = float(np.linalg.norm(hubs[:, :2], axis=1).mean())
    half = reach * rng.uniform(0.27, 0.46)
    wide = half * rng.uniform(0.5, 0.95)
    hubs[:, 2] -= reach * rng.choice([0.0, rng.uniform(-0.05, 0.14)])
    body = (half, wide, half * rng.uniform(0.22, 0.5))
    return Plan(hubs, radius, layout.is_coaxial, layout.has_booms, reach, body)


def _on_circle(count: int, first: float) -> Array:
    angles = first + 2 * np.pi * np.arange(count) / count
    return np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])


def _long_x(rng: Generator) -> Array:
    wide = float(rng.choice([rng.uniform(0.6, 0.85), rng.uniform(1.15, 1.5)]))
    return np.asarray(_on_circle(4, np.pi / 4) * np.array([1.0, wide, 1.0]))


def _folding(rng: Generator) -> Array:
    """Front arms high and swept ahead, rear ones low, or the other way."""
    high = float(rng.uniform(-0.12, 0.12))
    front, rear = (rng.uniform(0.75, 1.0), rng.uniform(0.85, 1.05)), (-rng.uniform(0.7, 0.9), rng.uniform(0.7, 0.95))
    return np.array([[x, side * y, z] for (x, y), z in ((front, high), (rear, -high)) for side in (1.0, -1.0)])


def _dead_cat(rng: Generator) -> Array:
    front, rear = (rng.uniform(0.3, 0.6), rng.uniform(0.95, 1.2)), (-rng.uniform(0.8, 1.0), rng.uniform(0.5, 0.8))
    return np.array([[x, side * y, 0.0] for x, y in (front, rear) for side in (1.0, -1.0)])


def _in_two_rows(rows: int, apart: float) -> Array:
    return np.array([[x, side * apart, 0.0] for x in np.linspace(1.0, -1.0, rows) for side in (1.0, -1.0)])


class _Layout(NamedTuple):
    """Where the arms of a kind of drone end; half-length of an arm about 1."""

    places: Callable[[Generator], Array]
    share: float
    """How often it is drawn."""
    is_coaxial: bool = False
    has_booms: bool = False


_LAYOUTS = (
    _Layout(lambda _: _on_circle(4, np.pi / 4), 0.2),
    _Layout(lambda _: _on_circle(4, 0.0), 0.06),
    _Layout(_long_x, 0.12),
    _Layout(_folding, 0.13),
    _Layout(_dead_cat, 0.12),
    _Layout(lambda rng: _in_two_rows(2, rng.uniform(0.75, 1.2)), 0.08, has_booms=True),
    _Layout(lambda rng: _in_two_rows(3, rng.uniform(0.55, 0.9)), 0.03, has_booms=True),
    _Layout(lambda rng: _in_two_rows(4, rng.uniform(0.45, 0.7)), 0.02, has_booms=True),
    _Layout(lambda _: _on_circle(6, np.pi / 6), 0.07),
    _Layout(lambda _: _on_circle(6, 0.0), 0.03),
    _Layout(lambda rng: _on_circle(3, float(rng.choice([0.0, np.pi / 3]))), 0.04, is_coaxial=True),
    _Layout(lambda _: _on_circle(4, np.pi / 4), 0.05, is_coaxial=True),
    _Layout(lambda rng: _on_circle(8, float(rng.choice([0.0, np.pi / 8]))), 0.05),
)


def _plates(c: Airframe, plan: Plan, rng: Generator) -> None:
    """Carbon plates on posts, the battery on top or between them."""
    half, wide, tall = plan.body
    gap, thin = tall * rng.uniform(0.8, 1.3), 0.012 * plan.reach
    for z in (0.0, -gap):
        c.loft([_rounded(half, wide, z - thin), _rounded(half, wide, z + thin)], [c.frame])
    for x, y in ((0.7, 0.6), (-0.7, 0.6), (-0.7, -0.6), (0.7, -0.6)):
        c.rod((x * half, y * wide, 0), (x * half, y * wide, -gap), 0.02 * plan.reach, [c.metal])
    z = -gap - 0.5 * tall if rng.random() < 0.6 else -0.5 * gap
    c.box((0, 0, z), (0.7 * half, 0.5 * wide, 0.4 * tall), c.body)
    c.box((0.85 * half, 0, -0.5 * gap), (0.12 * half, 0.4 * wide, 0.3 * tall), c.front)


def _crate(c: Airframe, plan: Plan, rng: Generator) -> None:
    half, wide, tall = plan.body
    c.box((0, 0, 0), (half, wide, 0.7 * tall), c.body)
    c.box((-0.1 * half, 0, -0.9 * tall), (0.7 * half, 0.75 * wide, 0.3 * tall), c.body * rng.uniform(0.6, 1.2))
    c.box((half, 0, 0), (0.08 * half, 0.6 * wide, 0.35 * tall), c.front)
    c.box((-half, 0, 0), (0.08 * half, 0.6 * wide, 0.35 * tall), c.rear)


def _sleek(c: Airframe, plan: Plan, rng: Generator) -> None:
    """A smooth shell, nose to tail, longer than others."""
    half, wide, tall = plan.body[0] * rng.uniform(1.1, 1.6), plan.body[1] * rng.uniform(0.6, 1.0), plan.body[2]
    nose, waist = rng.uniform(0.35, 0.9), rng.uniform(0.35, 0.9)
    right = [(half, 0.5 * nose * wide), (0.7 * half, nose * wide), (0.0, wide), (-0.7 * half, waist * wide),
             (-half, 0.4 * waist * wide)]  # fmt: skip
    rings = [outline(right, z * tall, s) for z, s in ((-1.0, 0.6), (-0.55, 0.94), (0.2, 1.0), (0.75, 0.75))]
    c.loft(rings, [c.body * 1.1, c.body, c.body * 0.8])
    c.box((0.95 * half, 0, -0.1 * tall), (0.06 * half, 0.3 * nose * wide, 0.25 * tall), np.full(3, 0.03))
    c.box((-0.95 * half, 0, -0.1 * tall), (0.06 * half, 0.3 * waist * wide, 0.25 * tall), c.rear)
    c.box((0.2 * half, 0, -1.02 * tall), (0.25 * half, 0.3 * wide, 0.05 * tall), c.front)


def _egg(c: Airframe, plan: Plan, rng: Generator) -> None:
    half, wide, tall = plan.body
    profile = [(0.35, -1.2), (0.75, -0.9), (1.0, -0.2), (0.9, 0.4), (0.5, 0.8)]
    c.loft([oval(r * half, r * wide, z * tall) for r, z in profile], [c.body, c.body, c.rear, c.frame])
    for side in (-1.0, 1.0):
        c.ball((0.85 * half, 0.3 * side * wide, -0.1 * tall), 0.16 * wide, c.front)


_BODIES = (_plates, _crate, _sleek, _egg)


def _rounded(half: float, wide: float, z: float) -> Array:
    right = [(half, 0.55 * wide), (0.75 * half, wide), (-0.75 * half, wide), (-half, 0.55 * wide)]
    return outline(right, z)


def _arms(c: Airframe, plan: Plan, rng: Generator) -> None:
    """One arm a motor, straight, level or rising, some bent at an elbow."""
    thick = plan.reach * float(rng.uniform(0.022, 0.055))
    is_round, bent = bool(rng.random() < 0.5), float(rng.choice([0.0, rng.uniform(0.1, 0.25)], p=[0.75, 0.25]))
    accents = int(rng.integers(1, 4))
    half, wide, _ = plan.body
    for x, y, z in plan.hubs:
        accent = c.front if x > 0.01 * plan.reach else c.rear
        colours = [*[c.frame] * accents, accent]
        root = (0.5 * half * x / plan.reach, 0.5 * wide * y / plan.reach, 0.4 * z)
        if bent:
            elbow = ((0.55 - bent) * x, (0.55 + bent) * y, z)
            c.rod(root, elbow, thick, [c.frame], 7)
            root, colours = elbow, [c.frame, accent]
        if is_round or abs(root[2] - z) > 0.5 * thick:
            c.rod(root, (x, y, z), thick, colours, 7)
        else:
            c.beam((root[0], root[1], z), (x, y, z), (thick, 0.7 * thick), colours)


def _booms(c: Airframe, plan: Plan, rng: Generator) -> None:
    """Two beams along, and cross beams to the body."""
    thick = plan.reach * float(rng.uniform(0.025, 0.05))
    front, rear, side = plan.hubs[:, 0].max(), plan.hubs[:, 0].min(), plan.hubs[:, 1].max()
    z = float(plan.hubs[0, 2])
    for y in (-side, side):
        c.rod((1.05 * rear, y, z), (1.05 * front, y, z), thick, [c.rear, c.frame, c.body, c.frame, c.front], 8)
    for x in np.linspace(0.55, -0.55, int(rng.integers(2, 4))) * plan.body[0]:
        c.rod((x, 0.4 * plan.body[1], 0), (x, side, z), 0.8 * thick, [c.frame], 7)
        c.rod((x, -0.4 * plan.body[1], 0), (x, -side, z), 0.8 * thick, [c.frame], 7)


def _rotors(c: Airframe, plan: Plan, rng: Generator) -> None:
    """A motor and a propeller on each arm, and under it where the layout is coaxial."""
    motor = (plan.radius * float(rng.uniform(0.11, 0.18)), plan.radius * float(rng.uniform(0.15, 0.32)))
    accent = bool(rng.random() < 0.5)
    for x, y, z in plan.hubs:
        c.rotor(x, y, z, plan.radius, motor, accent=accent)
    if plan.is_coaxial:
        for x, y, z in plan.hubs:
            hanging_rotor(c, (x, y, z), plan.radius, motor)


# What they carry besides body, arms and rotors.


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
        c.ring((x, y, z - 0.1 * radius), (1.07 * radius, 1.16 * radius), 0.24 * radius, accent, c.body)
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
    """Add up to three payloads."""
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
    c.rod((x + 0.8 * ball, 0, z), (x + 1.3 * ball, 0, z), 0.5 * ball, [BLACK], 8)


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
    c.box((-0.1 * half, 0, z), (0.08 * half, 0.47 * wide, 0.47 * tall), BLACK)


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
