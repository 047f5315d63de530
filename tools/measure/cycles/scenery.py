"""The world of a moment as Blender's geometry and materials: ground, grass, trees, houses, sky.

North is +y, east +x, up +z.

All shapes and colours are made here from the moment's seed; no picture of any kind is read.
"""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from tools.measure.cycles.plan import EXTENT_M, Moment, ground_height

Array = NDArray[Any]
HALF_GROUND_M = 150.0
_CELL_M = 1.0
_STREWN_WITHIN_M, _BLADES, _STONES = 22.0, 150_000, 40_000
_MODELS = 4
"""Different trees of each kind."""
_GROUND_COLOURS: dict[
    str, tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
] = {
    "meadow": ((0.05, 0.10, 0.02), (0.11, 0.15, 0.035), (0.16, 0.13, 0.06)),
    "dry grass": ((0.20, 0.16, 0.07), (0.30, 0.24, 0.12), (0.13, 0.13, 0.05)),
    "bare earth": ((0.18, 0.12, 0.07), (0.27, 0.19, 0.12), (0.10, 0.11, 0.04)),
    "gravel": ((0.24, 0.23, 0.21), (0.38, 0.36, 0.33), (0.12, 0.12, 0.11)),
}
"""Three colours of each ground, linear: two that mix finely, one of large patches."""


def build(moment: Moment) -> None:
    """Everything of a moment that does not move."""
    rng = np.random.Generator(np.random.PCG64([moment.seed, moment.number, 1]))
    _sky(moment)
    _ground(moment)
    if moment.ground in ("meadow", "dry grass"):
        _grass(moment, rng)
    else:
        _stones(moment, rng)
    shapes = {
        kind: [_plant(kind, k) for k in range(_MODELS)]
        for kind in ("broadleaf", "conifer", "bush")
        if kind == "broadleaf" or any(one.kind == kind for one in moment.standing)
    }
    for one in moment.standing:
        north, east = one.north_east
        up = _height(moment, north, east)
        if one.kind == "house":
            _house(moment, (east, north, up), one.size_m, one.turn, one.seed)
        else:
            _put(shapes[one.kind][one.seed], (east, north, up - 0.05), one.size_m, one.turn)
    # A distant edge of wood, as nearly everywhere.
    for angle in np.arange(0.0, 2.0 * math.pi, 0.035):
        out = EXTENT_M + rng.uniform(10.0, 45.0)
        if rng.random() < 0.75:
            place = (out * math.sin(angle), out * math.cos(angle), -0.3)
            _put(shapes["broadleaf"][int(rng.integers(_MODELS))], place, rng.uniform(7.0, 15.0), rng.uniform(0, 6.28))


def mesh_object(name: str, vertices: Array, triangles: Array, material: Any, colours: Array | None = None) -> Any:
    """A new object in the scene; ``colours`` (m, 3), linear, become the attribute ``tint`` of its triangles."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(vertices, np.float64).tolist(), [], np.asarray(triangles).tolist())
    if colours is not None:
        tint = mesh.attributes.new("tint", "FLOAT_COLOR", "FACE")
        tint.data.foreach_set("color", np.hstack([colours, np.ones((len(colours), 1))]).astype(np.float32).ravel())
    mesh.materials.append(material)
    made = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(made)
    return made


def material(name: str, colour: tuple[float, float, float] | None, roughness: float = 0.8, **inputs: float) -> Any:
    """A plain surface; without a colour, that of the attribute ``tint``."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["Roughness"].default_value = roughness
    for key, value in inputs.items():
        surface.inputs[key].default_value = value
    if colour is None:
        tint = nodes.new("ShaderNodeAttribute")
        tint.attribute_name = "tint"
        links.new(tint.outputs["Color"], surface.inputs["Base Color"])
    else:
        surface.inputs["Base Color"].default_value = (*colour, 1.0)
    return made


def _height(moment: Moment, north: float, east: float) -> float:
    return float(ground_height(moment.relief, np.array([north]), np.array([east]))[0])


