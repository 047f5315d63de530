"""The compiled colours of a world against the plain formulas, pixel by pixel."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from flockd.core.messages import FloatArray, UInt8Array
from flockd.sim.renderer import _raster
from flockd.sim.renderer.renderer import rasterized, scene_of
from flockd.sim.world import textures
from flockd.sim.world.baking import GROUND_MAP_BITS, sun_reaches
from flockd.sim.world.sky import SKY_BITS
from flockd.sim.world.world import GROUND, World

SIZE, KINDS = (250, 331), ("sky", "ground", "things")
K = np.array([[130.0, 0.0, 121.0], [0.0, 128.0, 160.0], [0.0, 0.0, 1.0]])
LEVEL = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""From a level camera that looks north to NED."""
DRONES = np.array([[5.0, 1.0, -4.0, 0.3, 0.6], [9.0, -2.0, -6.0, 0.5, 0.6]])
"""Place, radius, darkness."""


def tilted(down: float, yaw: float) -> FloatArray:
    c, s = math.cos(down), math.sin(down)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).T
    c, s = math.cos(yaw), math.sin(yaw)
    rotation: FloatArray = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ turn @ LEVEL
    return rotation


class Shot:
    """What a camera sees of a world, before edges are smoothed."""

    def __init__(self, world: World, R: FloatArray, origin: FloatArray, drones: FloatArray) -> None:
        width, height = SIZE
        self.world, self.R, self.origin, self.drones = world, np.ascontiguousarray(R), origin, drones
        self.inverse_K: FloatArray = np.linalg.inv(K)
        P = np.ascontiguousarray(K @ self.R.T)
        self.planes, self.hit, self.depth = rasterized(world.vertices, world.triangles, P, origin, width, height)
        packed = np.empty((height, width), np.uint32)
        everywhere = np.tile([0.0, 0.0, width, height], (len(drones), 1))
        eye = _raster.Eye(K, self.inverse_K, self.R, origin, math.sqrt(K[0, 0] * K[1, 1]))
        blobs = np.hstack([drones, everywhere])
        _raster.shade_scene(self.hit, self.planes, eye, scene_of(world), blobs, packed, self.depth)
        self.rgb: UInt8Array = packed.view(np.uint8).reshape(height, width, 4)[..., :3]

    def expected(self, y: int, x: int) -> tuple[float, list[int]]:
        """Depth and colour of one pixel, in float64, with the library's logarithms."""
        world, t = self.world, self.hit[y, x]
        camera = self.inverse_K @ (x + 0.5, y + 0.5, 1.0)
        ray = self.R @ camera
        if t < 0:
            n, e, d = ray
            scale = 0.5 / (abs(n) + abs(e) + max(0.0, -d))
            limit = 0.5 - 0.51 / (1 << SKY_BITS)
            a, b = (float(np.clip(v * scale, -limit, limit)) + 0.5 for v in (n + e, n - e))
            return math.inf, self.tones([4.0 * value for value in self.sampled(world.sky, 0, SKY_BITS, a, b, 0.0)[:3]])
        z = 1.0 / float(self.planes[t, 9:] @ (x + 0.5, y + 0.5, 1.0))
        place = self.origin + ray * z
        n, e, d = place
        normal, sun = world.normals[t], world.light[0]
        length = float(np.linalg.norm(camera))
        facing = max(0.02 * length, -float(ray @ normal))
        footprint = 0.5 * math.log2(z * z * length / facing) - 0.5 * math.log2(K[0, 0] * K[1, 1]) - 0.4
        free = math.prod(self.left_by(drone, place) for drone in self.drones)
        if world.texture[t] == GROUND:
            u, v = (mirrored((value / world.extent_m + 1.0) / 2.0) for value in (e, n))
            level = footprint + GROUND_MAP_BITS - math.log2(2.0 * world.extent_m)
            *colour, lit = self.sampled(world.ground_map, 0, GROUND_MAP_BITS, u, v, level)
            if max(abs(n), abs(e)) > world.extent_m:
                lit = -sun[2]
            size = 1 << GROUND_MAP_BITS
            kind, tiles, sharpness = world.ground_detail[world.ground_kind[int(v * size), int(u * size)]]
            at, fineness = (e * tiles, n * tiles), footprint + sharpness
            up = 1.0
        else:
            kind, up, colour = world.texture[t], 0.5 - 0.5 * normal[2], list(world.tint[t])
            tu, tv = world.uv[t] @ (n, e, d, 1.0)
            at, fineness = (tu, tv), footprint + world.level[t]
            lit = max(0.0, float(normal @ sun))
            lit *= sun_reaches(world.shadow_map, world.shadow_frame, *(place + 0.08 * normal))
        area = ((4 << 2 * textures.TEXTURE_BITS) - 1) // 3
        fine = self.sampled(world.texels, int(kind) * area, textures.TEXTURE_BITS, *at, fineness)
        clear = math.exp(-world.fog_per_m * z * length)
        seen = [
            2.0 * colour[k] * fine[k] * float(world.light[1:4, k] @ (lit * free, up, 1.0 - up)) * clear
            + world.light[4, k] * (1.0 - clear)
            for k in range(3)
        ]
        return z, self.tones(seen)

    def left_by(self, drone: FloatArray, place: FloatArray) -> float:
        """Share of sunlight that one drone leaves."""
        *centre, radius, darkness = drone
        to = np.array(centre) - place
        along = float(to @ self.world.light[0])
        if along <= 0.0:
            return 1.0
        off, soft = math.sqrt(max(0.0, float(to @ to) - along**2)), 0.35 * radius + 0.01 * along
        return 1.0 - float(darkness) * float(np.clip((radius + 0.5 * soft - off) / soft, 0.0, 1.0))

    @staticmethod
    def sampled(texels: NDArray[np.uint32], base: int, bits: int, u: float, v: float, level: float) -> list[float]:
        """Four channels, linear light."""
        spread = int(_raster.sample(texels, base, bits, u, v, level))
        return [((spread >> shift & 255) / 255.0) ** 2 for shift in (0, 32, 16, 48)]

    def tones(self, linear: list[float]) -> list[int]:
        tone = self.world.tone
        return [int(tone[min(len(tone) - 1, int(math.sqrt(max(0.0, value)) * 1024.0))]) for value in linear]


