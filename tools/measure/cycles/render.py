"""Render planned moments with Cycles: run by the Python that has `bpy`, trimesh, pycollada and pillow.

PYTHON -m tools.measure.cycles.render JOB.json OUT

For each airframe ``airframe_NAME.npz``, as it is drawn. For each moment and rig ``moment_NNN_RIG.npz`` with
(2, cameras, h, w) ``rgb``, ``range_m`` along the ray (0: sky), and ``ids`` (0 world, k drone k - 1, `PROPELLER` + k
what turns of it); ``sizes_m`` of the drones; ``ground_range_m`` (2,) along the own drone's down axis (NaN: none).
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector
from numpy.typing import NDArray

from tools.measure.cycles.airframes import Airframe, airframe, save_airframe
from tools.measure.cycles.jobs import PROPELLER, Job, airframe_file, read_job
from tools.measure.cycles.lens import Lens, blender_camera, known_places
from tools.measure.cycles.plan import Moment, Pose, blades, painted
from tools.measure.cycles.scenery import build, material, mesh_object

Array = NDArray[Any]
NED_TO_BLENDER = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""North, east, down to east, north, up."""
_RDF_TO_BLENDER_CAMERA = np.diag([1.0, -1.0, -1.0])
_MIDDLE = 0.14
"""What the middle of all pixels is exposed to."""
_NOISE = 1.5
"""Grey levels of noise at mid-tones."""


def main() -> None:
    """Render what a job asks for; a file that is there already is left as it is."""
    job, out = read_job(Path(sys.argv[1])), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    try:
        for name in sorted({one.airframe for moment in job.moments for one in moment.neighbours}):
            save_airframe(airframe(Path(job.meshes), name), airframe_file(out, name))
    except ValueError as error:
        sys.exit(str(error))
    markers(job, out / "markers.json")
    for moment in job.moments:
        for rig, lenses in job.rigs.items():
            file = out / f"moment_{moment.number:03d}_{rig}.npz"
            if not file.is_file():
                _moment(job, moment, lenses, file)
                print(file.name, flush=True)


def _moment(job: Job, moment: Moment, lenses: tuple[Lens, ...], file: Path) -> None:
    _new_scene(job)
    build(moment)
    shapes = [airframe(Path(job.meshes), one.airframe) for one in moment.neighbours]
    drones = [_drone(shape, moment.neighbours[k].paint, moment.neighbours[k].seed, k) for k, shape in enumerate(shapes)]

    def both() -> Array:
        """(2, cameras, h, w, 3) before and after the step."""
        images = []
        for k in range(2):
            for parts, neighbour in zip(drones, moment.neighbours, strict=True):
                for part in parts:
                    part.matrix_world = _matrix(neighbour.poses[k].rotation, neighbour.poses[k].position)
            images.append(np.stack([_taken(lens, moment.own[k]) for lens in lenses]))
        return np.stack(images)

    linear = both()
    ground_range_m = np.array([_below(own) for own in moment.own])
    _show_truth()
    truth = both()
    rng = np.random.Generator(np.random.PCG64([moment.seed, moment.number, 2]))
    unfinished = file.with_suffix(".part")
    with unfinished.open("wb") as written:
        np.savez_compressed(
            written,
            rgb=_developed(linear, rng),
            range_m=truth[..., 0],
            ids=np.rint(truth[..., 1]).astype(np.uint8),
            ground_range_m=ground_range_m,
            sizes_m=np.array([shape.size_m for shape in shapes]),
        )
    unfinished.rename(file)


def markers(job: Job, path: Path) -> None:
    """Where Cycles shows small balls before each rig's first lens: places (n, 3) RDF and pixels (n, 2), by rig."""
    report: dict[str, Any] = {}
    for rig, lenses in job.rigs.items():
        lens = lenses[0]
        _new_scene(job)
        places = known_places(lens)
        for k, place in enumerate(places):
            bpy.ops.mesh.primitive_uv_sphere_add(radius=0.08, segments=48, ring_count=24)
            ball = bpy.context.object
            ball.pass_index = k + 1
            ball.matrix_world = Matrix.Translation(Vector(NED_TO_BLENDER @ place))
        _show_truth()
        # The optical axes are the world's: right is north, down is east, forward is down.
        camera = Lens(**{**vars(lens), "R_body_camera": np.eye(3).tolist(), "position_m": (0.0, 0.0, 0.0)})
        ids = np.rint(_taken(camera, Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))[..., 1]).astype(int)
        pixels = []
        for k in range(len(places)):
            rows, columns = np.nonzero(ids == k + 1)
            pixels.append([float(columns.mean()) + 0.5, float(rows.mean()) + 0.5] if len(rows) else [math.nan] * 2)
        report[rig] = {"places": places.tolist(), "pixels": pixels}
    path.write_text(json.dumps(report), encoding="utf-8")


def _new_scene(job: Job) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.render.threads_mode, scene.render.threads = "FIXED", job.threads
    scene.render.use_persistent_data = True
    scene.cycles.samples, scene.cycles.use_adaptive_sampling = job.samples, False
    scene.cycles.use_denoising = True
    scene.cycles.denoiser = "OPENIMAGEDENOISE"
    scene.cycles.max_bounces, scene.cycles.diffuse_bounces, scene.cycles.glossy_bounces = 2, 1, 1
    scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.image_settings.exr_codec = "NONE"
    scene.render.resolution_percentage = 100
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.clip_start, camera.data.clip_end = 0.02, 1e5
    scene.collection.objects.link(camera)
    scene.camera = camera


