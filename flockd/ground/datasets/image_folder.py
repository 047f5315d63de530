"""A folder with images of one camera, and optional depth maps and poses.

The files of `images/` and of `depth/` in order of the numbers in their names; in `poses.txt` a 4x4 camera-to-world
matrix a line; and in `K.txt` the camera's matrix.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from flockd.core.config.rig import CameraConfig, IntrinsicsConfig
from flockd.core.errors import ConfigError
from flockd.core.messages import FloatArray, UInt8Array
from flockd.flight.geometry import RigidTransform, ZMap
from flockd.ground.datasets.image_files import (
    SUFFIXES,
    DatasetError,
    in_order,
    read_depth,
    read_image,
    unread,
    visible,
)

_UNITS_PER_M = 1000.0
"""Of depth maps, 16 bits a pixel."""
_ROUNDING = 1e-2
"""Largest deviation of a matrix of rounded numbers from a rotation."""

CAMERA = "camera"
"""Name of the camera."""
_HALF_PIXEL = 0.5
"""Other people's matrices count pixel centres from 0; ours lie at +0.5."""
MAX_TABLE_BYTES = 1 << 28
"""Hours of poses at 200 Hz."""


@dataclass(frozen=True, eq=False)
class DatasetFrame:
    """The pose and the files of one image."""

    index: int
    """Counted from 0 at the dataset's first frame."""
    image: Path
    depth: Path | None
    T_world_camera: RigidTransform | None
    """From optical RDF to the dataset's world; None: not known."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """A sequence of images of one camera; each image, and each depth map, is a file."""

    path: Path
    camera: CameraConfig
    """The camera; pixel centres at +0.5."""
    moments: tuple[DatasetFrame, ...]

    @property
    def has_depth(self) -> bool:
        """Whether depth was recorded."""
        return any(moment.depth for moment in self.moments)

    def __len__(self) -> int:
        return len(self.moments)

    def frames(self, *, with_depth: bool) -> Iterator[tuple[DatasetFrame, UInt8Array, ZMap | None]]:
        """Reads all in order, one by one: images (h, w, 3) RGB, and depth (h, w) metres along the optical axis, NaN
        where unknown; None if not requested. Raises DatasetError at a missing or damaged file."""
        size = self.camera.size_px
        for one in self.moments:
            depth = ZMap(read_depth(one.depth, size, _UNITS_PER_M)) if with_depth and one.depth else None
            yield one, read_image(one.image, size), depth


def open_dataset(path: Path) -> Dataset:
    """The images in a folder. Raises DatasetError, and ConfigError for a calibration that cannot be used."""
    if not (path / "images").is_dir():
        advice = "is no folder of images; it needs images/, and K.txt with the camera's matrix"
        if recordings := in_order(file for file in path.rglob("*") if file.suffix in {".mcap", ".db3"}):
            advice = f"is a folder of recordings; name one, as in `flockd replay {recordings[0]}`"
            advice += ", or write the metadata.yaml of a bag with `ros2 bag reindex`"
        raise DatasetError(f"{path}: {advice}")
    images = _files(path / "images")
    camera = read_calibration(path / "K.txt", read_image(images[0]).shape[1::-1])
    depth, poses = _depth(path / "depth", images), _poses(path / "poses.txt", images)
    return Dataset(path, camera, tuple(map(DatasetFrame, range(len(images)), images, depth, poses)))


def _files(folder: Path) -> list[Path]:
    files = in_order(file for file in visible(folder) if file.suffix.lower() in SUFFIXES)
    if (others := unread(visible(folder))) is not None:
        raise DatasetError(f"{folder}: has {others}")
    if not files:
        raise DatasetError(f"{folder}: holds no images; put them there")
    for before, after in pairwise(files):
        if before.stem == after.stem:
            raise DatasetError(f"{folder}: has {before.name} and {after.name}; delete one of them")
    return files


def _depth(folder: Path, images: Sequence[Path]) -> Sequence[Path | None]:
    """The depth maps, one for each image: an extra map may belong to a missing image."""
    if not folder.is_dir():
        return [None] * len(images)
    maps = {file.stem: file for file in _files(folder)}
    stems = [image.stem for image in images]
    for stem in stems:
        if stem not in maps:
            raise DatasetError(f"{folder / stem}.png: is missing; each image needs its depth")
    for alone in sorted(maps.keys() - set(stems)):
        raise DatasetError(f"{maps[alone]}: its image is missing in {images[0].parent}; restore it, or delete both")
    return [maps[stem] for stem in stems]


def _poses(file: Path, images: Sequence[Path]) -> Sequence[RigidTransform | None]:
    if not file.exists():
        return [None] * len(images)
    rows = read_rows(file, columns=16, what="one 4x4 camera-to-world matrix a line, 16 numbers")
    if len(rows) != len(images):
        raise DatasetError(
            f"{file}: has {len(rows)} poses, and {images[0].parent} {len(images)} images; give each image its line"
        )
    poses = []
    for number, row in enumerate(rows, start=1):
        matrix, where = row.reshape(4, 4), f"{file}: pose {number}"
        u, _, vt = np.linalg.svd(matrix[:3, :3])
        rotation = u @ vt  # the nearest: the numbers were rounded when they were written
        if np.abs(rotation - matrix[:3, :3]).max() > _ROUNDING or np.linalg.det(rotation) < 0:
            raise DatasetError(f"{where}: its first three columns are no rotation; write a camera-to-world matrix")
        if not np.allclose(matrix[3], (0, 0, 0, 1), atol=_ROUNDING):
            raise DatasetError(f"{where}: its last row is not 0 0 0 1; write a camera-to-world matrix")
        poses.append(RigidTransform(rotation, matrix[:3, 3]))
    return poses


def read_calibration(file: Path, size: tuple[int, ...]) -> CameraConfig:
    """A 3x3 matrix as text, for images of ``size`` (width, height). Raises ConfigError, also for another size."""
    if not file.is_file():
        raise ConfigError.at(file, "does not exist; put the calibration there")
    matrix = read_rows(file, columns=3, what="a 3x3 matrix, three numbers a line")
    if len(matrix) != 3:
        raise ConfigError.at(file, f"is no 3x3 matrix, it has {len(matrix)} rows; give it three, of three numbers each")
    if np.any(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] != (0, 0, 0, 0, 1)):
        raise ConfigError.at(file, "is not a camera matrix; write [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    try:
        intrinsics = IntrinsicsConfig(fx=fx, fy=fy, cx=cx + _HALF_PIXEL, cy=cy + _HALF_PIXEL)
        return CameraConfig(name=CAMERA, size_px=(size[0], size[1]), intrinsics=intrinsics)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError.at(file, f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def read_lines(file: Path) -> list[tuple[int, str]]:
    """Line number from 1 and text of each line that is neither empty nor a comment. Raises DatasetError."""
    if file.exists() and not file.is_file():
        raise DatasetError(f"{file}: is not an ordinary file; restore it")
    if file.exists() and file.stat().st_size > MAX_TABLE_BYTES:
        raise DatasetError(f"{file}: is larger than {MAX_TABLE_BYTES >> 20} MiB, which no table is; restore it")
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise DatasetError(f"{file}: cannot be read ({reason}); put it there") from None
    lines = ((number, line.rstrip()) for number, line in enumerate(text.splitlines(), start=1))
    return [(number, line) for number, line in lines if line and not line.lstrip().startswith("#")]


def read_rows(file: Path, *, columns: int, what: str) -> FloatArray:
    """(n, columns) numbers, between blanks or commas. Raises DatasetError where a line has others, or none is."""
    rows = []
    for number, line in read_lines(file):
        try:
            row = [float(word) for word in line.replace(",", " ").split()]
        except ValueError:
            row = []
        if len(row) != columns or not np.isfinite(row).all():
            raise DatasetError(f"{file}:{number}: does not fit; it needs {what}")
        rows.append(row)
    if not rows:
        raise DatasetError(f"{file}: is empty; it needs {what}")
    return np.array(rows, np.float64)
