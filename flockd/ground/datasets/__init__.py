"""Recordings that others made, from real cameras: folders with depth and poses, and videos; read, and flown again."""

from __future__ import annotations

from pathlib import Path

from flockd.ground.datasets.dataset import DatasetFrame, FileDataset
from flockd.ground.datasets.errors import DatasetError
from flockd.ground.datasets.euroc import open_euroc
from flockd.ground.datasets.rgbd_folder import open_rgbd_folder
from flockd.ground.datasets.tum import open_tum
from flockd.ground.datasets.video import SUFFIXES, VideoDataset, open_video

__all__ = ["Dataset", "DatasetError", "DatasetFrame", "is_dataset", "open_dataset"]

Dataset = FileDataset | VideoDataset
"""A sequence of images of one camera, in whichever layout."""


def is_dataset(path: Path) -> bool:
    """Whether this is for `open_dataset`: a folder, or a video by its suffix."""
    return path.is_dir() or path.suffix.lower() in SUFFIXES


def open_dataset(path: Path, calibration: Path | None = None) -> Dataset:
    """What lies at ``path``, in whichever layout; ``calibration`` comes before the dataset's own.

    Raises DatasetError, and ConfigError for a calibration that cannot be used.
    """
    if not path.is_dir():
        return open_video(path, calibration)
    if (path / "rgb.txt").is_file():
        return open_tum(path, calibration)
    for folder in (path, path / "mav0"):
        if (folder / "cam0").is_dir():
            return open_euroc(folder, calibration)
    if (path / "images").is_dir():
        return open_rgbd_folder(path, calibration)
    raise DatasetError(
        f"{path}: is in none of the layouts that can be read; it needs images/ with K.txt, rgb.txt (TUM RGB-D) or "
        "mav0/cam0 (EuRoC)"
    )
