"""A drone's mesh from a file (glTF, STL, OBJ) as the renderer draws it.

Only glTF says its unit (metres) and which way is up (+y); of the others, the drone's known size says the unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.visual.color import uv_to_color
from trimesh.visual.material import PBRMaterial

from flockd.core.config.perception import MAX_DRONE_SIZE_M, MIN_DRONE_SIZE_M
from flockd.sim.renderer.airframe import MACHINE_TEXTURES, Airframe, DroneModel
from flockd.sim.world.mesh import Mesh, face_normals

Array = NDArray[Any]
GLTF = (".glb", ".gltf")
ENDINGS = (*GLTF, ".obj", ".stl")
OWN_FAMILY = 20_000
"""Number of the own drone's shape, beyond those of the simulator and of the generator."""
UNITS_M = {"m": 1.0, "in": 0.0254, "cm": 0.01, "mm": 0.001}
WIDTHS = (0.6, 1.05)
"""A mesh is as wide as this share of the drone's size from tip to tip: its propellers may stand across the arms, or be
missing."""
FLAT = 0.7
"""A mesh stands upright where no level side is less than this share of its height."""
MOST_TRIANGLES = 40_000
CELLS = (320, 160, 80)
"""A mesh of too many triangles is simplified to so many cells from tip to tip, in turn: at first a fifth of a
crop's pixel each."""
UP_AXES = ("x", "y", "z", "-x", "-y", "-z")


def read_meshes(paths: Sequence[Path], size_m: float, up: str | None = None) -> list[DroneModel]:
    """The drone in the files, body FRD (its heading is arbitrary), metres, unpainted where a file has no colours.

    Several files show the same drone from the same origin, as with other propellers. ``size_m``: its widest horizontal
    distance, propeller tip to tip. ``up``: one of ``UP_AXES``; by default +y of glTF and +z of others. Raises
    ValueError with one sentence that says what is wrong.
    """
    if not MIN_DRONE_SIZE_M <= size_m <= MAX_DRONE_SIZE_M:
        raise ValueError(f"--size-m {size_m:g}: a drone measures {MIN_DRONE_SIZE_M:g} to {MAX_DRONE_SIZE_M:g} m")
    surfaces = [_surface(path, size_m, up) for path in paths]
    corners = np.vstack([vertices for vertices, _, _ in surfaces])
    middle = (corners.min(0) + corners.max(0)) / 2
    return [_model_of(vertices - middle, triangles, colours, size_m) for vertices, triangles, colours in surfaces]


def _surface(path: Path, size_m: float, up: str | None) -> tuple[Array, Array, Array]:
    """Corners in metres, triangles, and their colours as of ``_colours``."""
    pieces = _loaded(path)
    is_gltf = path.suffix.lower() in GLTF
    parts = [(places, np.asarray(piece.faces), _colours(piece, is_gltf)) for piece, places in pieces]
    corners, faces, tints = zip(*parts, strict=True)
    firsts = np.cumsum([0, *(len(some) for some in corners[:-1])])
    vertices, colours = np.vstack(corners), np.vstack(tints)
    triangles = np.vstack([one + k for one, k in zip(faces, firsts, strict=True)])
    vertices = _upright(vertices, up or ("y" if is_gltf else "z"))
    vertices = _in_metres(path, vertices, size_m, {"m": 1.0} if is_gltf else UNITS_M)
    for cells in CELLS:
        if len(triangles) > MOST_TRIANGLES:
            vertices, triangles, kept = _in_cells(vertices, triangles, size_m / cells)
            colours = colours[kept]
    if len(triangles) > MOST_TRIANGLES:
        raise ValueError(
            f"{path}: has {len(triangles)} triangles without small details, and at most {MOST_TRIANGLES} are drawn; "
            "simplify it where it was modelled"
        )
    return vertices, triangles, colours


def painted(model: DroneModel, seed: int) -> DroneModel:
    """The same drone in another light and wear; what has no colour in its file gets one."""
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
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ValueError(f"{path}: a mesh is read from {', '.join(ENDINGS)}; export it as one of these")
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


