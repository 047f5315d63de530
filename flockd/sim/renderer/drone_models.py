"""Quadrotor meshes: families of one shape and one size each, painted from a seed.

A family's size is its own, so an image shows the family and with it the size: the only scale that one image has.
"""

from __future__ import annotations

import math

import numpy as np

from flockd.sim.renderer.airframe import BLACK, Airframe, DroneModel, outline, oval


def drone_model(family: int, seed: int) -> DroneModel:
    """The mesh of a family (0 to ``FAMILIES`` - 1), colours and propeller angles from ``seed``."""
    craft = Airframe(np.random.default_rng([family, seed]))
    _BUILDERS[family](craft)
    return craft.model(family, seed)


def _thin_x(c: Airframe) -> None:
    """The common X on thin tubes: 450 mm between opposite motors."""
    for x, y, accent in c.corners(0.16, 0.16):
        c.rod((0.03 * np.sign(x), 0.03 * np.sign(y), 0), (x, y, 0), 0.009, [c.frame, accent, c.frame])
        c.rotor(x, y, -0.005, 0.12, (0.016, 0.03), accent=True)
    c.box((0, 0, 0), (0.06, 0.05, 0.006), c.frame)
    c.box((0, 0, -0.03), (0.055, 0.04, 0.02), c.body)
    c.box((0.045, 0, -0.03), (0.014, 0.042, 0.012), c.front)
    c.box((-0.01, 0, 0.03), (0.06, 0.022, 0.02), c.rear)
    c.rod((-0.02, 0, -0.05), (-0.02, 0, -0.11), 0.004, [c.frame])
    c.rod((-0.02, 0, -0.11), (-0.02, 0, -0.122), 0.022, [c.body], 8)
    for y in (-0.06, 0.06):
        c.beam((-0.07, y, 0.1), (0.07, y, 0.1), (0.005, 0.005), [c.frame])
        for x in (-0.04, 0.04):
            c.rod((x, y * 0.6, 0.005), (x, y, 0.1), 0.004, [c.frame])


def _thick_pod(c: Airframe) -> None:
    """A stout body on short arms, a camera pod under the nose."""
    c.box((0, 0, 0), (0.1, 0.06, 0.04), c.body)
    c.box((0, 0, -0.05), (0.075, 0.045, 0.014), c.body * 0.8)
    c.box((-0.085, 0, -0.005), (0.03, 0.045, 0.03), c.rear)
    c.box((0.085, 0, -0.015), (0.025, 0.05, 0.02), c.front)
    c.box((0.0, 0, -0.066), (0.03, 0.025, 0.004), c.front)
    c.rod((0.07, 0, 0.04), (0.07, 0, 0.06), 0.015, [c.metal], 8)
    c.box((0.075, 0, 0.085), (0.03, 0.028, 0.026), c.frame)
    c.rod((0.1, 0, 0.085), (0.125, 0, 0.085), 0.02, [c.metal, BLACK], 10)
    for x, y, accent in c.corners(0.115, 0.125):
        c.beam((0.5 * x, 0.4 * y, -0.01), (x, y, -0.01), (0.018, 0.014), [c.body, accent])
        c.rotor(x, y, -0.02, 0.1, (0.019, 0.026), accent=False)
        c.rod((x, y, 0.0), (x, y, 0.085), 0.009, [c.body, accent])


def _folding(c: Airframe) -> None:
    """A sleek camera drone: front arms swept forward and high, rear arms low."""
    c.box((0.0, 0, 0), (0.11, 0.038, 0.026), c.body)
    c.box((-0.015, 0, -0.032), (0.08, 0.032, 0.01), c.body * 1.1)
    c.box((-0.1, 0, -0.003), (0.02, 0.034, 0.02), c.rear)
    c.box((0.112, 0, -0.004), (0.012, 0.03, 0.016), np.full(3, 0.03))
    c.box((0.03, 0, -0.0435), (0.03, 0.012, 0.002), c.front)
    c.box((0.105, 0, 0.036), (0.022, 0.02, 0.016), c.frame)
    c.rod((0.125, 0, 0.036), (0.142, 0, 0.036), 0.011, [BLACK], 8)
    for x, y, accent in c.corners(1.0, 1.0):
        hub = (0.13, 0.15 * y, -0.02) if x > 0 else (-0.11, 0.135 * y, 0.004)
        z = hub[2] + 0.008
        c.beam((0.08 * x, 0.035 * y, z), (hub[0], hub[1], z), (0.012, 0.009), [c.body, c.body, accent])
        c.rotor(*hub, 0.105, (0.015, 0.022), accent=True)
        if x > 0:
            c.rod((0.125, 0.145 * y, -0.005), (0.125, 0.145 * y, 0.055), 0.007, [c.body, accent])


