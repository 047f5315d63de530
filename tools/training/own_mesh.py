"""A drone's mesh from a glTF file (metres, y up, with colours), for the renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.visual.color import uv_to_color

from flockd.core.config.perception import MAX_DRONE_SIZE_M, MIN_DRONE_SIZE_M
from flockd.sim.renderer.airframe import MACHINE_TEXTURES, Airframe, DroneModel
from flockd.sim.world.mesh import Mesh, face_normals

Array = NDArray[Any]
GLTF = (".glb", ".gltf")
OWN_FAMILY = 20_000
"""Number of the own drone's shape, beyond those of the simulator and of the generator."""
WIDTHS = (0.6, 1.05)
"""A mesh is as wide as this share of the drone's size from tip to tip: its propellers may stand across the arms, or be
missing."""
FLAT = 0.7
"""A mesh stands upright where no level side is less than this share of its height."""
MOST_TRIANGLES = 40_000


def read_meshes(paths: Sequence[Path], size_m: float) -> list[DroneModel]:
    """The drone in the files, body FRD (its heading is arbitrary), metres, unpainted where a file has no colours.

    Several files show the same drone from the same origin, as with other propellers. ``size_m``: its widest horizontal
    distance, propeller tip to tip. Raises ValueError with one sentence that says what is wrong.
    """
    if not MIN_DRONE_SIZE_M <= size_m <= MAX_DRONE_SIZE_M:
        raise ValueError(f"--size-m {size_m:g}: a drone measures {MIN_DRONE_SIZE_M:g} to {MAX_DRONE_SIZE_M:g} m")
    surfaces = [_surface(path, size_m) for path in paths]
    corners = np.vstack([vertices for vertices, _, _ in surfaces])
    middle = (corners.min(0) + corners.max(0)) / 2
    return [_model_of(vertices - middle, triangles, colours, size_m) for vertices, triangles, colours in surfaces]


def _surface(path: Path, size_m: float) -> tuple[Array, Array, Array]:
    """Corners in metres, triangles, and their colours as of ``_colours``."""
    parts = [(places, np.asarray(piece.faces), _colours(piece)) for piece, places in _loaded(path)]
    corners, faces, tints = zip(*parts, strict=True)
    firsts = np.cumsum([0, *(len(some) for some in corners[:-1])])
    vertices, colours = np.vstack(corners), np.vstack(tints)
    triangles = np.vstack([one + k for one, k in zip(faces, firsts, strict=True)])
    vertices = vertices[:, [0, 2, 1]] * (1.0, 1.0, -1.0)  # right-handed, y up -> right-handed, z down
    _check_size(path, vertices, size_m)
    if len(triangles) > MOST_TRIANGLES:
        raise ValueError(
            f"{path}: has {len(triangles)} triangles, and at most {MOST_TRIANGLES} are drawn; simplify it where it was "
            "modelled, as with Blender's Decimate"
        )
    return vertices, triangles, colours


def painted(model: DroneModel, seed: int) -> DroneModel:
    """The same drone in another light; parts without a colour get a random one."""
    rng = np.random.default_rng([model.family, seed])
    colours = model.colours * np.exp(rng.normal(0, 0.15)) * np.exp(rng.normal(0, 0.04, 3))
    plain = np.isnan(model.colours).any(axis=1)
    if plain.any():
        craft = Airframe(rng)
        colours[plain] = craft.body if rng.random() < 0.5 else craft.frame
    texture = np.full(len(model.triangles), int(rng.integers(MACHINE_TEXTURES)), np.int32)
    return replace(model, seed=seed, colours=np.clip(colours, 0.01, 0.9).astype(np.float32), texture=texture)


