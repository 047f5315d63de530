"""What each cut-out shows: which drone, from where, in what light, how exposed; from a seed alone. Pure numpy.

A scene is one drone in one light, seen `VIEWS` times. World axes are NED, the drone's FRD, metres and radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from tools.training.cutouts import shells
from tools.training.cutouts.sources import HELD_OUT, TRAINING

KINDS = {"real": 0.4, "shell": 0.35, "generated": 0.25}
VIEWS = 6
SIZE_PX = 320
RANGES_M = (1.2, 12.0)
FILLS = (0.75, 0.95)
_LEAN, _MOST_LEAN = math.radians(9.0), math.radians(25.0)
_LOW = math.radians(50.0)
"""Four views of five are within this elevation."""
LIGHTS = {"sun": 0.38, "overcast": 0.27, "against the sun": 0.2, "indoors": 0.15}
PROPELLERS = {"blades": 0.3, "disc": 0.3, "smeared": 0.25, "standing": 0.15}
GROUNDS = {
    "grass": (0.06, 0.11, 0.025),
    "dry grass": (0.25, 0.2, 0.1),
    "sand": (0.45, 0.36, 0.22),
    "asphalt": (0.08, 0.08, 0.085),
    "concrete": (0.35, 0.34, 0.32),
    "snow": (0.8, 0.82, 0.85),
    "earth": (0.15, 0.1, 0.06),
}
"""Linear albedo."""
_GROUND_SHARES = (0.3, 0.14, 0.14, 0.13, 0.16, 0.03, 0.1)


@dataclass(frozen=True)
class Light:
    """What lights a scene."""

    kind: str
    """One of `LIGHTS`."""
    sun_elevation: float
    haze: float
    ground: tuple[float, float, float]
    """Linear albedo."""
    height_m: float
    """Of the drone above the ground."""
    balance: float
    """Share of the light's colour that the camera takes out."""


@dataclass(frozen=True)
class View:
    """One picture."""

    azimuth: float
    """Of the camera from the drone; the sun's is 0."""
    elevation: float
    roll: float
    """The camera's."""
    drone_roll_pitch_yaw: tuple[float, float, float]
    range_m: float
    fill: float
    """Share of the picture that the drone's width or height takes."""
    exposure: float
    """What a surface of albedo 1 in the scene's mean light shows, linear."""
    propellers: str
    """One of `PROPELLERS`."""
    blur_alpha: float
    blur_width: float
    """How far a blade turns while the shutter is open, rad."""
    seed: int


@dataclass(frozen=True)
class Scene:
    """One drone in one light."""

    number: int
    seed: int
    kind: str
    """One of `KINDS`."""
    name: str
    """Of the airframe or shell; empty for a generated one."""
    light: Light
    views: tuple[View, ...]


def scene(seed: int, number: int, held_out: bool = False) -> Scene:
    """Scene ``number``; of the airframes that are held out, in turn, or else of those for training."""
    rng = np.random.Generator(np.random.PCG64([seed, number, int(held_out)]))
    kind = _drawn(rng, KINDS)
    name = ""
    if held_out:
        kind, name = "real", HELD_OUT[number % len(HELD_OUT)]
    elif kind == "real":
        name = TRAINING[int(rng.integers(len(TRAINING)))]
    elif kind == "shell":
        name = _drawn(rng, shells.SHARES)
    light = _light(rng)
    views = tuple(_view(rng, light) for _ in range(VIEWS))
    return Scene(number, int(rng.integers(1 << 31)), kind, name, light, views)


def _drawn(rng: Generator, shares: dict[str, float]) -> str:
    return str(rng.choice(list(shares), p=list(shares.values())))


def _light(rng: Generator) -> Light:
    kind = _drawn(rng, LIGHTS)
    low, high = (3.0, 40.0) if kind == "against the sun" else (5.0, 70.0)
    ground = np.array(GROUNDS[str(rng.choice(list(GROUNDS), p=_GROUND_SHARES))]) * rng.uniform(0.7, 1.3, 3)
    return Light(
        kind,
        math.radians(float(rng.uniform(low, high))),
        float(rng.uniform(0.3, 3.0)),
        (float(ground[0]), float(ground[1]), float(ground[2])),
        float(np.exp(rng.uniform(math.log(0.8), math.log(25.0)))),
        float(rng.uniform(0.4, 0.95)),
    )


def _view(rng: Generator, light: Light) -> View:
    azimuth = float(rng.uniform(-math.pi, math.pi))
    if light.kind == "against the sun":
        azimuth = math.pi + float(rng.normal(0.0, 0.5))
    is_low = rng.random() < 0.8
    elevation = float(rng.uniform(-_LOW, _LOW)) if is_low else math.asin(float(rng.uniform(-1.0, 1.0)))
    # A drone against the sky is dark where the camera exposes for the sky.
    dark = 0.5 if light.kind == "against the sun" else 0.35 if elevation < math.radians(-10.0) else 0.1
    glaring = 0.05 if light.kind == "against the sun" else 0.2
    how = rng.random()
    if how < dark:
        exposure = rng.uniform(0.06, 0.35)
    elif how < dark + glaring:
        exposure = rng.uniform(1.3, 3.0)
    else:
        exposure = np.exp(rng.normal(math.log(0.75), 0.3))
    propellers = _drawn(rng, PROPELLERS)
    width = float(rng.uniform(0.2, 1.3)) if propellers == "smeared" else 2 * math.pi
    # The wider a blade is smeared, the less of it is seen.
    alpha = float(np.clip(0.16 / width * rng.uniform(0.7, 1.4), 0.1, 0.7))
    if propellers == "disc":
        alpha = float(rng.uniform(0.05, 0.35))
    return View(
        azimuth,
        elevation,
        _lean(rng),
        (_lean(rng), _lean(rng), float(rng.uniform(-math.pi, math.pi))),
        float(np.exp(rng.uniform(*np.log(RANGES_M)))),
        float(rng.uniform(*FILLS)),
        float(exposure),
        propellers,
        alpha,
        width,
        int(rng.integers(1 << 31)),
    )


def _lean(rng: Generator) -> float:
    return float(np.clip(rng.normal(0.0, _LEAN), -_MOST_LEAN, _MOST_LEAN))
