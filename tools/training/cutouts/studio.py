"""One Blender scene in which drones are lit and taken, transparent around them; read by the Python that has `bpy`.

North is +y, east +x, up +z. The sun stands in the north; cameras and drones turn.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from tools.measure.cycles.plan import rotation
from tools.measure.cycles.render import NED_TO_BLENDER
from tools.measure.cycles.scenery import material, mesh_object
from tools.training.cutouts.drones import Drone, propeller, swept
from tools.training.cutouts.plan import SIZE_PX, Light, Scene, View

Array = NDArray[Any]
_SAMPLES, _MASK_SAMPLES = 8, 6
_SMOOTH_BELOW = math.radians(38.0)
_FAR_M = 200.0
_LIGHT = np.array([0.2126, 0.7152, 0.0722])
_SEEN = 8.0 / 255.0
"""Alpha from which a pixel is the drone's."""


@dataclass(frozen=True, eq=False)
class Cutout:
    """A drone without what is behind it."""

    rgba: Array
    """(h, w, 4) uint8, sRGB, straight alpha."""
    focal_px: float
    middle_px: tuple[float, float]
    """Where the drone's middle is seen: column and row from the picture's corner."""
    box_px: tuple[int, int, int, int]
    """Of the pixels that show it, propellers too: left, top, right, bottom; right and bottom are outside."""
    body_box_px: tuple[int, int, int, int]
    """Of those that it covers by half or more."""
    range_m: float