def _racer(c: Airframe) -> None:
    """A small racing frame: flat plates, a canopy, a tilted camera."""
    c.box((0, 0, 0), (0.055, 0.02, 0.0025), c.frame)
    c.box((0, 0, -0.024), (0.05, 0.018, 0.0015), c.frame)
    for x, y, accent in c.corners(0.04, 0.014):
        c.rod((x, y, 0), (x, y, -0.024), 0.003, [accent])
    c.box((-0.005, 0, -0.037), (0.036, 0.017, 0.012), c.body)
    c.box((0.05, 0, -0.014), (0.01, 0.01, 0.011), c.front)
    c.rod((0.06, 0, -0.015), (0.07, 0, -0.018), 0.008, [BLACK], 8)
    c.box((-0.005, 0, -0.0505), (0.012, 0.0175, 0.002), c.rear)
    c.rod((-0.05, 0, -0.02), (-0.08, 0, -0.055), 0.0035, [c.frame, c.rear])
    for x, y, accent in c.corners(0.066, 0.062):
        c.beam((0.2 * x, 0.2 * y, 0), (x, y, 0), (0.007, 0.003), [c.frame, c.frame, accent])
        c.rotor(x, y, -0.002, 0.0635, (0.0125, 0.018), accent=True)


def _h_frame(c: Airframe) -> None:
    """Two long booms joined by crossbars, payload slung between."""
    for y in (-0.2, 0.2):
        c.beam((-0.22, y, 0), (0.22, y, 0), (0.013, 0.013), [c.rear, c.frame, c.body, c.frame, c.front])
    for x in (-0.09, 0.09):
        c.beam((x, -0.2, 0.006), (x, 0.2, 0.006), (0.011, 0.008), [c.frame, c.body, c.frame])
    c.box((0, 0, -0.012), (0.12, 0.07, 0.008), c.frame)
    c.box((-0.02, 0, -0.045), (0.07, 0.045, 0.026), c.body)
    c.box((0.06, 0, -0.038), (0.016, 0.05, 0.018), c.front)
    c.box((-0.11, 0, -0.028), (0.02, 0.04, 0.012), c.rear)
    c.box((0.0, 0, 0.04), (0.085, 0.035, 0.03), c.body * 0.7)
    for x, y, accent in c.corners(0.21, 0.2):
        c.rotor(x, y, -0.012, 0.14, (0.02, 0.034), accent=True)
        c.rod((x * 0.6, y, 0), (x * 0.7, y, 0.13), 0.007, [c.frame, accent])


def _plus(c: Airframe) -> None:
    """Arms ahead, astern and abeam."""
    c.rod((0, 0, -0.035), (0, 0, 0.02), 0.075, [c.body], 12)
    c.rod((0, 0, -0.06), (0, 0, -0.035), 0.05, [c.body * 0.75], 12)
    c.box((0.06, 0, -0.02), (0.03, 0.022, 0.014), c.front)
    c.box((-0.07, 0, -0.01), (0.025, 0.03, 0.016), c.rear)
    c.box((0, 0, 0.042), (0.05, 0.03, 0.024), c.frame)
    for x, y, accent in ((0.26, 0.0, c.front), (0.0, 0.26, c.body), (-0.26, 0.0, c.rear), (0.0, -0.26, c.body)):
        c.beam((0.2 * x, 0.2 * y, 0), (x, y, 0), (0.011, 0.011), [c.frame, accent, c.frame, accent])
        c.rotor(x, y, -0.01, 0.13, (0.018, 0.03), accent=bool(x))
        c.rod((0.45 * x, 0.45 * y, 0.01), (0.55 * x, 0.55 * y, 0.12), 0.006, [c.frame])


def _ducted(c: Airframe) -> None:
    """Four ducts around a small body."""
    c.box((0, 0, -0.004), (0.075, 0.03, 0.018), c.body)
    c.box((0.0, 0, -0.03), (0.045, 0.024, 0.01), c.body * 0.8)
    c.box((0.075, 0, -0.004), (0.014, 0.018, 0.014), c.front)
    c.rod((0.085, 0, -0.004), (0.098, 0, -0.004), 0.009, [BLACK], 8)
    c.box((-0.075, 0, -0.004), (0.014, 0.024, 0.014), c.rear)
    for x, y, accent in c.corners(0.082, 0.085):
        c.ring((x, y, 0.0), (0.074, 0.08), 0.02, accent, c.body)
        c.rotor(x, y, 0.012, 0.068, (0.011, 0.02), accent=False)
        c.beam((x - 0.077, y, 0.014), (x + 0.077, y, 0.014), (0.004, 0.003), [c.frame])