def _upright(vertices: Array, up: str) -> Array:
    """Right-handed axes with ``up`` -> any level axes and z down."""
    if up not in UP_AXES:
        raise ValueError(f"--up {up}: is one of {', '.join(UP_AXES)}")
    axis, sign = "xyz".index(up[-1]), -1.0 if up.startswith("-") else 1.0
    down = -sign * vertices[:, axis]
    first, second = vertices[:, (axis + 1) % 3], vertices[:, (axis + 2) % 3]
    # (first, second, up) is right-handed; so is (second, first, down).
    return np.column_stack([second, first, down] if sign > 0 else [first, second, down])


def _in_metres(path: Path, vertices: Array, size_m: float, units: dict[str, float]) -> Array:
    """In the one unit in which it is about as wide as it should be."""
    low, high = vertices.min(0), vertices.max(0)
    across, along, tall = high - low
    width = _widest(vertices[:, :2])
    if not width > 0:
        raise ValueError(f"{path}: is a single point or line seen from above; export the whole drone")
    fits = [scale for scale in units.values() if WIDTHS[0] * size_m <= width * scale <= WIDTHS[1] * size_m]
    if not fits:
        would = ", ".join(f"{width * scale:.3g} m if its unit is {unit}" for unit, scale in units.items())
        raise ValueError(
            f"{path}: is {width:.4g} wide seen from above ({would}), and --size-m {size_m:g} m fits none; "
            "correct --size-m, --up, or the scale on export"
        )
    if min(across, along) < FLAT * tall:
        shape = " x ".join(f"{fits[0] * side:.2f}" for side in (across, along, tall))
        raise ValueError(f"{path}: would be {shape} m, the last upright, and a drone is wider than tall; correct --up")
    return vertices * fits[0]


def _widest(points: Array) -> float:
    """Largest distance between any two of (n, 2), to a thousandth."""
    angles = np.linspace(0, np.pi, 90, endpoint=False)
    along = points @ np.stack([np.cos(angles), np.sin(angles)])
    return float(np.ptp(along, axis=0).max())


def _in_cells(vertices: Array, triangles: Array, cell_m: float) -> tuple[Array, Array, Array]:
    """Corners of one cell become one; and the rows of the triangles that remain."""
    cells = np.round(vertices / cell_m).astype(np.int64)
    _, which, inverse = np.unique(cells @ [1 << 40, 1 << 20, 1], return_index=True, return_inverse=True)
    coarse = inverse[triangles]
    real = (coarse[:, 0] != coarse[:, 1]) & (coarse[:, 1] != coarse[:, 2]) & (coarse[:, 2] != coarse[:, 0])
    corners = np.sort(coarse, axis=1)
    _, first = np.unique((corners[:, 0] * len(which) + corners[:, 1]) * len(which) + corners[:, 2], return_index=True)
    kept = np.intersect1d(np.flatnonzero(real), first)
    return vertices[which], coarse[kept], kept


def _colours(piece: Any, is_gltf: bool) -> Array:
    """(m, 3) linear albedo of each triangle, NaN where the file says none.

    Of glTF, pictures are sRGB and all other colours linear (glTF 2.0, 3.7.2.1 and 3.9.2); of other files, all are sRGB.
    """
    visual, of_numbers = piece.visual, (lambda grey: grey) if is_gltf else _linear
    if visual.kind in ("vertex", "face"):
        return np.asarray(of_numbers(np.asarray(visual.face_colors, np.float64)[:, :3] / 255.0))
    nothing = np.full((len(piece.faces), 3), np.nan)
    if visual.kind != "texture":
        return nothing
    material = visual.material
    if isinstance(material, PBRMaterial):
        factor, image = material.baseColorFactor, material.baseColorTexture
    else:
        # Where it has a picture, without its Kd: many programs write one that is not meant to darken the picture. What
        # the reader puts in place of a material that is nowhere described has no "kd".
        image = material.image if material.image is not None and "file_path" in material.image.info else None
        factor = material.diffuse if "kd" in material.kwargs else None
    if image is not None and visual.uv is not None:
        middles = np.asarray(visual.uv, np.float64)[piece.faces].mean(axis=1)
        return np.asarray(_linear(uv_to_color(middles, image)[:, :3] / 255.0))
    if factor is None:
        return nothing
    return np.tile(of_numbers(np.asarray(factor, np.float64)[:3] / 255.0), (len(piece.faces), 1))


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