def _sky(moment: Moment) -> None:
    """Blender's physical atmosphere with the sun in it, and before both clouds, which are noise."""
    world = bpy.data.worlds.new("sky")
    bpy.context.scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    air = nodes.new("ShaderNodeTexSky")
    air.sky_type = "MULTIPLE_SCATTERING"
    air.sun_elevation, air.sun_rotation = moment.sun_elevation, moment.sun_azimuth
    air.aerosol_density = moment.haze
    air.sun_intensity = 0.05 if moment.clouds > 0.9 else 1.0
    where = nodes.new("ShaderNodeTexCoord")
    stretched = nodes.new("ShaderNodeMapping")
    stretched.inputs["Scale"].default_value = (1.5, 1.5, 5.0)
    stretched.inputs["Location"].default_value = (moment.seed % 97, moment.number % 89, 0.0)
    noise = nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = 2.0, 3.0
    edge = nodes.new("ShaderNodeValToRGB")
    middle = 0.75 - 0.5 * moment.clouds
    edge.color_ramp.elements[0].position = max(0.0, middle - 0.08)
    edge.color_ramp.elements[1].position = min(1.0, middle + 0.12)
    bright = nodes.new("ShaderNodeRGB")
    shade = 0.35 + 0.65 * math.sin(moment.sun_elevation)
    bright.outputs[0].default_value = (9.0 * shade, 9.2 * shade, 9.6 * shade, 1.0)
    mix = nodes.new("ShaderNodeMix")
    mix.data_type = "RGBA"
    strength = nodes["Background"]
    strength.inputs["Strength"].default_value = 0.1
    links.new(where.outputs["Generated"], stretched.inputs["Vector"])
    links.new(stretched.outputs["Vector"], noise.inputs["Vector"])
    links.new(noise.outputs["Fac"], edge.inputs["Fac"])
    links.new(edge.outputs["Color"], mix.inputs["Factor"])
    links.new(air.outputs["Color"], mix.inputs[6])
    links.new(bright.outputs[0], mix.inputs[7])
    if moment.clouds == 0.0:
        links.new(air.outputs["Color"], strength.inputs["Color"])
    else:
        links.new(mix.outputs[2], strength.inputs["Color"])


def _ground(moment: Moment) -> None:
    side = np.arange(-HALF_GROUND_M, HALF_GROUND_M + _CELL_M / 2, _CELL_M)
    east, north = np.meshgrid(side, side)
    up = ground_height(moment.relief, north, east)
    corners = np.stack([east, north, up], axis=-1).reshape(-1, 3)
    n = len(side)
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.vstack([np.stack([first, first + 1, first + n + 1], 1), np.stack([first, first + n + 1, first + n], 1)])
    surface = _ground_material(moment)
    ground = mesh_object("ground", corners, faces, surface)
    ground.data.shade_smooth()
    far = 4000.0
    mesh_object(
        "far", np.array([[-far, -far, -1], [far, -far, -1], [far, far, -1], [-far, far, -1]]),
        np.array([[0, 1, 2], [0, 2, 3]]), surface,
    )  # fmt: skip


def _ground_material(moment: Moment) -> Any:
    one, two, patch = _GROUND_COLOURS[moment.ground]
    made = material("ground", one, 0.95)
    nodes, links = made.node_tree.nodes, made.node_tree.links
    where = nodes.new("ShaderNodeNewGeometry")
    fine = _noise(nodes, links, where.outputs["Position"], 6.0, 4.0)
    coarse = _noise(nodes, links, where.outputs["Position"], 0.15, 2.0)
    mixed = _mixed(nodes, links, _steep(nodes, links, fine, 0.35, 0.65), one, two)
    patched = _mixed(nodes, links, _steep(nodes, links, coarse, 0.5, 0.62), mixed, patch)
    links.new(patched, nodes["Principled BSDF"].inputs["Base Color"])
    return made


def _noise(nodes: Any, links: Any, where: Any, scale: float, detail: float) -> Any:
    noise = nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = scale, detail
    noise.inputs["Roughness"].default_value = 0.65
    links.new(where, noise.inputs["Vector"])
    return noise.outputs["Fac"]


def _steep(nodes: Any, links: Any, value: Any, low: float, high: float) -> Any:
    ramp = nodes.new("ShaderNodeMapRange")
    ramp.inputs["From Min"].default_value, ramp.inputs["From Max"].default_value = low, high
    links.new(value, ramp.inputs["Value"])
    return ramp.outputs["Result"]


def _mixed(nodes: Any, links: Any, share: Any, first: Any, second: Any) -> Any:
    mix = nodes.new("ShaderNodeMix")
    mix.data_type = "RGBA"
    links.new(share, mix.inputs["Factor"])
    for place, colour in ((6, first), (7, second)):
        if isinstance(colour, tuple):
            mix.inputs[place].default_value = (*colour, 1.0)
        else:
            links.new(colour, mix.inputs[place])
    return mix.outputs[2]


