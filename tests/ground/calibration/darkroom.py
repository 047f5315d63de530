"""Photographs of a board by lenses that are known exactly: each pixel's ray, traced.

Lenses are written down here a second time, from OpenCV's documentation, and inverted by search: nothing of the code
under test is used but the board's picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.messages import Float32Array, FloatArray, UInt8Array
from flockd.ground.calibration.board import BoardSpec

SPEC = BoardSpec()
_TEXTURE_PX = 96
"""A square's side in the board's picture."""
_PAPER, _INK, _WALL = 225.0, 30.0, 110.0


@dataclass(frozen=True)
class Lens:
    """Pixels with centres at +0.5."""

    model: Literal["pinhole", "wide_angle"]
    size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    k: tuple[float, ...]


PINHOLE = Lens("pinhole", (480, 360), 402.3, 405.1, 246.7, 175.2, (-0.21, 0.07, 0.0011, -0.0007, 0.0))
WIDE = Lens("wide_angle", (480, 360), 171.8, 171.2, 236.4, 183.9, (0.028, -0.011, 0.004, -0.0012))
"""160 degrees from left to right."""


@cache
def rays(lens: Lens, fine: int = 1) -> Float32Array:
    """(h fine, w fine, 3) float32: the direction that each part of a pixel looks in, its z 1 or its length 1."""
    width, height = lens.size
    u = (np.arange(width * fine) + 0.5) / fine
    v = (np.arange(height * fine) + 0.5) / fine
    x, y = np.meshgrid((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy)
    found = _pinhole_rays(x, y, lens.k) if lens.model == "pinhole" else _fisheye_rays(x, y, lens.k)
    return found.astype(np.float32)


def _pinhole_rays(x: FloatArray, y: FloatArray, k: Sequence[float]) -> FloatArray:
    k1, k2, p1, p2, k3 = k
    a, b = x.copy(), y.copy()
    for _ in range(14):  # fixed point: what the lens adds is small
        r2 = a * a + b * b
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        a, b = (
            (x - 2 * p1 * a * b - p2 * (r2 + 2 * a * a)) / radial,
            (y - p1 * (r2 + 2 * b * b) - 2 * p2 * a * b) / radial,
        )
    return np.stack([a, b, np.ones_like(a)], axis=-1)


def _fisheye_rays(x: FloatArray, y: FloatArray, k: Sequence[float]) -> FloatArray:
    angles = np.linspace(0.0, 2.2, 20001)
    radii = angles * (1 + k[0] * angles**2 + k[1] * angles**4 + k[2] * angles**6 + k[3] * angles**8)
    radius = np.hypot(x, y)
    theta = np.interp(radius, radii, angles)
    sideways = np.where(radius > 0, np.sin(theta) / np.maximum(radius, 1e-12), 1.0)
    return np.stack([x * sideways, y * sideways, np.cos(theta)], axis=-1)


@cache
def _texture(spec: BoardSpec) -> UInt8Array:
    """The board with a margin of half a square."""
    picture = spec.image(_TEXTURE_PX)
    edge = _TEXTURE_PX // 2
    return cv2.copyMakeBorder(picture, edge, edge, edge, edge, cv2.BORDER_CONSTANT, value=255)  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class Place:
    """The place of one frame in another: p_other = R p + t."""

    R: FloatArray
    t: FloatArray


def facing(position: Sequence[float], tilt_deg: float = 0.0, about_deg: float = 0.0, roll_deg: float = 0.0) -> Place:
    """A board whose middle is at ``position`` (3,) metres before a camera, square to its line of sight, then tilted.

    ``about_deg``: direction of the axis it is tilted about, within the board.
    """
    ahead = np.array(position) / np.linalg.norm(position)
    turn, _ = Rotation.align_vectors([ahead], [[0.0, 0.0, 1.0]])
    axis = np.array([np.cos(np.radians(about_deg)), np.sin(np.radians(about_deg)), 0.0])
    tilted = turn * Rotation.from_rotvec(np.radians(tilt_deg) * axis) * Rotation.from_euler("z", roll_deg, degrees=True)
    middle = np.array([SPEC.columns, SPEC.rows, 0.0]) * SPEC.square_m / 2
    R = tilted.as_matrix()
    return Place(R, np.array(position) - R @ middle)


def photograph(
    lens: Lens, board: Place, *, seed: int = 0, noise: float = 2.0, blur_px: float = 0.6, fine: int = 2
) -> UInt8Array:
    """(h, w, 3) RGB of the board at ``board`` in the camera, before a grey wall."""
    seen = rays(lens, fine)
    on_board = seen @ (board.R.astype(np.float32))  # rays in the board's axes
    origin = -board.R.T @ board.t
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.float32(-origin[2]) / on_board[..., 2]
        u = (np.float32(origin[0]) + reach * on_board[..., 0]) * np.float32(_TEXTURE_PX / SPEC.square_m)
        v = (np.float32(origin[1]) + reach * on_board[..., 1]) * np.float32(_TEXTURE_PX / SPEC.square_m)
    ahead = (reach > 0) & np.isfinite(reach)
    half = np.float32(_TEXTURE_PX / 2 - 0.5)
    u, v = np.where(ahead, u + half, -1e4), np.where(ahead, v + half, -1e4)
    inside = cv2.remap(_texture(SPEC), u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR, borderValue=-1)
    edge = cv2.remap(
        np.full_like(_texture(SPEC), 255), u.astype(np.float32), v.astype(np.float32), cv2.INTER_NEAREST, borderValue=0
    )
    light = np.where(edge > 0, _INK + (_PAPER - _INK) / 255.0 * inside.astype(np.float32), _WALL)
    width, height = lens.size
    light = light.reshape(height, fine, width, fine).mean(axis=(1, 3))
    return developed(light, seed=seed, noise=noise, blur_px=blur_px)


def developed(light: FloatArray | Float32Array, *, seed: int, noise: float, blur_px: float) -> UInt8Array:
    """Out of focus, with the sensor's noise, as RGB."""
    focused = cv2.GaussianBlur(light.astype(np.float32), (0, 0), blur_px) if blur_px > 0 else light
    noisy = np.asarray(focused) + np.random.default_rng(seed).normal(0.0, noise, light.shape)
    grey = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def sight(lens: Lens, count: int, seed: int = 0, tilt_deg: float = 35.0) -> list[Place]:
    """Boards all over the picture, tilted by up to ``tilt_deg``; 0 for boards whose plane is the picture's."""
    rng = np.random.default_rng(seed)
    far, reach = ((0.3, 0.55), 0.45) if lens.model == "pinhole" else ((0.13, 0.25), 1.4)
    places = []
    for _ in range(count):
        z = rng.uniform(*far)
        x, y = rng.uniform(-reach, reach) * z, rng.uniform(-0.75 * reach, 0.75 * reach) * z
        middle = np.array([x, y, z]) * z / np.linalg.norm([x, y, z])
        if tilt_deg == 0:
            half = np.array([SPEC.columns, SPEC.rows, 0.0]) * SPEC.square_m / 2
            places.append(Place(np.eye(3), np.array([0.5 * x, 0.5 * y, z]) - half))
            continue
        tilt, about, roll = rng.uniform(5.0, tilt_deg), rng.uniform(0.0, 360.0), rng.uniform(-40.0, 40.0)
        places.append(facing(middle.tolist(), tilt, about, roll))
    return places
