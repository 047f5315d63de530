"""Real airframes, put together from the meshes of public repositories: where each is, its licence, its propellers.

Read by Blender's Python, beside which trimesh and pycollada are installed. Meshes are no part of flockd.
"""

from __future__ import annotations

import io
import math
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from tools.measure.cycles.plan import rotation
from tools.measure.cycles.sources import AIRFRAMES, Assembly, Part, Source

Array = NDArray[Any]
_GREY, _BLACK = (0.12, 0.12, 0.12), (0.02, 0.02, 0.02)
_MOST_TRIANGLES = 100_000


@dataclass(frozen=True, eq=False)
class Rotor:
    """A propeller's disc."""

    hub: Array
    """(3,) body FRD, metres."""
    radius_m: float


@dataclass(frozen=True, eq=False)
class Airframe:
    """A drone without its propellers, body FRD, metres, its origin in the middle of its box with them."""

    vertices: Array
    """(n, 3)"""
    triangles: Array
    """(m, 3)"""
    colours: Array
    """(m, 3) linear albedo."""
    rotors: tuple[Rotor, ...]

    @property
    def size_m(self) -> float:
        """Widest horizontal distance, propeller tip to tip."""
        tips = [
            rotor.hub[:2] + rotor.radius_m * np.array([math.cos(a), math.sin(a)])
            for rotor in self.rotors
            for a in np.linspace(0.0, 2.0 * math.pi, 32)
        ]
        points = np.vstack([self.vertices[:, :2], tips])
        angles = np.linspace(0.0, math.pi, 90, endpoint=False)
        return float(np.ptp(points @ np.stack([np.cos(angles), np.sin(angles)]), axis=0).max())

    @property
    def between_motors_m(self) -> float:
        """Largest distance of two motors: what makers call the wheelbase."""
        hubs = np.array([rotor.hub for rotor in self.rotors])
        return float(np.linalg.norm(hubs[:, None] - hubs[None], axis=2).max())


def airframe(folder: Path, name: str, sources: Mapping[str, Source] = AIRFRAMES) -> Airframe:
    """The airframe of a name in ``sources``. Raises ValueError where its files are missing or it is not of its size."""
    source = sources[name]
    try:
        made = _assembled(folder, source) if isinstance(source.made_of, Assembly) else _of_sdf(folder, source.made_of)
    except OSError as error:
        raise ValueError(
            f"{error.filename or folder}: is missing; {name} needs a copy of {source.repository} under {folder} "
            f"(see `python -m tools.measure.cycles_card --help`)"
        ) from None
    published = source.between_motors_m
    if published is not None and abs(made.between_motors_m / published - 1.0) > 0.05:
        raise ValueError(
            f"{name}: its motors are {made.between_motors_m:.3f} m apart, and its maker says {published} m"
        )
    return made


def save_airframe(shape: Airframe, path: Path) -> None:
    """As arrays, for who has no reader of meshes."""
    np.savez(
        path,
        vertices=shape.vertices,
        triangles=shape.triangles,
        colours=shape.colours,
        hubs=np.array([rotor.hub for rotor in shape.rotors]),
        radii=np.array([rotor.radius_m for rotor in shape.rotors]),
        size_m=shape.size_m,
        between_motors_m=shape.between_motors_m,
    )


def _assembled(folder: Path, source: Source) -> Airframe:
    made = source.made_of
    assert isinstance(made, Assembly)
    pieces = [_piece(folder / made.folder / part.file, _turned(part), part.colour) for part in made.parts]
    return _made(pieces, [(np.array(hub), made.propeller_radius_m) for hub in made.hubs])


def _turned(part: Part) -> Array:
    turn = np.eye(4)
    turned = rotation(math.radians(part.roll_deg), 0.0, math.radians(part.yaw_deg))
    turn[:3, :3] = part.scale * turned @ np.diag([1.0, -1.0 if part.mirrored else 1.0, 1.0])
    turn[:3, 3] = part.position_m
    return turn


def _of_sdf(folder: Path, path: str) -> Airframe:
    """What the links of an SDF model show, but lamps; what belongs to a link ``rotor...`` is its propeller."""
    file = folder / path
    pieces, rotors = [], []
    for link in ET.parse(file).getroot().iter("link"):
        at = _pose(link.findtext("pose"))
        for visual in link.findall("visual"):
            placed = at @ _pose(visual.findtext("pose"))
            shape = visual.find("geometry")
            assert shape is not None
            mesh, box = shape.find("mesh"), shape.find("box")
            name = str(visual.get("name"))
            if mesh is not None and "led" not in name and "rs_" not in name:
                uri = file.parent / str(mesh.findtext("uri")).rsplit("://", maxsplit=1)[-1]
                placed = placed @ np.diag([*_numbers(mesh.findtext("scale") or "1 1 1"), 1.0])
                piece = _piece(uri, placed, _BLACK if str(link.get("name")).startswith("rotor") else None)
                if str(link.get("name")).startswith("rotor"):
                    hub = at[:3, 3]
                    rotors.append((hub, float(np.linalg.norm((piece[0] - hub)[:, :2], axis=1).max())))
                else:
                    pieces.append(piece)
            elif box is not None:
                cuboid = trimesh.creation.box(_numbers(str(box.findtext("size"))))
                corners = trimesh.transform_points(cuboid.vertices, placed)
                pieces.append((corners, np.asarray(cuboid.faces), np.tile(_GREY, (len(cuboid.faces), 1))))
    widest: dict[tuple[float, ...], float] = {}
    for hub, radius in rotors:
        place = tuple(float(value) for value in np.round(hub, 4))
        widest[place] = max(radius, widest.get(place, 0.0))
    return _made(pieces, [(np.array(hub), radius) for hub, radius in widest.items()])


