"""Rendered pairs of images with their truth, on disk as memory-mapped arrays."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from flockd.flight.geometry import PinholeCamera, RigCamera, RigidTransform

HEIGHT, WIDTH = 640, 480
MAX_DRONES = 6
FOCAL_PX = 222.0
MAX_DEPTH_M = 80.0
"""Depth of the sky in the network's output."""
MAX_FAMILIES = 16
"""Number of drone families that the distance network classifies in training."""
R_BODY_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation of a camera that looks forward: camera RDF to body FRD."""

ARRAYS: dict[str, tuple[tuple[int, ...], Any]] = {
    "image": ((2, HEIGHT, WIDTH, 3), np.uint8),
    "depth": ((2, HEIGHT // 2, WIDTH // 2), np.float16),
    "ids": ((2, HEIGHT // 2, WIDTH // 2), np.uint8),
    "flow": ((2, HEIGHT // 2, WIDTH // 2), np.float16),
    "flow_valid": ((HEIGHT // 2, WIDTH // 2), np.bool_),
    "focal": ((), np.float32),
    "R_ned_camera": ((2, 3, 3), np.float32),
    "height": ((2,), np.float32),
    "drone_centre": ((2, MAX_DRONES, 3), np.float32),  # camera axes, metres; NaN where there is none
    "drone_whole": ((2, MAX_DRONES), np.bool_),  # inside the image and not hidden
    "drone_pixels": ((2, MAX_DRONES), np.int32),  # visible, full-size pixels
    "drone_box": ((2, MAX_DRONES, 4), np.float32),  # full-size pixels
    "drone_family": ((MAX_DRONES,), np.int16),
}


@dataclass(frozen=True, eq=False)
class PairSet:
    """All pairs of one folder; every attribute is (n, ...) as in ``ARRAYS``."""

    arrays: dict[str, NDArray[Any]]
    count: int

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.arrays[name]


def open_pairs(folder: Path) -> PairSet:
    """The pairs of every part in ``folder``, opened read-only."""
    parts = sorted(folder.glob("part-*"))
    if not parts:
        raise FileNotFoundError(
            f"{folder}: no rendered pairs; make them with `python -m tools.training.render_training_data`"
        )
    opened = {name: [np.load(part / f"{name}.npy", mmap_mode="r") for part in parts] for name in ARRAYS}
    big = {"image", "depth", "ids", "flow", "flow_valid"}
    arrays = {n: (_Chained(a) if n in big else np.concatenate([np.asarray(x) for x in a])) for n, a in opened.items()}
    return PairSet(arrays, sum(len(a) for a in opened["focal"]))  # type: ignore[arg-type]


class _Chained:
    """Several memory-mapped arrays behind one index."""

    def __init__(self, parts: list[NDArray[Any]]) -> None:
        self._parts = parts
        self._starts = np.cumsum([0] + [len(p) for p in parts])

    def __getitem__(self, index: int) -> NDArray[Any]:
        part = int(np.searchsorted(self._starts, index, side="right")) - 1
        return np.asarray(self._parts[part][index - self._starts[part]])


def create_part(folder: Path, count: int) -> dict[str, NDArray[Any]]:
    """Writable arrays for ``count`` pairs in a new part folder."""
    folder.mkdir(parents=True, exist_ok=True)
    return {
        name: open_memmap(folder / f"{name}.npy", mode="w+", dtype=dtype, shape=(count, *shape))
        for name, (shape, dtype) in ARRAYS.items()
    }


def rig_camera(focal: float) -> RigCamera:
    """The camera of a picture, at the body's origin, looking forward."""
    matrix = np.array([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return RigCamera("camera", PinholeCamera(matrix, (WIDTH, HEIGHT)), RigidTransform(R_BODY_CAMERA, np.zeros(3)))


def ground_plane(focal: float, R_ned_camera: NDArray[Any], height_m: float) -> NDArray[np.float32]:
    """(h/2, w/2) inverse depth of flat ground, 1/m; 0 above the horizon."""
    right, down = ray_tangents(focal)
    towards_ground = R_ned_camera[2, 0] * right + R_ned_camera[2, 1] * down + R_ned_camera[2, 2]
    return np.asarray(np.maximum(towards_ground / height_m, 0.0), dtype=np.float32)


def ray_tangents(focal: float) -> NDArray[np.float32]:
    """(2, h/2, w/2) tangents right and down of the optical axis."""
    u = (np.arange(WIDTH // 2) * 2 + 1 - WIDTH / 2) / focal
    v = (np.arange(HEIGHT // 2) * 2 + 1 - HEIGHT / 2) / focal
    return np.stack(np.broadcast_arrays(u[None, :], v[:, None])).astype(np.float32)


def note(folder: Path, **facts: object) -> None:
    """Write to the folder how it was made."""
    (folder / "made.json").write_text(json.dumps(facts, indent=1))