def _show_truth() -> None:
    """From now on an image holds, at its pixels' centres, the range along the ray and the object's number."""
    scene = bpy.context.scene
    told = bpy.data.materials.new("truth")
    told.use_nodes = True
    nodes, links = told.node_tree.nodes, told.node_tree.links
    nodes.clear()
    seen, thing = nodes.new("ShaderNodeCameraData"), nodes.new("ShaderNodeObjectInfo")
    both, light, out = (
        nodes.new(kind) for kind in ("ShaderNodeCombineXYZ", "ShaderNodeEmission", "ShaderNodeOutputMaterial")
    )
    links.new(seen.outputs["View Distance"], both.inputs["X"])
    links.new(thing.outputs["Object Index"], both.inputs["Y"])
    links.new(both.outputs["Vector"], light.inputs["Color"])
    links.new(light.outputs["Emission"], out.inputs["Surface"])
    bpy.context.view_layer.material_override = told
    black = bpy.data.worlds.new("black")
    black.use_nodes = True
    black.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
    scene.world = black
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.max_bounces = 1, False, 0
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01


def _drone(shape: Airframe, paint: str, seed: int, number: int) -> list[Any]:
    """The body, and of each propeller two blades and the disc that they blur into."""
    rng = np.random.Generator(np.random.PCG64(seed))
    plastic = material(f"drone {number}", None, float(rng.uniform(0.25, 0.6)))
    # Object axes are the body's FRD; a face that looks the wrong way is lit all the same.
    body = mesh_object(f"drone {number}", shape.vertices, shape.triangles, plastic, painted(shape.colours, paint))
    body.pass_index = number + 1
    blade, blur = material("blade", (0.03, 0.03, 0.03), 0.4), _see_through(float(rng.uniform(0.08, 0.3)))
    parts = [body]
    for rotor in shape.rotors:
        parts += [
            _disc(rotor.hub, rotor.radius_m, blur),
            _blades(rotor.hub, rotor.radius_m, rng.uniform(0, 6.28), blade),
        ]
    for part in parts[1:]:
        part.pass_index = PROPELLER + number + 1
    return parts


def _disc(hub: Array, radius_m: float, surface: Any) -> Any:
    around = np.linspace(0, 2 * math.pi, 48, endpoint=False)
    rim = hub + radius_m * np.stack([np.cos(around), np.sin(around), np.zeros(48)], axis=1)
    k = np.arange(48)
    return mesh_object("disc", np.vstack([rim, hub]), np.stack([k, (k + 1) % 48, np.full(48, 48)], axis=1), surface)


def _blades(hub: Array, radius_m: float, turn: float, surface: Any) -> Any:
    """3 mm above the disc."""
    corners = blades(hub, radius_m, turn) - [0, 0, 0.003]
    return mesh_object("blades", corners, np.array([[0, 1, 2], [0, 2, 3]]), surface)


def _see_through(share: float) -> Any:
    made = material("blur", (0.05, 0.05, 0.05), 0.5)
    made.node_tree.nodes["Principled BSDF"].inputs["Alpha"].default_value = share
    return made


def _taken(lens: Lens, own: Pose) -> Array:
    """(h, w, 3) of one camera now, linear or truth."""
    scene, camera = bpy.context.scene, bpy.context.scene.camera
    for key, value in blender_camera(lens).items():
        setattr(camera.data, key, value)
    scene.render.resolution_x, scene.render.resolution_y = lens.size_px
    R_body_camera, place = np.array(lens.R_body_camera), np.array(lens.position_m)
    rotation = own.rotation @ R_body_camera @ _RDF_TO_BLENDER_CAMERA
    camera.matrix_world = _matrix(rotation, np.array(own.position) + own.rotation @ place)
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = str(Path(folder) / "image.exr")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(scene.render.filepath)
        pixels = np.empty(lens.size_px[0] * lens.size_px[1] * 4, np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
    return np.array(pixels.reshape(lens.size_px[1], lens.size_px[0], 4)[::-1, :, :3])


def _below(own: Pose) -> float:
    """What a range finder along the body's down axis reads; NaN where it meets nothing."""
    scene = bpy.context.scene
    start = Vector(NED_TO_BLENDER @ np.array(own.position))
    down = Vector(NED_TO_BLENDER @ own.rotation[:, 2])
    start = start + 0.4 * down
    hit, place, *_ = scene.ray_cast(bpy.context.evaluated_depsgraph_get(), start, down)
    return float((place - start).length) + 0.4 if hit else math.nan


def _matrix(rotation: Array, position: Any) -> Matrix:
    """Of an object whose axes ``rotation`` (3, 3) takes to NED."""
    whole = np.eye(4)
    whole[:3, :3] = NED_TO_BLENDER @ rotation
    whole[:3, 3] = NED_TO_BLENDER @ np.asarray(position)
    return Matrix(whole.tolist())


def _developed(linear: Array, rng: np.random.Generator) -> Array:
    """8-bit sRGB of linear images (n, h, w, 3): one exposure for all, highlights rolled off, a little noise.

    The curve is Narkowicz's of 2015 ("ACES Filmic Tone Mapping Curve").
    """
    luminance = linear @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    x = linear * np.float32(_MIDDLE / max(float(np.median(luminance)), 1e-6))
    x = np.maximum(x, 0.0)
    bright = np.minimum(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 1.0)
    srgb = np.where(bright <= 0.0031308, 12.92 * bright, 1.055 * np.maximum(bright, 1e-9) ** (1 / 2.4) - 0.055)
    noisy = 255.0 * srgb + rng.normal(0.0, _NOISE, srgb.shape)
    developed: Array = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return developed


if __name__ == "__main__":
    main()