def _loaded(path: Path) -> list[tuple[Any, Array]]:
    """All meshes that the file shows, and their corners (n, 3) in the same axes."""
    if path.suffix.lower() not in GLTF:
        raise ValueError(f"{path}: a mesh is read from {' or '.join(GLTF)}; export it as glTF, as Blender does")
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file")
    try:
        scene: Any = trimesh.load_scene(path, process=False)
        # Scene.dump would lose the colours of corners that have a material as well.
        placed = [(scene.geometry[name], turn) for turn, name in map(scene.graph.get, scene.graph.nodes_geometry)]
        pieces = [
            (piece, np.asarray(trimesh.transform_points(piece.vertices, turn), np.float64))
            for piece, turn in placed
            if len(getattr(piece, "faces", ()))
        ]
    except Exception as error:  # noqa: BLE001 - whatever a parser of foreign files raises, the file is at fault
        raise ValueError(f"{path}: is no mesh that can be read ({str(error) or type(error).__name__})") from None
    if not pieces:
        raise ValueError(f"{path}: holds no triangles; export the drone's surface as a mesh")
    if not all(np.isfinite(places).all() for _, places in pieces):
        raise ValueError(f"{path}: has places that are no numbers; export it again")
    return pieces


def _check_size(path: Path, vertices: Array, size_m: float) -> None:
    """Raises ValueError where it is not about as wide as it should be, or stands upright."""
    across, along, tall = np.ptp(vertices, axis=0)
    width = _widest(vertices[:, :2])
    if not WIDTHS[0] * size_m <= width <= WIDTHS[1] * size_m:
        raise ValueError(
            f"{path}: is {width:.4g} m wide seen from above, and --size-m {size_m:g} m does not fit; correct --size-m, "
            "or the scale on export"
        )
    if min(across, along) < FLAT * tall:
        shape = " x ".join(f"{side:.2f}" for side in (across, along, tall))
        raise ValueError(f"{path}: is {shape} m, the last upright, and a drone is wider than tall; export it with y up")


def _widest(points: Array) -> float:
    """Largest distance between any two of (n, 2), to a thousandth."""
    angles = np.linspace(0, np.pi, 90, endpoint=False)
    along = points @ np.stack([np.cos(angles), np.sin(angles)])
    return float(np.ptp(along, axis=0).max())


def _colours(piece: Any) -> Array:
    """(m, 3) linear albedo of each triangle, NaN where the file says none.

    Pictures are sRGB and all other colours linear (glTF 2.0, 3.7.2.1 and 3.9.2).
    """
    visual = piece.visual
    if visual.kind in ("vertex", "face"):
        return np.asarray(visual.face_colors, np.float64)[:, :3] / 255.0
    nothing = np.full((len(piece.faces), 3), np.nan)
    if visual.kind != "texture":
        return nothing
    factor, image = visual.material.baseColorFactor, visual.material.baseColorTexture
    if image is not None and visual.uv is not None:
        middles = np.asarray(visual.uv, np.float64)[piece.faces].mean(axis=1)
        return np.asarray(_linear(uv_to_color(middles, image)[:, :3] / 255.0))
    return nothing if factor is None else np.tile(np.asarray(factor, np.float64)[:3] / 255.0, (len(piece.faces), 1))


def _linear(grey: Array) -> Array:
    """IEC 61966-2-1: sRGB, 0 to 1 -> linear."""
    return np.where(grey <= 0.04045, grey / 12.92, ((grey + 0.055) / 1.055) ** 2.4)


def _model_of(vertices: Array, triangles: Array, colours: Array, size_m: float) -> DroneModel:
    """A drone of corners (n, 3) in body FRD, triangles (m, 3) and their linear colours (m, 3).

    Each triangle is seen from both sides: in files of many programs, some face the wrong way. Those without an area
    are left out.
    """
    has_area = np.linalg.norm(face_normals(vertices, triangles), axis=1) > 0.5
    triangles, colours = triangles[has_area], colours[has_area]
    mesh, both = Mesh(), np.vstack([triangles, triangles[:, ::-1]])
    mesh.add(vertices, both, 0, np.vstack([colours, colours]), (0.3, 0.3))
    return DroneModel(
        family=OWN_FAMILY,
        seed=0,
        vertices=vertices.astype(np.float32),
        triangles=both.astype(np.int32),
        colours=np.concatenate(mesh.tint).astype(np.float32),
        texture=np.concatenate(mesh.texture).astype(np.int32),
        uv=np.concatenate(mesh.uv),
        hubs=np.full((4, 3), np.nan),
        extent=np.stack([vertices.min(0), vertices.max(0)]),
        size_m=size_m,
    )
