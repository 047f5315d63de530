"""The view of a camera with any lens, sampled from pinhole views of the parts of its field of view."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from flockd.core.messages import BoolArray, Float32Array, FloatArray, IntArray
from flockd.flight.geometry import Camera, PinholeCamera, rotation_from_euler
from flockd.sim.renderer.renderer import View

_WIDEST = math.radians(75.0)
"""Widest angle of a pinhole view, either way: toward its border, pixels grow with the square of the cosine."""
_FINER = 1.3
"""Pixels a radian of a view's middle over the lens's, so that sampling loses nothing."""
_MARGIN_PX = 2
_KEPT = 32
"""Cameras whose views are kept, of 9 MB each at 640x480: those of five drones, each with a rig of its own."""
_COLUMNS = 256
"""OpenCV samples in rectangles, neither side of which is longer than 32767."""

Draw = Callable[[FloatArray, tuple[int, int], FloatArray], View]
"""Draws a pinhole view: its matrix (3, 3), its size and the turn (3, 3) from its axes to the lens's."""


def lens_view(camera: Camera, draw: Draw) -> View:
    """What the lens sees; black and infinitely far where it images nothing.

    Colours are interpolated; depth and ids are those of the nearest ray that was drawn.
    """
    if isinstance(camera, PinholeCamera) and not any(camera.distortion):
        return draw(camera.matrix, camera.size, np.eye(3))
    width, height = camera.size
    seen = View(
        rgb=np.zeros((height, width, 3), np.uint8),
        depth=np.full((height, width), np.inf, np.float32),
        ids=np.zeros((height, width), np.uint8),
    )
    for part in _parts(camera):
        view = draw(part.matrix, part.size, part.R_lens_part)
        drawn = cv2.remap(view.rgb, part.u, part.v, cv2.INTER_LINEAR).reshape(-1, 3)
        seen.rgb.reshape(-1, 3)[part.mine] = drawn[: len(part.mine)]
        seen.depth.ravel()[part.mine] = view.depth.ravel()[part.nearest] * part.z_share
        seen.ids.ravel()[part.mine] = view.ids.ravel()[part.nearest]
    return seen


@dataclass(frozen=True, eq=False)
class _Part:
    """A pinhole view, and the pixels of the lens that are taken from it."""

    matrix: FloatArray
    size: tuple[int, int]
    R_lens_part: FloatArray
    mine: IntArray
    """(n,) numbers of these pixels, row by row."""
    u: Float32Array
    v: Float32Array
    """(k, `_COLUMNS`) where each is in the view, as OpenCV counts, and then some again."""
    nearest: IntArray
    """(n,) the number of the view's nearest pixel."""
    z_share: Float32Array
    """(n,) z in the lens's axes over z in the view's."""


@lru_cache(_KEPT)
def _parts(camera: Camera) -> tuple[_Part, ...]:
    """Made once for each camera: two cameras are the same only if they are one object."""
    return tuple(_cut(camera))


def _cut(camera: Camera) -> list[_Part]:
    width, height = camera.size
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(height, width, 3)
    azimuth = np.arctan2(rays[..., 0], rays[..., 2])
    elevation = np.arcsin(np.clip(-rays[..., 1], -1.0, 1.0))
    (yaws, columns), (pitches, rows) = _sectors(azimuth), _sectors(elevation)
    parts = []
    for i, yaw in enumerate(yaws):
        for j, pitch in enumerate(pitches):
            mine = (columns == i) & (rows == j)
            if mine.any():
                parts.append(_part(camera.focal_px * _FINER, rays, mine, yaw, pitch))
    return parts


def _sectors(angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Middles of equal sectors of all angles (h, w), none wider than a view may be, and each angle's; -1 for NaN."""
    low, high = float(np.nanmin(angle)), float(np.nanmax(angle))
    count = max(1, math.ceil((high - low) / _WIDEST))
    span = (high - low) / count
    which = np.where(np.isnan(angle), -1, np.clip(np.floor((angle - low) / max(span, 1e-9)), 0, count - 1))
    return np.asarray(low + span * (np.arange(count) + 0.5), np.float64), np.asarray(which, np.float64)


def _part(focal_px: float, rays: FloatArray, mine: BoolArray, yaw: float, pitch: float) -> _Part:
    # Optical axes are right, down, forward: yaw turns about down, pitch about right.
    turn = rotation_from_euler(0.0, pitch, yaw)  # of a body, forward right down
    forward_right_down = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    R_lens_part = forward_right_down @ turn @ forward_right_down.T
    seen = rays @ R_lens_part
    with np.errstate(invalid="ignore", divide="ignore"):
        tangents = focal_px * seen[..., :2] / seen[..., 2:]
    low = np.floor(tangents[mine].min(axis=0)) - _MARGIN_PX
    high = np.ceil(tangents[mine].max(axis=0)) + _MARGIN_PX
    size = int(high[0] - low[0]), int(high[1] - low[1])
    matrix = np.array([[focal_px, 0.0, -low[0]], [0.0, focal_px, -low[1]], [0.0, 0.0, 1.0]])
    z = rays[mine, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(z > 0.0, z / seen[mine, 2], np.inf).astype(np.float32)
    u, v = ((tangents - low)[mine] - 0.5).astype(np.float32).T
    nearest = np.rint(v).astype(np.int64) * size[0] + np.rint(u).astype(np.int64)
    rows = -(-len(u) // _COLUMNS), _COLUMNS
    return _Part(
        matrix, size, R_lens_part, np.flatnonzero(mine), np.resize(u, rows), np.resize(v, rows), nearest, share
    )