def _long_legs(c: Airframe) -> None:
    """A big carbon plate frame on tall skids, with a gimballed camera."""
    c.box((0, 0, 0.012), (0.1, 0.09, 0.003), c.frame)
    c.box((0, 0, -0.02), (0.09, 0.08, 0.003), c.frame)
    for x, y, _ in c.corners(0.07, 0.06):
        c.rod((x, y, 0.012), (x, y, -0.02), 0.006, [c.metal])
    c.box((-0.01, 0, -0.05), (0.07, 0.045, 0.028), c.body)
    c.box((0.065, 0, -0.036), (0.014, 0.04, 0.012), c.front)
    c.box((-0.085, 0, -0.034), (0.014, 0.035, 0.012), c.rear)
    c.rod((-0.03, 0.0, -0.078), (-0.03, 0.0, -0.14), 0.005, [c.frame])
    c.rod((-0.03, 0.0, -0.14), (-0.03, 0.0, -0.155), 0.03, [c.front], 8)
    c.rod((0.06, 0, 0.012), (0.06, 0, 0.06), 0.012, [c.metal], 8)
    c.box((0.06, 0, 0.09), (0.035, 0.03, 0.032), c.body * 0.6)
    c.rod((0.09, 0, 0.09), (0.12, 0, 0.09), 0.022, [BLACK], 10)
    for x, y, accent in c.corners(0.21, 0.21):
        c.rod((0.25 * x, 0.25 * y, -0.004), (x, y, -0.004), 0.013, [c.frame, c.frame, accent, c.frame], 8)
        c.rotor(x, y, -0.015, 0.15, (0.024, 0.034), accent=True)
    for y in (-1.0, 1.0):
        c.rod((-0.16, 0.17 * y, 0.26), (0.16, 0.17 * y, 0.26), 0.009, [c.rear, c.frame, c.front])
        for x in (-0.05, 0.05):
            c.rod((x, 0.06 * y, 0.01), (1.4 * x, 0.17 * y, 0.26), 0.008, [c.frame, c.body])


def _bumper(c: Airframe) -> None:
    """A palm-sized toy: an egg of a body within two rails around all rotors."""
    egg = (
        (0.02, 0.015, -0.034),
        (0.042, 0.03, -0.024),
        (0.055, 0.036, -0.006),
        (0.045, 0.03, 0.01),
        (0.02, 0.014, 0.016),
    )
    c.loft([oval(*ring) for ring in egg], [c.body, c.body * 0.8, c.rear, c.frame])
    for y in (-0.014, 0.014):
        c.ball((0.047, y, -0.012), 0.0095, c.front)
    c.box((-0.05, 0, -0.006), (0.008, 0.012, 0.008), c.metal)
    around = [
        (sx * 0.06 + 0.049 * math.cos(turn), sy * 0.064 + 0.049 * math.sin(turn))
        for sx, sy, start in ((1, 1, 0), (-1, 1, 90), (-1, -1, 180), (1, -1, 270))
        for turn in np.radians([start, start + 45, start + 90])
    ]
    for i, ((ax, ay), (bx, by)) in enumerate(zip(around, around[1:] + around[:1], strict=True)):
        accent = c.front if ax + bx > 0 else c.rear
        for z in (-0.024, 0.0):
            c.rod((ax, ay, z), (bx, by, z), 0.0028, [accent], 4)
        if i % 3 != 1:
            c.rod((ax, ay, -0.024), (ax, ay, 0.0), 0.0022, [c.frame], 4)
    for x, y, _ in c.corners(0.06, 0.064):
        c.beam((0.3 * x, 0.3 * y, 0.002), (1.57 * x, 1.57 * y, 0.002), (0.004, 0.0025), [c.frame])
        c.rotor(x, y, 0.0, 0.0423, (0.007, 0.016), accent=False)