def _grass(moment: Moment, rng: np.random.Generator) -> None:
    """Single blades around the own drone, a triangle each; farther off the ground's colours stand for them."""
    foot = _strewn(moment, rng, _BLADES)
    turn, long = rng.uniform(0, 2 * math.pi, _BLADES), rng.uniform(0.06, 0.22, _BLADES)
    wide = np.stack([np.cos(turn), np.sin(turn), np.zeros(_BLADES)], 1) * rng.uniform(0.004, 0.012, _BLADES)[:, None]
    lean = np.stack([rng.normal(0, 0.35, _BLADES), rng.normal(0, 0.35, _BLADES), np.ones(_BLADES)], axis=1)
    corners = np.stack([foot - wide, foot + wide, foot + lean * long[:, None]], axis=1).reshape(-1, 3)
    one, two, _ = (np.array(colour) for colour in _GROUND_COLOURS[moment.ground])
    colours = (one + (two - one) * rng.uniform(0, 1, (_BLADES, 1))) * rng.uniform(0.7, 1.5, (_BLADES, 1))
    mesh_object("grass", corners, np.arange(3 * _BLADES).reshape(-1, 3), material("grass", None, 0.7), colours)


def _stones(moment: Moment, rng: np.random.Generator) -> None:
    """Loose stones around the own drone, four triangles each."""
    middle = _strewn(moment, rng, _STONES)
    size = rng.uniform(0.01, 0.035, (_STONES, 1, 1)) * np.where(rng.random((_STONES, 1, 1)) < 0.02, 4.0, 1.0)
    corners = middle[:, None] + size * rng.normal(0.0, 0.7, (_STONES, 4, 3))
    faces = 4 * np.arange(_STONES)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    one, two, _ = (np.array(colour) for colour in _GROUND_COLOURS[moment.ground])
    colours = (one + (two - one) * rng.uniform(0, 1, (_STONES, 1))) * rng.uniform(0.5, 1.4, (_STONES, 1))
    mesh_object(
        "stones", corners.reshape(-1, 3), faces.reshape(-1, 3), material("stones", None), np.repeat(colours, 4, axis=0)
    )


def _strewn(moment: Moment, rng: np.random.Generator, count: int) -> Array:
    """(count, 3) places on the ground around the own drone."""
    out, angle = _STREWN_WITHIN_M * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(0, 2 * math.pi, count)
    east, north = out * np.sin(angle), out * np.cos(angle)
    return np.stack([east, north, ground_height(moment.relief, north, east)], axis=1)


def _plant(kind: str, number: int) -> Any:
    """One of the trees or bushes, 1 m high, out of sight: `_put` shows it where it stands."""
    rng = np.random.Generator(np.random.PCG64([{"broadleaf": 0, "conifer": 1, "bush": 2}[kind], number]))
    bark, green = np.array([0.1, 0.07, 0.045]), np.array([0.075, 0.14, 0.035])
    if kind == "broadleaf":
        around, high = rng.uniform(0, 2 * math.pi, 26), rng.uniform(0.3, 0.9, 26)
        out = 0.3 * np.sqrt(np.maximum(0.0, 1.0 - ((high - 0.58) / 0.38) ** 2)) * np.sqrt(rng.uniform(0.1, 1.0, 26))
        lumps = [
            (np.array([r * math.cos(a), r * math.sin(a), h]), rng.uniform(0.07, 0.13))
            for r, a, h in zip(out, around, high, strict=True)
        ]
        middles, size, trunk = _in_lumps(rng, lumps, 9000), 0.017, 0.5
    elif kind == "conifer":
        up = rng.uniform(0.0, 1.0, 7000) ** 1.4
        out = (1.0 - up) * 0.2 * np.sqrt(rng.uniform(0.2, 1, 7000)) * (1.0 + 0.3 * np.sin(up * 70.0))
        angle = rng.uniform(0, 2 * math.pi, 7000)
        middles = np.stack([out * np.cos(angle), out * np.sin(angle), 0.08 + 0.92 * up], axis=1)
        size, trunk, green = 0.018, 0.9, green * [0.6, 0.7, 1.0]
    else:
        lumps = [
            (np.array([rng.normal(0, 0.25), rng.normal(0, 0.25), rng.uniform(0.3, 0.7)]), rng.uniform(0.2, 0.35))
            for _ in range(7)
        ]
        middles, size, trunk = _in_lumps(rng, lumps, 2500), 0.05, 0.2
    green = green * rng.uniform(0.6, 1.6) * rng.uniform([0.7, 0.85, 0.6], [2.0, 1.1, 1.2])
    n = len(middles)
    turns = rng.normal(size=(n, 2, 3))
    turns /= np.linalg.norm(turns, axis=2, keepdims=True)
    corners = [
        middles,
        middles + size * turns[:, 0],
        middles + size * (turns[:, 0] + turns[:, 1]),
        middles + size * turns[:, 1],
    ]
    leaves = np.stack(corners, axis=1).reshape(-1, 3)
    first = 4 * np.arange(n)
    faces = np.vstack([np.stack([first, first + 1, first + 2], 1), np.stack([first, first + 2, first + 3], 1)])
    tints = green * rng.uniform(0.6, 1.4, (n, 1)) * (0.7 + 0.5 * middles[:, 2:])
    around = np.linspace(0, 2 * math.pi, 8, endpoint=False)
    ring = np.stack([np.cos(around), np.sin(around)], axis=1) * (0.022 if kind != "bush" else 0.03)
    stem = np.vstack([np.column_stack([ring, np.zeros(8)]), np.column_stack([0.4 * ring, np.full(8, trunk)])])
    k = np.arange(8)
    sides = np.vstack([np.stack([k, (k + 1) % 8, 8 + (k + 1) % 8], 1), np.stack([k, 8 + (k + 1) % 8, 8 + k], 1)])
    made = mesh_object(
        f"{kind} {number}", np.vstack([stem, leaves]), np.vstack([sides, faces + len(stem)]),
        material(f"{kind} {number}", None, 0.6), np.vstack([np.tile(bark, (16, 1)), tints, tints]),
    )  # fmt: skip
    bpy.context.scene.collection.objects.unlink(made)
    return made


