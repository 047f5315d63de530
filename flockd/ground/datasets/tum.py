"""The layout of the TUM RGB-D benchmark: rgb.txt, depth.txt and groundtruth.txt list files and poses by time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flockd.core.messages import FloatArray
from flockd.ground.datasets.camera_intrinsics import read_calibration
from flockd.ground.datasets.dataset import Entry, FileDataset
from flockd.ground.datasets.errors import DatasetError
from flockd.ground.datasets.image_files import read_image
from flockd.ground.datasets.pose_track import PoseTrack, track_of_rows
from flockd.ground.datasets.tables import read_lines, read_rows

_UNITS_PER_M = 5000.0
_MAX_OFFSET_S = 0.02
"""An image and a depth map farther apart in time do not belong together."""


def open_tum(path: Path, calibration: Path | None) -> FileDataset:
    """The images of rgb.txt; where depth.txt is, those without a depth map of their time are left out.

    Poses are read between those of groundtruth.txt, if it is there. The calibration may lie beside them as K.txt.
    Raises DatasetError and ConfigError.
    """
    times_s, images = _listed(path / "rgb.txt")
    size = read_image(images[0]).shape[1::-1]
    camera = read_calibration(calibration or path / "K.txt", (size[0], size[1]))
    depth = _depth_of(path / "depth.txt", times_s)
    track = _track(path / "groundtruth.txt") if (path / "groundtruth.txt").exists() else None
    entries = tuple(
        Entry(image.name, float(time_s), image, depth.get(index), track.at(float(time_s)) if track else None)
        for index, (time_s, image) in enumerate(zip(times_s, images, strict=True))
        if not depth or index in depth
    )
    if track and not any(entry.T_world_camera for entry in entries):
        raise DatasetError(f"{path / 'groundtruth.txt'}: has no pose at the time of any image; it belongs to another")
    left_out = len(images) - len(entries)
    note = f"{path}: {left_out} of {len(images)} images have no depth map within {_MAX_OFFSET_S:g} s, and are left out"
    return FileDataset(path, camera, entries, _UNITS_PER_M, (note,) if left_out else ())


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
    if np.any(np.diff(times) <= 0):
        raise DatasetError(f"{file}: its times do not increase; sort it by time")
    return np.array(times), files


def _depth_of(file: Path, image_times_s: FloatArray) -> dict[int, Path]:
    """By the image's index, the depth map nearest in time; none without a list."""
    if not file.exists():
        return {}
    times_s, maps = _listed(file)
    nearest = np.abs(times_s[None] - image_times_s[:, None]).argmin(axis=1)
    close = np.abs(times_s[nearest] - image_times_s) <= _MAX_OFFSET_S
    if not close.any():
        raise DatasetError(f"{file}: has no depth map at the time of any image; it belongs to another rgb.txt")
    return {int(index): maps[nearest[index]] for index in np.flatnonzero(close)}


def _track(file: Path) -> PoseTrack:
    rows = read_rows(file, columns=8, what="time tx ty tz qx qy qz qw")
    return track_of_rows(file, rows[:, 0], rows[:, 1:4], rows[:, 4:])