def _dome(c: Airframe) -> None:
    """A light-show drone: a domed body with a lamp under it, on stilts."""
    dome = (0.02, -0.088), (0.05, -0.078), (0.072, -0.055), (0.08, -0.02), (0.08, 0.004), (0.055, 0.018)
    c.loft([oval(r, r, z) for r, z in dome], [c.body, c.body, c.body * 0.8, c.rear, c.frame])
    c.ball((0, 0, 0.03), 0.04, c.front)
    c.rod((0, 0, -0.085), (0, 0, -0.115), 0.005, [c.metal])
    c.box((0.078, 0, -0.02), (0.008, 0.024, 0.012), c.front)
    for x, y, accent in c.corners(0.1025, 0.1025):
        c.rod((0.4 * x, 0.4 * y, -0.008), (x, y, -0.008), 0.012, [c.frame, accent], 8)
        c.rotor(x, y, -0.014, 0.1, (0.014, 0.024), accent=True)
        c.rod((0.4 * x, 0.4 * y, 0.01), (0.62 * x, 0.62 * y, 0.11), 0.0045, [c.frame, accent])


def _dead_cat(c: Airframe) -> None:
    """Two long narrow decks, the front arms bent wide and back to clear the camera's view."""
    deck = [(0.2, 0.025), (0.1, 0.045), (-0.14, 0.032), (-0.17, 0.02)]
    c.loft([outline(deck, 0.0), outline(deck, 0.005)], [c.frame])
    c.loft([outline(deck, -0.036, 0.92), outline(deck, -0.032, 0.92)], [c.body])
    for x, y, _ in c.corners(0.12, 0.028):
        c.rod((x, y, 0), (x, y, -0.033), 0.005, [c.metal])
    c.box((-0.06, 0, -0.056), (0.075, 0.024, 0.02), c.rear)
    c.box((0.02, 0, -0.018), (0.06, 0.02, 0.012), c.body * 0.7)
    c.box((0.185, 0, -0.018), (0.012, 0.022, 0.013), c.front)
    c.rod((0.2, 0, -0.014), (0.222, 0, -0.014), 0.012, [c.frame, BLACK], 8)
    for y in (-1.0, 1.0):
        c.rod((-0.15, 0.015 * y, -0.034), (-0.2, 0.06 * y, -0.12), 0.004, [c.frame, c.rear])
        c.beam((0.03, 0.03 * y, 0.01), (0.02, 0.14 * y, 0.01), (0.012, 0.006), [c.frame])
        c.beam((0.02, 0.135 * y, 0.01), (0.115, 0.235 * y, 0.01), (0.011, 0.006), [c.frame, c.front])
        c.beam((-0.1, 0.02 * y, 0.01), (-0.17, 0.16 * y, 0.01), (0.011, 0.006), [c.frame, c.rear])
        c.box((0.02, 0.138 * y, 0.04), (0.006, 0.004, 0.03), c.frame)
        c.box((-0.13, 0.08 * y, 0.04), (0.006, 0.004, 0.03), c.frame)
    for x, y in ((0.115, 0.235), (-0.17, 0.16), (-0.17, -0.16), (0.115, -0.235)):
        c.rotor(x, y, 0.004, 0.1215, (0.0165, 0.026), accent=True)


def _courier(c: Airframe) -> None:
    """A delivery van of a drone: a big box of a body, a parcel hung under it."""
    side = [(0.16, 0.085), (-0.16, 0.085)]
    shell = [outline(side, z, scale) for z, scale in ((-0.1, 0.75), (-0.07, 1.0), (0.01, 1.0), (0.03, 0.85))]
    c.loft(shell, [c.body * 0.85, c.body, c.frame])
    c.box((0.16, 0, -0.035), (0.006, 0.06, 0.022), c.front)
    c.box((-0.16, 0, -0.035), (0.006, 0.06, 0.022), c.rear)
    for y in (-0.085, 0.085):
        c.box((0.0, y, -0.03), (0.09, 0.002, 0.018), c.front)
    c.rod((-0.08, 0, -0.1), (-0.08, 0, -0.118), 0.03, [c.metal], 10)
    card = np.array([0.33, 0.21, 0.11]) * c.rng.uniform(0.6, 1.5)
    c.box((0, 0, 0.115), (0.1, 0.08, 0.06), card)
    c.box((0, 0, 0.115), (0.1015, 0.014, 0.0615), np.full(3, 0.5))
    for x, y, _ in c.corners(0.06, 0.05):
        c.rod((x, y, 0.02), (x, y, 0.058), 0.004, [c.frame])
    for x, y, accent in c.corners(0.235, 0.161):
        c.beam((0.5 * x, 0.42 * y, -0.06), (x, y, -0.06), (0.015, 0.013), [c.body, c.frame, accent])
        c.rotor(x, y, -0.072, 0.12515, (0.02, 0.034), accent=False)
        c.rod((0.75 * x, 0.75 * y, -0.055), (0.75 * x, 0.95 * y, 0.2), 0.007, [c.frame, accent])
    for y in (-0.153, 0.153):
        c.rod((-0.21, y, 0.2), (0.21, y, 0.2), 0.008, [c.rear, c.frame, c.front])