def _in_lumps(rng: np.random.Generator, lumps: Any, count: int) -> Array:
    """(count, 3) places near the surfaces of balls."""
    which = rng.integers(0, len(lumps), count)
    middle, radius = (np.array([lump[part] for lump in lumps])[which] for part in (0, 1))
    towards = rng.normal(size=(count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return np.asarray(middle + towards * (radius * rng.uniform(0.5, 1.0, count) ** 0.5)[:, None])


def _put(shape: Any, place: tuple[float, float, float], size_m: float, turn: float) -> None:
    shown = bpy.data.objects.new(shape.name, shape.data)
    shown.location, shown.scale, shown.rotation_euler = place, (size_m,) * 3, (0.0, 0.0, turn)
    bpy.context.scene.collection.objects.link(shown)


def _house(moment: Moment, place: tuple[float, float, float], half: float, turn: float, seed: int) -> None:
    """Walls, a pitched roof, windows and a door."""
    rng = np.random.Generator(np.random.PCG64([moment.number, seed]))
    wall = material(
        "wall", tuple(rng.choice([[0.6, 0.55, 0.45], [0.7, 0.7, 0.68], [0.35, 0.15, 0.1], [0.3, 0.3, 0.3]]))
    )
    roof = material("roof", tuple(rng.choice([[0.25, 0.07, 0.04], [0.08, 0.08, 0.09], [0.3, 0.2, 0.14]])), 0.7)
    glass = material("glass", (0.03, 0.04, 0.05), 0.1)
    x, y, high = half, half * rng.uniform(0.6, 0.9), rng.uniform(2.6, 5.5)
    top, over = high + 0.6 * y, 0.4
    parts = [_box(wall, (-x, x), (-y, y), (-0.5, high))]
    gable = np.array([[-x, -y, high], [-x, y, high], [-x, 0, top], [x, -y, high], [x, y, high], [x, 0, top]])
    parts.append(mesh_object("gable", gable, np.array([[0, 1, 2], [3, 5, 4]]), wall))
    eaves = high - 0.6 * over
    low, ridge = eaves + 0.05, top + 0.05
    sheet = np.array(
        [[-x - over, -y - over, low], [x + over, -y - over, low], [x + over, 0, ridge], [-x - over, 0, ridge]]
    )
    parts.append(mesh_object("roof", sheet, np.array([[0, 1, 2], [0, 2, 3]]), roof))
    parts.append(mesh_object("roof", sheet * [1, -1, 1], np.array([[0, 1, 2], [0, 2, 3]]), roof))
    parts += [
        _box(glass, (along, along + 1.0), (side * y - 0.03, side * y + 0.03), (up, up + 1.2))
        for along in np.arange(-x + 1.0, x - 1.0, 2.2)
        for side in (-1, 1)
        for up in np.arange(1.0, high - 1.2, 2.6)
    ]
    for part in parts:
        part.location, part.rotation_euler = place, (0.0, 0.0, turn)


def _box(surface: Any, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Any:
    corners = np.array([[a, b, c] for a in x for b in y for c in z], np.float64)
    squares = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[a, b, c] for a, b, c, _ in squares] + [[a, c, d] for a, _, c, d in squares]
    return mesh_object("box", corners, np.array(faces), surface)