class Studio:
    """The scene, set up once."""

    def __init__(self, threads: int) -> None:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self._scene = scene = bpy.context.scene
        scene.render.engine = "CYCLES"
        scene.cycles.device = "CPU"
        scene.render.threads_mode, scene.render.threads = "FIXED", threads
        scene.render.use_persistent_data = True
        scene.render.film_transparent = True
        scene.cycles.use_adaptive_sampling = False
        scene.cycles.denoiser = "OPENIMAGEDENOISE"
        # "High" and "accurate" take longer than the samples do.
        scene.cycles.denoising_quality, scene.cycles.denoising_prefilter = "FAST", "FAST"
        # One bounce: from the ground, or from the next part.
        scene.cycles.max_bounces, scene.cycles.diffuse_bounces, scene.cycles.glossy_bounces = 1, 1, 1
        scene.render.use_border, scene.render.use_crop_to_border = True, False
        scene.cycles.caustics_reflective = scene.cycles.caustics_refractive = False
        scene.render.image_settings.file_format = "OPEN_EXR"
        scene.render.image_settings.color_mode, scene.render.image_settings.color_depth = "RGBA", "32"
        scene.render.image_settings.exr_codec = "NONE"
        scene.render.resolution_x = scene.render.resolution_y = SIZE_PX
        scene.render.resolution_percentage = 100
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        camera.data.clip_start, camera.data.clip_end, camera.data.sensor_width = 0.02, 1e4, 36.0
        scene.collection.objects.link(camera)
        scene.camera = camera
        self._skin, self._mask = _skin(), _mask()
        self._ground = _plane()
        self._lamps: list[Any] = []
        self._body: Any = None
        self._propellers: list[Any] = []
        self._drone: Drone | None = None

    def stand(self, drone: Drone, light: Light, seed: int) -> None:
        """Put a drone into a light; what stood there is gone."""
        rng = np.random.Generator(np.random.PCG64([seed, 1]))
        self._remove([self._body] if self._body else [])
        shape = drone.airframe
        self._body = mesh_object("body", shape.vertices, shape.triangles, self._skin, shape.colours)
        finish = self._body.data.attributes.new("finish", "FLOAT_COLOR", "FACE")
        finish.data.foreach_set(
            "color", np.hstack([drone.finish, np.ones((len(drone.finish), 1))]).astype(np.float32).ravel()
        )
        _round_off(self._body.data)
        self._drone = drone
        self._light(light, rng)

    def take(self, scene: Scene, view: View) -> Cutout:
        """The drone as one view has it."""
        drone = self._drone
        assert drone is not None
        rng = np.random.Generator(np.random.PCG64([view.seed, 2]))
        turned = rotation(*view.drone_roll_pitch_yaw)
        place = Matrix(_whole(NED_TO_BLENDER @ turned, np.zeros(3)).tolist())
        corners, blurred = self._hang_propellers(drone, view, rng)
        for part in (self._body, *self._propellers):
            part.matrix_world = place
        points = np.vstack([drone.airframe.vertices, *corners]) @ (NED_TO_BLENDER @ turned).T
        range_m = max(view.range_m, 1.5 * drone.airframe.size_m)
        focal_px, middle = self._aim(view, points, range_m)
        linear = self._rendered(blurred, mask=False)
        rgba = _developed(linear, view.exposure, scene.light.balance, drone.albedo)
        if blurred:
            cover = self._rendered(blurred, mask=True)
            grey = float(np.exp(rng.uniform(math.log(0.02), math.log(0.25))))
            rgba = _with_blur(rgba, cover[..., 3], view.blur_alpha, grey * view.exposure)
        alpha = rgba[..., 3]
        quantised = np.rint(255.0 * rgba).astype(np.uint8)
        quantised[quantised[..., 3] == 0] = 0
        return Cutout(quantised, focal_px, middle, _box(alpha > _SEEN), _box(alpha >= 0.5), range_m)

    def _remove(self, objects: list[Any]) -> None:
        for one in objects:
            mesh = one.data
            bpy.data.objects.remove(one)
            if isinstance(mesh, bpy.types.Mesh):
                bpy.data.meshes.remove(mesh)
            else:
                bpy.data.lights.remove(mesh)

    def _light(self, light: Light, rng: np.random.Generator) -> None:
        old = self._scene.world
        self._remove(self._lamps)
        self._lamps = []
        world = bpy.data.worlds.new("light")
        self._scene.world = world
        if old is not None:
            bpy.data.worlds.remove(old)
        world.use_nodes = True
        world.cycles.sampling_method, world.cycles.sample_map_resolution = "MANUAL", 256
        if light.kind in ("sun", "against the sun"):
            _sky(world, light)
        elif light.kind == "overcast":
            _dome(world, light, 1.0)
        else:
            _dome(world, light, float(rng.uniform(0.1, 0.4)))
            self._lamps = [_lamp(rng) for _ in range(int(rng.integers(2, 6)))]
            for lamp in self._lamps:
                self._scene.collection.objects.link(lamp)
        self._ground.location = (0.0, 0.0, -min(light.height_m, 2.5) if light.kind == "indoors" else -light.height_m)
        tone = self._ground.data.materials[0].node_tree.nodes["Principled BSDF"]
        tone.inputs["Base Color"].default_value = (*np.clip(light.ground, 0.0, 0.9), 1.0)

    def _hang_propellers(self, drone: Drone, view: View, rng: np.random.Generator) -> tuple[list[Array], bool]:
        """New propellers; their corners, and whether they are blurred, which is drawn by a mask."""
        self._remove(self._propellers)
        self._propellers = []
        blades = 2 if rng.random() < 0.87 else 3
        blurred = view.propellers in ("disc", "smeared")
        bend = float(rng.uniform(-2.9, 2.9)) if view.propellers == "standing" and rng.random() < 0.35 else 0.0
        tone = np.full(3, np.exp(rng.uniform(math.log(0.015), math.log(0.08))))
        if drone.is_white and rng.random() < 0.4:
            tone = np.full(3, rng.uniform(0.3, 0.75))
        elif rng.random() < 0.12:
            tone = rng.uniform(0.02, 0.6, 3)
        surface = bpy.data.materials.get("blade") or material("blade", (0.03, 0.03, 0.03), 0.4)
        inputs = surface.node_tree.nodes["Principled BSDF"].inputs
        inputs["Base Color"].default_value = (*tone, 1.0)
        inputs["Roughness"].default_value = float(rng.uniform(0.2, 0.6))
        corners = []
        for k, rotor in enumerate(drone.airframe.rotors):
            turn, above = float(rng.uniform(0.0, 2 * math.pi)), np.array([0.0, 0.0, -0.004])
            if blurred:
                points, faces = swept(rotor.radius_m, turn, view.blur_width, blades)
            else:
                count = 2 if bend else blades
                points, faces = propeller(rotor.radius_m, turn, count, bend, 1.0 if k % 2 else -1.0)
            points = points + rotor.hub + above
            part = mesh_object("propeller", points, faces, surface)
            part.pass_index = 1
            for polygon in part.data.polygons:
                polygon.use_smooth = True
            self._propellers.append(part)
            corners.append(points)
        return corners, blurred

    def _aim(self, view: View, points: Array, range_m: float) -> tuple[float, tuple[float, float]]:
        """Turn the camera to the drone's middle and fill the picture; focal length and the middle's place, px."""
        level = math.cos(view.elevation)
        away = np.array([level * math.sin(view.azimuth), level * math.cos(view.azimuth), math.sin(view.elevation)])
        right = np.array([-math.cos(view.azimuth), math.sin(view.azimuth), 0.0])
        up = np.cross(away, right)
        c, s = math.cos(view.roll), math.sin(view.roll)
        axes = np.stack([c * right + s * up, c * up - s * right, away], axis=1)
        camera = self._scene.camera
        camera.matrix_world = Matrix(_whole(axes, range_m * away).tolist())
        seen = (points - range_m * away) @ axes
        flat = seen[:, :2] / -seen[:, 2:]
        low, high = flat.min(axis=0), flat.max(axis=0)
        focal_px = view.fill * SIZE_PX / float((high - low).max())
        shift = focal_px * (low + high) / 2.0 / SIZE_PX
        edge = 0.5 * focal_px * (high - low) / SIZE_PX + 4.0 / SIZE_PX
        render = self._scene.render
        render.border_min_x, render.border_min_y = (max(0.0, float(value)) for value in 0.5 - edge)
        render.border_max_x, render.border_max_y = (min(1.0, float(value)) for value in 0.5 + edge)
        camera.data.lens = focal_px * camera.data.sensor_width / SIZE_PX
        camera.data.shift_x, camera.data.shift_y = (float(value) for value in shift)
        return focal_px, (float((0.5 - shift[0]) * SIZE_PX), float((0.5 + shift[1]) * SIZE_PX))

    def _rendered(self, blurred: bool, *, mask: bool) -> Array:
        """(h, w, 4) linear, premultiplied: the drone, or how much of each pixel blurred propellers cover."""
        scene = self._scene
        for part in self._propellers:
            part.hide_render = blurred and not mask
        bpy.context.view_layer.material_override = self._mask if mask else None
        scene.cycles.samples = _MASK_SAMPLES if mask else _SAMPLES
        scene.cycles.use_denoising = not mask
        with tempfile.TemporaryDirectory() as folder:
            scene.render.filepath = str(Path(folder) / "image.exr")
            bpy.ops.render.render(write_still=True)
            image = bpy.data.images.load(scene.render.filepath)
            pixels = np.empty(SIZE_PX * SIZE_PX * 4, np.float32)
            image.pixels.foreach_get(pixels)
            bpy.data.images.remove(image)
        return np.array(pixels.reshape(SIZE_PX, SIZE_PX, 4)[::-1])