def mirrored(share: float) -> float:
    return share if 0.0 <= share <= 1.0 else 1.0 - abs(1.0 - share % 2.0)


@pytest.mark.parametrize(("seed", "down", "height_m"), [(11, 0.1, 4.0), (12, 0.7, 5.0)])
def test_colours_are_those_of_the_plain_formulas(seed: int, down: float, height_m: float) -> None:
    world = World.generate(seed)
    ground = world.height_at(np.zeros(1), np.zeros(1))[0]
    shot = Shot(world, tilted(down, 0.4), np.array([0.0, 0.0, -height_m - ground]), DRONES - (0, 0, ground, 0, 0))
    pixels = np.random.default_rng(0).choice(shot.hit.size, 1200, replace=False)
    off, kinds = [], set()
    for y, x in zip(*np.divmod(pixels, SIZE[0]), strict=True):
        z, colour = shot.expected(y, x)
        assert shot.depth[y, x] == np.float32(z)
        off.append(np.abs(shot.rgb[y, x].astype(int) - colour).max())
        t = shot.hit[y, x]
        kinds.add("sky" if t < 0 else "ground" if world.texture[t] == GROUND else "thing")
    assert kinds == {"sky", "ground", "thing"}
    assert max(off) <= 2
    assert np.mean(np.array(off) > 1) < 1e-3
    assert np.mean(np.array(off) > 0) < 0.05


def test_a_row_is_shaded_by_vectors(tmp_path: Path) -> None:
    """A scalar loop gives the same colours, three times slower: only the compiled code shows which it is. LLVM weighs
    whether a processor's vectors are worth it; here it has to take them, wherever a loop allows it."""
    script = "import llvmlite.binding as llvm; llvm.set_option('', '-force-vector-width=8')\n"
    script += f"from {__name__} import compiled; print(['vector.body' in compiled(one) for one in {KINDS}])"
    apart = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    assert subprocess.check_output([sys.executable, "-c", script], text=True, env=apart) == "[True, True, True]\n"


def compiled(kind: str) -> str:
    world = World.generate(11)
    scene, eye = scene_of(world), _raster.Eye(K, np.linalg.inv(K), np.eye(3), np.zeros(3), 130.0)
    columns, tone, shown = np.zeros(40, np.uint32), world.tone.astype(np.int32), np.zeros(40, np.uint32)
    row = np.full(40, world.texture.argmax(), np.int32), np.ones(40, np.float32), np.ones(40, np.float32)
    arguments = (scene.sky, tone, shown) if kind == "sky" else (row, scene, tone, shown)
    shade = njit(error_model="numpy", pipeline_class=_raster._Apart)(getattr(_raster, f"_shade_{kind}").py_func)
    shade(columns, eye, 0, *arguments)
    return str(next(iter(shade.inspect_llvm().values())))
