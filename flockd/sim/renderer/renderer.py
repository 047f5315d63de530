"""Camera images of a world with drones in it: colour, exact metric depth and instance ids, on the CPU.

Triangles become homogeneous edge functions (no clipping), the nearest one of each pixel is found, and only what is seen
is shaded. An image is drawn on the thread that asks for it; several may be drawn side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import BoolArray, Float32Array, FloatArray, IntArray, UInt8Array
from flockd.sim.renderer import _raster
from flockd.sim.renderer._raster import Eye, Scene, Thing
from flockd.sim.renderer.airframe import Solid, machine_texels
from flockd.sim.world.mesh import face_normals
from flockd.sim.world.textures import SIZE
from flockd.sim.world.world import GROUND, World

Indices = NDArray[np.int32]
Pair = tuple[FloatArray, FloatArray]
_CORNERS = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-0.4, 0.4)])


@dataclass(frozen=True, eq=False)
class View:
    """What one camera sees."""

    rgb: UInt8Array
    """(h, w, 3)"""
    depth: Float32Array
    """(h, w) metres along the optical axis at the pixel's centre; inf for sky."""
    ids: UInt8Array
    """(h, w) 0 for the world and sky, k for drone k - 1."""


class Renderer:
    """Draws one world and one flock from any camera. Holds no state that changes between images."""

    def __init__(self, world: World, drones: Sequence[Solid]) -> None:
        """``drones``: 254 at most, as their ids are bytes."""
        self._world = world
        self._drones = tuple(drones)
        self._machine = machine_texels()
        self._normals = [face_normals(one.vertices.astype(np.float64), one.triangles) for one in self._drones]
        # Tiles per metre are the same both ways on a drone.
        self._levels = [np.log2(SIZE * np.abs(one.uv[:, 0, :3]).sum(axis=1)) for one in self._drones]
        self._scene, self._grounds = scene_of(world), int((world.texture == GROUND).sum())
        # The middle of the linear values that show as each byte.
        codes = world.tone[: 1 + int(world.tone.argmax())].astype(np.float64)
        self._linear = np.interp(np.arange(256), codes, (np.arange(len(codes)) / 1024.0) ** 2)

    def render(
        self, matrix: FloatArray, size: tuple[int, int], R_ned_camera: FloatArray, position_ned: FloatArray, *,
        drone_rotations: FloatArray, drone_positions: FloatArray, shown: BoolArray | Sequence[int] | IntArray,
    ) -> View:  # fmt: skip
        """One image.

        ``matrix`` (3, 3) is the pinhole K for pixel centres at +0.5, ``size`` (width, height), ``R_ned_camera`` (3, 3)
        takes optical RDF axes to NED, ``position_ned`` (3,) m. ``drone_rotations`` (n, 3, 3) are R_ned_body and
        ``drone_positions`` (n, 3) NED m, one of each drone of the constructor. ``shown``: a mask (n,) or indices; the
        others are not seen, but every drone with a finite position casts its shadow.
        """
        world = self._world
        width, height = size
        count = len(self._drones)
        rotations = np.asarray(drone_rotations, dtype=np.float64).reshape(-1, 3, 3)
        positions = np.asarray(drone_positions, dtype=np.float64).reshape(-1, 3)
        K, R, origin = (np.ascontiguousarray(one, dtype=np.float64) for one in (matrix, R_ned_camera, position_ned))
        eye = Eye(K, np.asarray(np.linalg.inv(K)), R, origin, float(np.sqrt(K[0, 0] * K[1, 1])))
        P = np.ascontiguousarray(K @ R.T)

        blobs = self._shadows(positions, P, origin, width, height)
        planes, hit, depth = rasterized(world.vertices, world.triangles, P, origin, width, height)
        packed = np.empty((height, width), dtype=np.uint32)
        _raster.shade_scene(hit, planes, eye, self._scene, blobs, packed, depth)
        sharp = packed.view(np.uint8).reshape(height, width, 4)
        rgb = np.asarray(cv2.cvtColor(sharp, cv2.COLOR_RGBA2RGB), np.uint8)
        view = View(rgb, depth, ids=np.zeros((height, width), dtype=np.uint8))
        _raster.smooth_edges(hit, self._grounds, planes, self._linear, world.tone, sharp, view.rgb)
        chosen = np.arange(count)[np.asarray(shown)] if len(np.asarray(shown)) else np.arange(0)
        away_m = np.array([np.linalg.norm(positions[k] - origin) for k in chosen])
        for k in chosen[np.argsort(-away_m, kind="stable")]:
            self._draw(int(k), np.ascontiguousarray(rotations[k]), positions[k], eye, view)
        return view

    def _draw(self, k: int, rotation: FloatArray, position: FloatArray, eye: Eye, view: View) -> None:
        """Lay one drone over the view, supersampled within its bounding rectangle."""
        height, width = view.ids.shape
        model, normals = self._drones[k], self._normals[k] @ rotation.T
        vertices = np.ascontiguousarray(model.vertices.astype(np.float64) @ rotation.T + (position - eye.origin))
        P = eye.K @ eye.R.T
        left, top, right, bottom = _bounds(vertices @ P.T, width, height)
        if left >= right or top >= bottom:
            return
        s = _raster.SUBSAMPLES
        zoom = np.array([[s, 0.0, -s * left], [0.0, s, -s * top], [0.0, 0.0, 1.0]])
        wide, high = s * (right - left), s * (bottom - top)
        zoomed = np.ascontiguousarray(zoom @ P)
        planes, hit, inverse_depth = rasterized(vertices, model.triangles, zoomed, np.zeros(3), wide, high)
        uv = model.uv[:, :, :3] @ rotation.T
        uv = np.concatenate([uv, model.uv[:, :, 3:] - (uv @ position)[..., None]], axis=2).reshape(-1, 8)
        faces = np.column_stack([normals, model.colours, self._levels[k], model.texture, uv]).astype(np.float32)
        thing = Thing(k + 1, faces, self._machine)
        _raster.lay_over(
            hit, inverse_depth, planes, left, top, eye, thing, self._scene, self._linear, view.rgb, view.depth, view.ids
        )

    def _shadows(self, positions: FloatArray, P: FloatArray, origin: FloatArray, width: int, height: int) -> FloatArray:
        """(k, 9) discs that stand for the drones in the sun, and where in the image their shadows may be."""
        world = self._world
        sun = world.light[0]
        blobs, flying = [], np.flatnonzero(np.isfinite(positions).all(axis=1))
        grounds = -world.height_at(positions[flying, 0], positions[flying, 1])
        for k, ground in zip(flying, grounds, strict=True):
            # A quadrotor fills roughly half of the disc around it.
            position, radius = positions[k], 0.36 * self._drones[k].size_m
            foot = position - sun * (max(0.0, ground - position[2]) / -sun[2])
            reach = 2.0 * radius + 0.02 * (ground - position[2])
            spread = _CORNERS * reach / -sun[2]
            blobs.append((*position, radius, 0.6, *_bounds((foot + spread - origin) @ P.T, width, height)))
        return np.array(blobs, dtype=np.float64).reshape(-1, 9)