def _dragonfly(c: Airframe) -> None:
    """A slender body with a tail and two big eyes, short arms ahead and long ones astern."""
    half = [(0.11, 0.01), (0.09, 0.027), (0.02, 0.024), (-0.06, 0.012), (-0.17, 0.006)]
    shell = [outline(half, z, scale) for z, scale in ((-0.026, 0.6), (-0.014, 1.0), (0.008, 1.0), (0.018, 0.7))]
    c.loft(shell, [c.body, c.body * 0.8, c.frame])
    for y in (-0.02, 0.02):
        c.ball((0.098, y, -0.002), 0.017, c.front)
    c.ball((-0.168, 0, -0.003), 0.014, c.rear)
    c.box((0.02, 0, -0.03), (0.03, 0.011, 0.006), c.metal)
    for y in (-1.0, 1.0):
        c.beam((0.06, 0.015 * y, -0.012), (0.085, 0.085 * y, -0.012), (0.007, 0.004), [c.body, c.front])
        c.beam((0.01, 0.015 * y, 0.006), (-0.12, 0.11 * y, 0.006), (0.006, 0.004), [c.body, c.frame, c.rear])
        c.rod((-0.12, 0.11 * y, 0.006), (-0.12, 0.11 * y, 0.04), 0.004, [c.rear])
        c.rod((0.07, 0.018 * y, 0.0), (0.085, 0.03 * y, 0.04), 0.004, [c.frame])
    for x, y, z in ((0.085, 0.085, -0.014), (-0.12, 0.11, 0.004), (-0.12, -0.11, 0.004), (0.085, -0.085, -0.014)):
        c.rotor(x, y, z, 0.0636, (0.0105, 0.018), accent=True)


def _wide_nose(c: Airframe) -> None:
    """A manta of a camera drone: wide ahead, a finned tail, a ball of a camera in a fork under the nose."""
    half = [(0.155, 0.05), (0.125, 0.112), (0.05, 0.118), (-0.16, 0.03)]
    shell = [outline(half, z, scale) for z, scale in ((-0.052, 0.65), (-0.032, 0.97), (0.004, 1.0), (0.022, 0.8))]
    c.loft(shell, [c.body, c.body, c.body * 0.7])
    c.box((0.146, 0, -0.012), (0.008, 0.045, 0.01), c.front)
    c.box((-0.13, 0, -0.07), (0.034, 0.0045, 0.042), c.rear)
    c.box((-0.01, 0, -0.055), (0.05, 0.03, 0.008), c.frame)
    for y in (-0.05, 0.05):
        c.rod((0.09, y, 0.01), (0.09, y, 0.08), 0.006, [c.metal])
    c.rod((0.09, -0.05, 0.078), (0.09, 0.05, 0.078), 0.006, [c.metal])
    c.ball((0.09, 0, 0.078), 0.04, c.frame)
    c.rod((0.12, 0, 0.078), (0.136, 0, 0.078), 0.019, [BLACK], 10)
    for y in (-1.0, 1.0):
        c.beam((0.09, 0.09 * y, -0.012), (0.125, 0.185 * y, -0.012), (0.016, 0.009), [c.body, c.front])
        c.rod((-0.1, 0.02 * y, -0.01), (-0.165, 0.14 * y, -0.004), 0.01, [c.frame, c.body, c.rear], 8)
        c.rod((-0.03, 0.06 * y, 0.01), (-0.05, 0.1 * y, 0.13), 0.006, [c.frame, c.rear])
        c.rod((-0.13, 0.105 * y, 0.13), (0.06, 0.095 * y, 0.13), 0.0065, [c.frame])
    for x, y in ((0.125, 0.185), (-0.165, 0.14), (-0.165, -0.14), (0.125, -0.185)):
        c.rotor(x, y, -0.012, 0.1122, (0.017, 0.028), accent=x > 0)


_BUILDERS = (
    _thin_x, _thick_pod, _folding, _racer, _h_frame, _plus, _ducted, _long_legs,
    _bumper, _dome, _dead_cat, _courier, _dragonfly, _wide_nose,
)  # fmt: skip
FAMILIES: int = len(_BUILDERS)
"""How many shapes there are."""
