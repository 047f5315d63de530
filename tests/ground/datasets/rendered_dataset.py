"""A short scene of a rendered world with exact depth and poses, written down as a dataset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.messages import Float32Array, FloatArray, Frame, UInt8Array
from flockd.flight.geometry import RigCamera, ZMap
from flockd.flight.perception import Crops, OneByOne, RangeEstimates, SceneMaps
from flockd.flight.perception.flow import DisFlow
from flockd.sim.renderer.renderer import Renderer
from flockd.sim.world.world import World
from tests.flight.perception.cameras import SECOND_STAGE

WIDTH, HEIGHT = 320, 240
FOCAL = 200.0
FRAMES = 6
MATRIX = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
OTHERS_MATRIX = MATRIX - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
"""The matrix of the same camera for whoever counts pixel centres from 0."""
R_FRD_RDF = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Scene:
    images: list[UInt8Array]
    depth: list[FloatArray]
    """Metres, infinite for the sky."""
    poses: FloatArray
    """(n, 4, 4) camera to world."""

    def motion(self, first: int, second: int) -> FloatArray:
        return np.asarray(np.linalg.inv(self.poses[first]) @ self.poses[second])


def scene() -> Scene:
    """Ahead, down and to the side, with all three turns, 4 m above ground."""
    renderer = Renderer(World.generate(11), [])
    images, depth, poses = [], [], []
    for k in range(FRAMES):
        R = Rotation.from_euler("ZYX", np.radians([1.5 * k, -12.0 + k, 0.7 * k])).as_matrix() @ R_FRD_RDF
        position = np.array([0.12 * k, 0.05 * k, -4.0 + 0.03 * k])
        none = np.zeros((0, 3))
        view = renderer.render(
            MATRIX, (WIDTH, HEIGHT), R, position, drone_rotations=np.zeros((0, 3, 3)), drone_positions=none, shown=[]
        )
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R, position
        images.append(view.rgb)
        depth.append(view.depth.astype(np.float64))
        poses.append(pose)
    return Scene(images, depth, np.array(poses))


class Onlooker(OneByOne):
    """In the place of the networks: OpenCV's flow, no drones, and the scene's depth in its order."""

    map_stride = 2
    second_stage = SECOND_STAGE

    def __init__(self, depth: Sequence[FloatArray]) -> None:
        self._flow = DisFlow()
        self._depth: Iterator[FloatArray] = iter(depth)

    def flow(self, first: Frame, second: Frame, labels: UInt8Array) -> Float32Array:
        return self._flow.flow(first.image, second.image)

    def scene(self, frame: Frame, camera: RigCamera, ground: Float32Array | None) -> SceneMaps:
        depth = np.minimum(next(self._depth), 1000.0).astype(np.float32)
        return SceneMaps(ZMap(depth), np.zeros(frame.image.shape[:2], np.uint8), ())

    def ranges(self, crops: Crops) -> RangeEstimates:
        return RangeEstimates.unknown(0)


def write_rgbd_folder(scene: Scene, path: Path) -> Path:
    for folder in ("images", "depth"):
        (path / folder).mkdir(parents=True)
    for k, (image, depth) in enumerate(zip(scene.images, scene.depth, strict=True)):
        name = f"{10 + 3 * k:05}.png"  # numbers have gaps
        _write(path / "images" / name, image)
        cv2.imwrite(str(path / "depth" / name), _units(depth, 1000.0))
    np.savetxt(path / "K.txt", OTHERS_MATRIX)
    np.savetxt(path / "poses.txt", scene.poses.reshape(-1, 16), fmt="%.6e")
    return path


def _write(path: Path, image: UInt8Array) -> None:
    cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


def _units(depth: FloatArray, per_m: float) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    """0 for what 16 bits cannot hold."""
    units = np.round(depth * per_m)
    return np.where(units < 65536, units, 0).astype(np.uint16)