def scene_of(world: World) -> Scene:
    """What the compiled loops need of a world."""
    of_world = {name: getattr(world, name) for name in Scene._fields if name != "faces"}
    single = {name: np.float32(one) for name, one in of_world.items() if np.result_type(one) == np.float64}
    columns = world.normals, world.tint, world.level, world.texture, world.uv.reshape(-1, 8)
    return Scene(faces=np.column_stack(columns).astype(np.float32), **(of_world | single))


def rasterized(
    vertices: FloatArray, triangles: Indices, P: FloatArray, origin: FloatArray, width: int, height: int
) -> tuple[FloatArray, Indices, Float32Array]:
    """Planes (m, 12) of triangles, and of each pixel the nearest one, -1 for none, and 1/z of it, (h, w)."""
    rows, planes = np.empty((len(triangles), 2), dtype=np.int32), np.empty((len(triangles), 12))
    visible = np.empty(len(triangles), dtype=np.int32)
    count = _raster.set_up_triangles(vertices, triangles, P, origin, width, height, rows, planes, visible)
    hit, inverse_depth = np.empty((height, width), dtype=np.int32), np.empty((height, width), dtype=np.float32)
    _raster.fill(visible[:count], rows, planes, inverse_depth, hit)
    return planes, hit, inverse_depth


