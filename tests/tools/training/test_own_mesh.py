"""Reading a fleet's own drone from a mesh. Needs the extra `train`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from flockd.sim.renderer.airframe import DroneModel
from tools.training.own_mesh import read_meshes


def cross_of_boxes() -> Any:
    """A drone of two bars, 0.6 m and 0.4 m long, 0.1 m wide and 0.05 m tall, and a post on top: y up, 0.15 m in all."""
    bars = [trimesh.creation.box((0.6, 0.1, 0.05)), trimesh.creation.box((0.1, 0.4, 0.05))]
    post = trimesh.creation.box((0.02, 0.02, 0.1))
    post.apply_translation((0.0, 0.0, 0.075))
    mesh: Any = trimesh.util.concatenate([*bars, post])
    mesh.apply_translation((3.0, 2.0, 1.0))
    return y_up(mesh)


def y_up(mesh: Any) -> Any:
    """Of a mesh with z up."""
    mesh.vertices = mesh.vertices[:, [1, 2, 0]]
    return mesh


def written(folder: Path, name: str, mesh: Any) -> Path:
    path = folder / name
    mesh.export(path)
    return path


def read(path: Path, size_m: float) -> DroneModel:
    (drone,) = read_meshes([path], size_m)
    return drone


def test_a_mesh_stands_upright_about_its_middle_and_is_not_mirrored(tmp_path: Path) -> None:
    mesh = cross_of_boxes()
    drone = read(written(tmp_path, "drone.glb", mesh), 0.62)
    sides = drone.extent[1] - drone.extent[0]
    assert sorted(sides) == pytest.approx([0.15, 0.4, 0.6], rel=1e-3)
    assert sides[2] == pytest.approx(0.15, rel=1e-3), "upright"
    assert drone.extent.sum(0) == pytest.approx(np.zeros(3), abs=1e-6), "the origin is the middle"
    assert drone.size_m == 0.62
    top = drone.vertices[np.argsort(drone.vertices[:, 2])[:4]]
    assert np.abs(top[:, :2]).max() < 0.02, "the post is on top"
    half = len(drone.triangles) // 2
    again = trimesh.Trimesh(drone.vertices, drone.triangles[:half], process=False)
    assert again.volume == pytest.approx(mesh.volume, rel=1e-3), "its faces still look outwards"


BROWN = (128, 64, 32)
BROWN_OF_SRGB = (0.2159, 0.0513, 0.0144)
"""IEC 61966-2-1, by hand."""
BROWN_OF_LINEAR = (0.502, 0.251, 0.1255)
PICTURE = Image.new("RGB", (4, 4), BROWN)


def of_material(mesh: Any, **said: Any) -> Any:
    # Both come without types.
    material: Any = PBRMaterial
    texture: Any = trimesh.visual.TextureVisuals
    mesh.visual = texture(uv=np.full((len(mesh.vertices), 2), 0.5), material=material(**said))
    return mesh


@pytest.mark.parametrize(
    ("said", "albedo"),
    [
        ({"baseColorFactor": [*BROWN, 255]}, BROWN_OF_LINEAR),
        ({"baseColorTexture": PICTURE}, BROWN_OF_SRGB),
    ],
    ids=["colour", "picture"],
)  # fmt: skip
def test_materials_of_gltf_are_read_as_its_specification_says(
    tmp_path: Path, said: dict[str, Any], albedo: tuple[float, ...]
) -> None:
    drone = read(written(tmp_path, "drone.glb", of_material(cross_of_boxes(), **said)), 0.6)
    assert np.unique(drone.colours.round(4), axis=0) == pytest.approx(np.array([albedo]), abs=2e-4)


@pytest.mark.parametrize(
    ("name", "size_m", "said"),
    [
        ("drone.glb", 0.2, r"is 0\.608.* m wide .*--size-m 0\.2 m does not fit"),
        ("tall.glb", 0.4, r"is 0\.\d+ x 0\.\d+ x 0\.60 m, the last upright.*with y up"),
        ("drone.glb", 7.0, r"--size-m 7: a drone measures 0\.05 to 5 m"),
        ("drone.stl", 0.6, r"a mesh is read from \.glb or \.gltf"),
        ("none.glb", 0.6, r"none\.glb: there is no such file"),
        ("text.glb", 0.6, r"text\.glb: is no mesh that can be read"),
        ("dense.glb", 0.6, r"dense\.glb: has \d+ triangles, and at most 40000 are drawn; simplify it"),
    ],
    ids=["size", "up", "no drone's size", "format", "missing", "broken", "dense"],
)
def test_a_file_that_cannot_be_the_drone_is_refused_in_one_sentence(
    tmp_path: Path, name: str, size_m: float, said: str
) -> None:
    written(tmp_path, "drone.glb", cross_of_boxes())
    tall = cross_of_boxes()
    tall.vertices = tall.vertices[:, [1, 2, 0]]
    written(tmp_path, "tall.glb", tall)
    written(tmp_path, "dense.glb", cross_of_boxes().subdivide_to_size(0.006))
    (tmp_path / "text.glb").write_text("no mesh at all", encoding="utf-8")
    with pytest.raises(ValueError, match=said) as refused:
        read(tmp_path / name, size_m)
    assert "\n" not in str(refused.value)
