"""A folder of one camera's images, with their times, depth maps and poses where those are known.

As TUM's RGB-D sets are published: `rgb.txt`, `depth.txt` and `groundtruth.txt` list files and poses by time, and
`K.txt` is the camera's matrix. Or without lists: the files of `images/` and `depth/` in order of their names, a second
apart, and in `poses.txt` a 4x4 camera-to-world matrix a line.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import ValidationError
from scipy.spatial.transform import Rotation, Slerp

from flockd.core.config.rig import CameraConfig, IntrinsicsConfig, RigConfig
from flockd.core.errors import ConfigError
from flockd.core.messages import FloatArray, UInt8Array
from flockd.flight.geometry import RigidTransform, ZMap, build_rig
from flockd.ground.datasets.image_files import SUFFIXES, DatasetError, read_depth, read_image

_TUM_UNITS_PER_M, _UNITS_PER_M = 5000.0, 1000.0
"""Of depth maps, 16 bits a pixel."""
_MAX_OFFSET_S = 0.02
"""An image and a depth map farther apart in time do not belong together."""
_MAX_GAP_S = 0.1
"""Between poses farther apart in time nothing is known."""
_ROUNDING = 1e-2
"""How far from a rotation a matrix of rounded numbers may be."""

CAMERA = "camera"
"""Its name where the file has none."""
_HALF_PIXEL = 0.5
"""Other people's matrices count pixel centres from 0; ours lie at +0.5."""
_CENTRAL = (1 / 3, 2 / 3)
"""Where between an image's borders a principal point may lie. A matrix of half or twice the size is outside."""
MAX_TABLE_BYTES = 1 << 28
"""Hours of poses at 200 Hz."""

_Poses = Sequence[RigidTransform | None]


@dataclass(frozen=True, eq=False)
class DatasetFrame:
    """When and where an image was taken, and the files of it."""

    index: int
    """Counted from 0 at the dataset's first frame."""
    name: str
    time_s: float
    image: Path
    depth: Path | None
    T_world_camera: RigidTransform | None
    """From optical RDF to the dataset's world; None where it is not known."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """A sequence of images of one camera; each image, and each depth map, is a file."""

    path: Path
    camera: CameraConfig
    """The one that took it; pixel centres at +0.5."""
    moments: tuple[DatasetFrame, ...]
    depth_units_per_m: float
    notes: tuple[str, ...]
    """What a person should know although nothing is wrong: each is one sentence."""

    @property
    def has_depth(self) -> bool:
        """Whether depth was recorded."""
        return any(moment.depth for moment in self.moments)

    def __len__(self) -> int:
        return len(self.moments)

    def frames(self, *, with_depth: bool) -> Iterator[tuple[DatasetFrame, UInt8Array, ZMap | None]]:
        """All in order, read one by one: (h, w, 3) RGB, and (h, w) metres along the optical axis, NaN where there are
        none; None where they were not asked for. Raises DatasetError at a file that is missing or damaged."""
        size = self.camera.size_px
        for one in self.moments:
            depth = ZMap(read_depth(one.depth, size, self.depth_units_per_m)) if with_depth and one.depth else None
            yield one, read_image(one.image, size), depth


def open_dataset(path: Path) -> Dataset:
    """The images in a folder.

    Where there is depth, images without a map of their time are left out. Raises DatasetError, and ConfigError for a
    calibration that cannot be used.
    """
    listed = (path / "rgb.txt").is_file()
    if not listed and not (path / "images").is_dir():
        raise DatasetError(f"{path}: is no folder of images; it needs images/, or rgb.txt with their times and names")
    times_s, images = _listed(path / "rgb.txt") if listed else _counted(path / "images")
    camera = read_calibration(path / "K.txt", read_image(images[0]).shape[1::-1])
    if listed:
        depth, units_per_m = _depth_by_time(path / "depth.txt", times_s), _TUM_UNITS_PER_M
        poses = _poses_by_time(path / "groundtruth.txt", times_s)
    else:
        depth, units_per_m = _depth_by_name(path / "depth", images), _UNITS_PER_M
        poses = _poses_in_order(path / "poses.txt", images)
    kept = [index for index in range(len(images)) if not depth or index in depth]
    moments = tuple(
        DatasetFrame(number, images[k].name, float(times_s[k]), images[k], depth.get(k), poses[k])
        for number, k in enumerate(kept)
    )
    for file in (file for one in moments for file in (one.image, one.depth) if file is not None):
        if not file.is_file():  # better now than after an hour
            raise DatasetError(f"{file}: is missing; restore it, or leave its frame out")
    left_out = len(images) - len(kept)
    note = f"{path}: {left_out} of {len(images)} images have no depth map within {_MAX_OFFSET_S:g} s, and are left out"
    return Dataset(path, camera, moments, units_per_m, (note,) if left_out else ())


def _listed(file: Path) -> tuple[FloatArray, list[Path]]:
    """Times and files of a list."""
    times, files = [], []
    for number, line in read_lines(file):
        time, _, name = line.partition(" ")
        try:
            times.append(float(time))
        except ValueError:
            name = ""
        if not name.strip() or not np.isfinite(times[-1]):
            raise DatasetError(f"{file}:{number}: does not fit; it needs a time in seconds and a file")
        files.append(file.parent / name.strip())
    if not files:
        raise DatasetError(f"{file}: is empty; it needs a time in seconds and a file a line")
    return _increasing(file, np.array(times)), files


def _increasing(file: Path, times_s: FloatArray) -> FloatArray:
    if np.any(np.diff(times_s) <= 0):
        raise DatasetError(f"{file}: its times do not increase; sort it by time")
    return times_s


def _counted(folder: Path) -> tuple[FloatArray, list[Path]]:
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)
    if not files:
        raise DatasetError(f"{folder}: holds no images; put them there")
    return np.arange(len(files), dtype=float), files


def _depth_by_time(file: Path, image_times_s: FloatArray) -> dict[int, Path]:
    """By the image's index, the depth map nearest in time; none without a list."""
    if not file.exists():
        return {}
    times_s, maps = _listed(file)
    nearest = np.abs(times_s[None] - image_times_s[:, None]).argmin(axis=1)
    close = np.abs(times_s[nearest] - image_times_s) <= _MAX_OFFSET_S
    if not close.any():
        raise DatasetError(f"{file}: has no depth map at the time of any image; it belongs to another rgb.txt")
    return {int(index): maps[nearest[index]] for index in np.flatnonzero(close)}


