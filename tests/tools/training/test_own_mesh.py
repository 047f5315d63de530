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
from tools.training.own_mesh import MOST_TRIANGLES, UP_AXES, _upright, painted, read_meshes

RED = [255, 0, 0, 255]


def cross_of_boxes(unit: float = 1.0) -> Any:
    """A drone of two bars, 0.6 m and 0.4 m long, 0.1 m wide and 0.05 m tall, and a post on top: z up, 0.15 m in all."""
    bars = [trimesh.creation.box((0.6, 0.1, 0.05)), trimesh.creation.box((0.1, 0.4, 0.05))]
    post = trimesh.creation.box((0.02, 0.02, 0.1))
    post.apply_translation((0.0, 0.0, 0.075))
    mesh: Any = trimesh.util.concatenate([*bars, post])
    mesh.apply_translation((3.0, 2.0, 1.0))
    mesh.apply_scale(unit)
    return mesh


def written(folder: Path, name: str, mesh: Any) -> Path:
    path = folder / name
    mesh.export(path)
    return path


def read(path: Path, size_m: float, up: str | None = None) -> DroneModel:
    (drone,) = read_meshes([path], size_m, up)
    return drone


def test_files_of_one_drone_keep_their_common_origin(tmp_path: Path) -> None:
    """With and without the post: the bars, whose middle is then another, stay where they are."""
    whole = cross_of_boxes()
    bars = trimesh.Trimesh(whole.vertices[:16], whole.faces[:24], process=False)
    first, second = read_meshes([written(tmp_path, "a.stl", whole), written(tmp_path, "b.stl", bars)], 0.62)
    assert first.extent[1].tolist() == pytest.approx(second.extent[1].tolist(), abs=1e-6), "their undersides"
    assert second.extent[0, 2] - first.extent[0, 2] == pytest.approx(0.1, abs=1e-6), "the post, z down"


@pytest.mark.parametrize(("ending", "unit"), [("stl", 1000.0), ("obj", 1 / 0.0254), ("stl", 100.0), ("obj", 1.0)])
def test_the_drones_size_says_the_unit_of_a_file_that_does_not(tmp_path: Path, ending: str, unit: float) -> None:
    drone = read(written(tmp_path, f"drone.{ending}", cross_of_boxes(unit)), 0.62)
    sides = drone.extent[1] - drone.extent[0]
    assert sorted(sides) == pytest.approx([0.15, 0.4, 0.6], rel=1e-3)
    assert sides[2] == pytest.approx(0.15, rel=1e-3), "upright"
    assert drone.extent.sum(0) == pytest.approx(np.zeros(3), abs=1e-6), "the origin is the middle"
    assert drone.size_m == 0.62


@pytest.mark.parametrize("up", UP_AXES)
def test_what_is_up_in_the_file_is_up_in_the_air_and_nothing_is_mirrored(up: str) -> None:
    axes = _upright(np.eye(3), up).T
    assert np.linalg.det(axes) == pytest.approx(1.0)
    said = np.eye(3)["xyz".index(up[-1])] * (-1 if up.startswith("-") else 1)
    assert (axes @ said).tolist() == [0.0, 0.0, -1.0], "z points down"


@pytest.mark.parametrize(("name", "up"), [("drone.glb", None), ("drone.stl", "y")])
def test_gltf_says_which_way_is_up_and_for_other_files_the_user_does(tmp_path: Path, name: str, up: str | None) -> None:
    mesh = cross_of_boxes()
    mesh.vertices = mesh.vertices[:, [1, 2, 0]]
    drone = read(written(tmp_path, name, mesh), 0.6, up)
    top = drone.vertices[np.argsort(drone.vertices[:, 2])[:4]]
    assert np.abs(top[:, :2]).max() < 0.02, "the post is on top"


def test_colours_of_a_file_are_kept_and_a_drone_without_gets_one(tmp_path: Path) -> None:
    mesh = cross_of_boxes()
    mesh.visual.face_colors = RED
    red = painted(read(written(tmp_path, "red.glb", mesh), 0.6, "z"), 1)
    assert (red.colours[:, 0] > 0.5).all()
    assert (red.colours[:, 1:] < 0.05).all()
    plain = read(written(tmp_path, "plain.stl", cross_of_boxes()), 0.6)
    paints = [painted(plain, seed).colours for seed in range(8)]
    assert all(np.isfinite(paint).all() and paint.min() > 0 and paint.max() <= 0.9 for paint in paints)
    assert all(len(np.unique(paint, axis=0)) == 1 for paint in paints)
    assert len({paint.tobytes() for paint in paints}) == len(paints)


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
    drone = read(written(tmp_path, "drone.glb", of_material(cross_of_boxes(), **said)), 0.6, "z")
    assert np.unique(drone.colours.round(4), axis=0) == pytest.approx(np.array([albedo]), abs=2e-4)