def _developed(linear: Array, exposure: float, balance: float, albedo: Array) -> Array:
    """(h, w, 4) sRGB 0 to 1, straight alpha: of a surface of albedo 1 in the mean light, ``exposure`` is shown."""
    alpha = np.clip(linear[..., 3:], 0.0, 1.0)
    rgb = np.maximum(linear[..., :3], 0.0) / np.maximum(alpha, 1e-3)
    solid = alpha[..., 0] > 0.9
    if not solid.any():
        solid = alpha[..., 0] > 0.3
    # Lamps and glints would count for more than they light.
    shown = np.minimum(rgb[solid], np.quantile(rgb[solid], 0.97, axis=0))
    light = np.maximum(shown.mean(axis=0) / np.maximum(albedo, 0.02), 1e-9)
    mean = float(light @ _LIGHT)
    gains = np.clip((mean / light) ** balance, 0.6, 1.7)
    toned = _shoulder(rgb * gains * exposure / mean)
    return np.concatenate([_srgb(toned), alpha], axis=2)


def _with_blur(rgba: Array, cover: Array, alpha: float, shown: float) -> Array:
    """Blurred propellers over a picture: ``cover`` (h, w) of each pixel, letting all but ``alpha`` through."""
    over = np.clip(cover, 0.0, 1.0)[..., None] * alpha
    below = rgba[..., 3:]
    whole = over + below * (1.0 - over)
    blade = _srgb(_shoulder(np.full(3, shown)))
    rgb = (blade * over + rgba[..., :3] * below * (1.0 - over)) / np.maximum(whole, 1e-6)
    return np.concatenate([np.clip(rgb, 0.0, 1.0), whole], axis=2)


def _shoulder(x: Array) -> Array:
    """Highlights rolled off above 0.7."""
    return np.where(x < 0.7, x, 1.0 - 0.3 * np.exp(-np.maximum(x - 0.7, 0.0) / 0.3))


def _srgb(x: Array) -> Array:
    """IEC 61966-2-1."""
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def _box(seen: Array) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if not len(rows):
        return 0, 0, 0, 0
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def _whole(turn: Array, place: Array) -> Array:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = turn, place
    return whole


def _round_off(mesh: Any) -> None:
    """Smooth shading, but across sharp edges; corners that lie on each other are one."""
    import bmesh  # noqa: PLC0415  # it comes with bpy and is there only after it

    work = bmesh.new()
    work.from_mesh(mesh)
    bmesh.ops.remove_doubles(work, verts=work.verts, dist=2e-5)
    work.to_mesh(mesh)
    work.free()
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=_SMOOTH_BELOW)