def _depth_by_name(folder: Path, images: Sequence[Path]) -> dict[int, Path]:
    """Checked against the images both ways: a file too many may belong to an image that is gone."""
    if not folder.is_dir():
        return {}
    maps = {file.stem: file for file in _counted(folder)[1]}
    stems = [image.stem for image in images]
    for stem in stems:
        if stem not in maps:
            raise DatasetError(f"{folder / stem}.png: is missing; each image needs its depth")
    for alone in sorted(maps.keys() - set(stems)):
        raise DatasetError(f"{maps[alone]}: its image is missing in {images[0].parent}; restore it, or delete both")
    return {index: maps[stem] for index, stem in enumerate(stems)}


def _poses_by_time(file: Path, image_times_s: FloatArray) -> _Poses:
    """Between those of the file; None before, after and in its gaps."""
    if not file.exists():
        return [None] * len(image_times_s)
    rows = read_rows(file, columns=8, what="time tx ty tz qx qy qz qw")
    times_s = _increasing(file, rows[:, 0])
    if np.any(np.linalg.norm(rows[:, 4:], axis=1) < 1e-6):
        raise DatasetError(f"{file}: a quaternion is all zero; delete that line")
    if len(times_s) < 2:
        raise DatasetError(f"{file}: has one pose alone; it needs those of all images")
    after = np.searchsorted(times_s, image_times_s).clip(1, len(times_s) - 1)
    inside = (image_times_s >= times_s[0]) & (image_times_s <= times_s[-1])
    known = inside & (times_s[after] - times_s[after - 1] <= _MAX_GAP_S) | np.isin(image_times_s, times_s)
    if not known.any():
        raise DatasetError(f"{file}: has no pose at the time of any image; it belongs to another")
    at_s = image_times_s.clip(times_s[0], times_s[-1])
    turns = Slerp(times_s, Rotation.from_quat(rows[:, 4:]))(at_s).as_matrix()
    places = np.column_stack([np.interp(at_s, times_s, rows[:, axis]) for axis in (1, 2, 3)])
    return [RigidTransform(*pose) if there else None for there, *pose in zip(known, turns, places, strict=True)]


def _poses_in_order(file: Path, images: Sequence[Path]) -> _Poses:
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
        raise ConfigError.at(file, "is no camera matrix; write [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    for centre, length, side in ((cx, size[0], "width"), (cy, size[1], "height")):
        if not _CENTRAL[0] * length <= centre <= _CENTRAL[1] * length:
            raise ConfigError.at(
                file,
                f"is the calibration of another size: its principal point lies at {centre:.0f} of {length} pixels of "
                f"the images' {side}; name the one that belongs to {size[0]} x {size[1]} pixels",
            )
    try:
        intrinsics = IntrinsicsConfig(fx=fx, fy=fy, cx=cx + _HALF_PIXEL, cy=cy + _HALF_PIXEL)
        camera = CameraConfig(name=CAMERA, size_px=(size[0], size[1]), intrinsics=intrinsics)
        build_rig(RigConfig(cameras=(camera,)))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise ConfigError.at(file, f"{key}: {first['msg']}; correct the calibration") from None
    except ValueError as error:
        raise ConfigError.at(file, f"{error}; correct the calibration") from None
    return camera


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