def test_a_part_is_where_its_node_puts_it(tmp_path: Path) -> None:
    """One bar in the file, twice in the scene: along, and turned and 0.1 m higher."""
    turn = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.1], [0.0, 0.0, 0.0, 1.0]])
    scene: Any = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((0.6, 0.1, 0.05)), geom_name="bar")
    scene.graph.update("again", matrix=turn, geometry="bar")
    drone = read(written(tmp_path, "drone.glb", scene), 0.62, "z")
    assert drone.extent[1] - drone.extent[0] == pytest.approx([0.6, 0.6, 0.15], abs=1e-6)


def test_parts_of_different_materials_keep_theirs_and_one_without_is_painted(tmp_path: Path) -> None:
    bars = [trimesh.creation.box((0.6, 0.1, 0.05)), trimesh.creation.box((0.1, 0.4, 0.05))]
    bars[0] = of_material(bars[0], baseColorFactor=[*BROWN, 255])
    drone = read(written(tmp_path, "drone.glb", trimesh.Scene(bars)), 0.6, "z")
    own = np.isfinite(drone.colours).all(axis=1)
    assert own.mean() == 0.5
    assert drone.colours[own] == pytest.approx(np.tile(BROWN_OF_LINEAR, (24, 1)), abs=1e-3)
    looks = [painted(drone, seed).colours for seed in range(8)]
    assert len({look[~own].tobytes() for look in looks}) > 1
    assert all(len(np.unique(look[~own], axis=0)) == 1 for look in looks), "one part, one colour"
    shades = np.array([look[own][0] / BROWN_OF_LINEAR for look in looks])
    assert shades.min() > 0.5
    assert shades.max() < 2.0, "the file's colour in another light"


OBJ = "v 0 0 0\nv 0.6 0 0\nv 0 0.6 0.02\nv 0 0.6 0\nvt 0.5 0.5\n{}f 1/1 2/1 3/1\n{}f 1/1 2/1 4/1\n"


def test_materials_of_obj_and_none_where_the_file_names_one_that_is_missing(tmp_path: Path) -> None:
    PICTURE.save(tmp_path / "brown.png")
    (tmp_path / "drone.mtl").write_text(
        "newmtl a\nKd 0.502 0.251 0.1255\nnewmtl b\nmap_Kd brown.png\n", encoding="utf-8"
    )
    (tmp_path / "drone.obj").write_text("mtllib drone.mtl\n" + OBJ.format("usemtl a\n", "usemtl b\n"), encoding="utf-8")
    drone = read(tmp_path / "drone.obj", 0.85)
    assert drone.colours == pytest.approx(np.tile(BROWN_OF_SRGB, (4, 1)), abs=2e-3)
    (tmp_path / "bare.obj").write_text("mtllib none.mtl\n" + OBJ.format("usemtl a\n", "usemtl b\n"), encoding="utf-8")
    (tmp_path / "plain.obj").write_text(OBJ.format("", ""), encoding="utf-8")
    for name in ("bare.obj", "plain.obj"):
        assert np.isnan(read(tmp_path / name, 0.85).colours).all()


def test_a_mesh_of_very_many_triangles_is_simplified_to_what_a_camera_sees(tmp_path: Path) -> None:
    dense = cross_of_boxes().subdivide_to_size(0.006)
    assert len(dense.faces) > MOST_TRIANGLES
    drone = read(written(tmp_path, "dense.stl", dense), 0.6)
    assert len(drone.triangles) <= 2 * MOST_TRIANGLES, "each has two sides"
    assert drone.extent[1] - drone.extent[0] == pytest.approx([0.4, 0.6, 0.15], abs=0.008)


@pytest.mark.parametrize(
    ("name", "size_m", "up", "said"),
    [
        ("drone.stl", 0.2, None, r"is 0\.608.* wide .* \(0\.608 m if its unit is m.*--size-m 0\.2 m fits none"),
        ("drone.stl", 0.6, "x", r"would be 0\.\d+ x 0\.\d+ x 0\.60 m, the last upright.*correct --up"),
        ("drone.stl", 7.0, None, r"--size-m 7: a drone measures 0\.05 to 5 m"),
        ("drone.ply", 0.6, None, r"a mesh is read from \.glb, \.gltf, \.obj, \.stl"),
        ("none.stl", 0.6, None, r"none\.stl: there is no such file"),
        ("text.glb", 0.6, None, r"text\.glb: is no mesh that can be read"),
        ("text.stl", 0.6, None, r"text\.stl: (is no mesh that can be read|holds no triangles)"),
    ],
    ids=["size", "up", "no drone's size", "format", "missing", "broken glTF", "broken STL"],
)  # fmt: skip
def test_a_file_that_cannot_be_the_drone_is_refused_in_one_sentence(
    tmp_path: Path, name: str, size_m: float, up: str | None, said: str
) -> None:
    written(tmp_path, "drone.stl", cross_of_boxes())
    for broken in ("text.glb", "text.stl"):
        (tmp_path / broken).write_text("no mesh at all", encoding="utf-8")
    with pytest.raises(ValueError, match=said) as refused:
        read(tmp_path / name, size_m, up)
    assert "\n" not in str(refused.value)