def _piece(path: Path, placed: Array, colour: tuple[float, float, float] | None) -> tuple[Array, Array, Array]:
    """Corners, triangles and colours of a file, moved by ``placed`` (4, 4)."""
    if not path.is_file():
        raise FileNotFoundError(2, "missing", str(path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene: Any = trimesh.load_scene(
            io.BytesIO(_legible(path)),
            path.suffix[1:],
            resolver=trimesh.resolvers.FilePathResolver(str(path)),
            process=False,
        )
        corners, faces, colours, first = [], [], [], 0
        for turn, name in map(scene.graph.get, scene.graph.nodes_geometry):
            shape = scene.geometry[name]
            if not len(getattr(shape, "faces", ())):
                continue
            corners.append(trimesh.transform_points(shape.vertices, placed @ turn))
            faces.append(np.asarray(shape.faces) + first)
            colours.append(np.tile(colour, (len(shape.faces), 1)) if colour else _colours(shape))
            first += len(shape.vertices)
    return np.vstack(corners), np.vstack(faces), np.vstack(colours)


def _legible(path: Path) -> bytes:
    """The file as XML allows it: some name a node "<STL_BINARY>" or "a&b", others lack their last characters."""
    text = path.read_bytes()
    if path.suffix != ".dae":
        return text
    text = re.sub(rb"&(?!\w+;)", b"&amp;", text.replace(b'"<STL_BINARY>"', b'"STL_BINARY"'))
    return re.sub(rb"</COLLAD?\s*$", b"</COLLADA>", text)


def _colours(shape: Any) -> Array:
    """(m, 3) linear albedo of each triangle: of its picture in the middle, of its material, or grey."""
    grey = np.tile(_GREY, (len(shape.faces), 1))
    material = getattr(shape.visual, "material", None)
    if shape.visual.kind == "texture" and material is not None:
        image, uv = getattr(material, "baseColorTexture", None) or getattr(material, "image", None), shape.visual.uv
        if image is not None and uv is not None:
            middles = np.asarray(uv)[shape.faces].mean(axis=1)
            return _linear(trimesh.visual.color.uv_to_color(middles, image)[:, :3] / 255.0)
        return _linear(np.tile(np.asarray(material.main_color)[:3] / 255.0, (len(shape.faces), 1)))
    if shape.visual.kind in ("vertex", "face"):
        return _linear(np.asarray(shape.visual.face_colors)[:, :3] / 255.0)
    return grey


def _made(pieces: Any, rotors: list[tuple[Array, float]]) -> Airframe:
    """From forward, left, up to forward, right, down, about the middle of the box."""
    flip = np.array([1.0, -1.0, -1.0])
    counts = np.cumsum([0, *(len(corners) for corners, _, _ in pieces)])
    vertices = np.vstack([corners for corners, _, _ in pieces]) * flip
    triangles = np.vstack([faces + first for (_, faces, _), first in zip(pieces, counts, strict=False)])
    colours = np.clip(np.vstack([colours for _, _, colours in pieces]), 0.02, 0.8)
    hubs = np.array([hub * flip for hub, _ in rotors])
    radii = np.array([radius for _, radius in rotors])[:, None]
    reach = np.hstack([radii, radii, 0.0 * radii])
    everything = np.vstack([vertices, hubs - reach, hubs + reach])
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2.0
    edges = vertices[triangles[:, 1:]] - vertices[triangles[:, :1]]
    has_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > 1e-12
    triangles, colours = triangles[has_area], colours[has_area]
    if len(triangles) > _MOST_TRIANGLES:
        raise ValueError(f"an airframe of {len(triangles)} triangles; at most {_MOST_TRIANGLES} are meant to be drawn")
    return Airframe(
        vertices - middle,
        triangles,
        colours,
        tuple(Rotor(hub - middle, float(radius)) for hub, radius in zip(hubs, radii[:, 0], strict=True)),
    )


def _pose(text: str | None) -> Array:
    x, y, z, roll, pitch, yaw = _numbers(text or "0 0 0 0 0 0")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(roll, pitch, yaw), (x, y, z)
    return pose


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def _linear(grey: Array) -> Array:
    """IEC 61966-2-1: sRGB, 0 to 1 -> linear."""
    return np.where(grey <= 0.04045, grey / 12.92, ((grey + 0.055) / 1.055) ** 2.4)