def _bounds(q: FloatArray, width: int, height: int) -> tuple[int, int, int, int]:
    """Left, top, right, bottom (exclusive) of homogeneous points, within the image; all of it when one is behind."""
    if (q[:, 2] <= 0).all():
        return 0, 0, 0, 0
    if (q[:, 2] <= 1e-3).any():
        return 0, 0, width, height
    pixels = q[:, :2] / q[:, 2:]
    low = np.clip(np.floor(pixels.min(0)), 0, (width, height)).astype(int)
    high = np.clip(np.ceil(pixels.max(0)) + 1, 0, (width, height)).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def true_flow(
    first: View, second: View, matrix: FloatArray, *, R_ned_camera: Pair, position_ned: Pair, drone_rotations: Pair,
    drone_positions: Pair,
) -> tuple[Float32Array, BoolArray]:  # fmt: skip
    """Where every pixel of the first image went in the second: flow (h, w, 2) in pixels, valid (h, w).

    Poses come in pairs (first, second), shaped as for ``Renderer.render``. Sky moves as a point at infinity. Valid: in
    front of the second camera, within its image, and seen there (same id, and a depth that agrees).
    """
    h, w = first.ids.shape
    K = np.asarray(matrix, dtype=np.float64)
    # From the first camera's axes to the second's, for the world (0) and for each drone (k + 1): p2 = A p1 + b.
    count = len(drone_positions[0])
    A = np.empty((count + 1, 3, 3))
    b = np.empty((count + 1, 3))
    (R1, R2), (p1, p2) = R_ned_camera, position_ned
    A[0], b[0] = R2.T @ R1, R2.T @ (p1 - p2)
    for k in range(count):
        turn = drone_rotations[1][k] @ drone_rotations[0][k].T
        A[k + 1] = R2.T @ turn @ R1
        b[k + 1] = R2.T @ (turn @ (p1 - drone_positions[0][k]) + drone_positions[1][k] - p2)
    H, t = (K @ A @ np.linalg.inv(K))[first.ids], (b @ K.T)[first.ids]
    v, u = np.mgrid[:h, :w] + 0.5
    sky = ~np.isfinite(first.depth)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        point = H[..., 0] * u[..., None] + H[..., 1] * v[..., None] + H[..., 2]
        point = np.where(sky[..., None], point, first.depth[..., None] * point + t)
        z = point[..., 2]
        u2, v2 = np.where(z > 1e-6, point[..., 0] / z, np.nan), np.where(z > 1e-6, point[..., 1] / z, np.nan)
        flow = np.nan_to_num(np.stack([u2 - u, v2 - v], axis=-1)).astype(np.float32)
        inside = (u2 >= 0.0) & (v2 >= 0.0) & (u2 < w) & (v2 < h)
        u2, v2 = np.where(inside, u2, 0.5), np.where(inside, v2, 0.5)
        i, j = u2.astype(int), v2.astype(int)
        there = second.depth[j, i]
        agrees = np.abs(there - z) < 0.01 * z
        # Steep planes change by more than that within a pixel; 1/z is linear in the image.
        i, j = np.clip(np.floor(u2 - 0.5), 0, w - 2).astype(int), np.clip(np.floor(v2 - 0.5), 0, h - 2).astype(int)
        a, b = u2 - 0.5 - i, v2 - 0.5 - j
        upper, lower = ((1.0 - a) / second.depth[row, i] + a / second.depth[row, i + 1] for row in (j, j + 1))
        agrees |= np.abs(((1.0 - b) * upper + b * lower) * z - 1.0) < 0.01
    same = inside & (second.ids[v2.astype(int), u2.astype(int)] == first.ids)
    return flow, same & np.where(sky, ~np.isfinite(there), agrees)