def _skin() -> Any:
    """All surfaces of all drones: the attributes ``tint`` and ``finish`` of each triangle."""
    made = material("skin", None)
    nodes, links = made.node_tree.nodes, made.node_tree.links
    surface = nodes["Principled BSDF"]
    finish, split = nodes.new("ShaderNodeAttribute"), nodes.new("ShaderNodeSeparateColor")
    finish.attribute_name = "finish"
    links.new(finish.outputs["Color"], split.inputs["Color"])
    links.new(split.outputs["Red"], surface.inputs["Roughness"])
    links.new(split.outputs["Green"], surface.inputs["Metallic"])
    links.new(split.outputs["Blue"], surface.inputs["Emission Strength"])
    links.new(surface.inputs["Base Color"].links[0].from_socket, surface.inputs["Emission Color"])
    return made


def _mask() -> Any:
    """Cut out of the picture but where propellers (pass index 1) are."""
    made = bpy.data.materials.new("mask")
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    nodes.clear()
    thing, mix = nodes.new("ShaderNodeObjectInfo"), nodes.new("ShaderNodeMixShader")
    hole, light, out = (
        nodes.new(kind) for kind in ("ShaderNodeHoldout", "ShaderNodeEmission", "ShaderNodeOutputMaterial")
    )
    links.new(thing.outputs["Object Index"], mix.inputs[0])
    links.new(hole.outputs[0], mix.inputs[1])
    links.new(light.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], out.inputs["Surface"])
    return made


def _plane() -> Any:
    """The ground, which lights drones from below and is not seen itself."""
    k = _FAR_M
    corners = np.array([(-k, -k, 0), (k, -k, 0), (k, k, 0), (-k, k, 0)], float)
    made = mesh_object("ground", corners, np.array([[0, 1, 2], [0, 2, 3]]), material("ground", (0.1, 0.1, 0.1), 1.0))
    made.visible_camera = False
    return made


def _sky(world: Any, light: Light) -> None:
    """Blender's physical atmosphere, the sun in it in the north."""
    nodes, links = world.node_tree.nodes, world.node_tree.links
    air = nodes.new("ShaderNodeTexSky")
    air.sky_type = "MULTIPLE_SCATTERING"
    air.sun_elevation, air.sun_rotation = light.sun_elevation, 0.0
    air.aerosol_density = light.haze
    links.new(air.outputs["Color"], nodes["Background"].inputs["Color"])
    nodes["Background"].inputs["Strength"].default_value = 0.1


def _dome(world: Any, light: Light, strength: float) -> None:
    """An overcast sky, three times as bright above as at the horizon (Moon and Spencer 1942)."""
    nodes, links = world.node_tree.nodes, world.node_tree.links
    where, split = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeSeparateXYZ")
    ramp = nodes.new("ShaderNodeMapRange")
    ramp.inputs["From Min"].default_value, ramp.inputs["From Max"].default_value = 0.0, 1.0
    ramp.inputs["To Min"].default_value, ramp.inputs["To Max"].default_value = 0.5, 1.5
    links.new(where.outputs["Generated"], split.inputs["Vector"])
    links.new(split.outputs["Z"], ramp.inputs["Value"])
    links.new(ramp.outputs["Result"], nodes["Background"].inputs["Strength"])
    nodes["Background"].inputs["Color"].default_value = (0.95 * strength, strength, 1.06 * strength, 1.0)


def _lamp(rng: np.random.Generator) -> Any:
    """A ceiling's lamp or a window, towards the drone."""
    data = bpy.data.lights.new("lamp", "AREA")
    data.shape = "RECTANGLE"
    data.size, data.size_y = (float(value) for value in rng.uniform(0.3, 2.0, 2))
    out = float(rng.uniform(1.5, 5.0))
    data.energy = 12.0 * out**2 * float(np.exp(rng.uniform(-1.0, 0.7)))
    warm = float(rng.uniform(-0.12, 0.2))
    data.color = (1.0, 1.0 - max(0.0, 0.5 * warm), 1.0 - max(0.0, warm)) if warm > 0 else (1.0 + warm, 1.0, 1.0)
    made = bpy.data.objects.new("lamp", data)
    azimuth, elevation = rng.uniform(-math.pi, math.pi), math.radians(rng.uniform(15.0, 85.0))
    level = math.cos(elevation)
    away = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    made.matrix_world = Matrix(_whole(np.stack([right, np.cross(away, right), away], axis=1), out * away).tolist())
    made.visible_camera = False
    return made
