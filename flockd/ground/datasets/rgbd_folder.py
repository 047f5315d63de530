"""A folder of RGB-D with poses: images/, depth/ in 16-bit millimetres, K.txt, poses.txt."""

from __future__ import annotations

from pathlib import Path

from flockd.flight.geometry import RigidTransform
from flockd.ground.datasets.camera_intrinsics import read_calibration
from flockd.ground.datasets.dataset import Entry, FileDataset
from flockd.ground.datasets.errors import DatasetError
from flockd.ground.datasets.image_files import SUFFIXES, read_image
from flockd.ground.datasets.pose_track import pose_of_matrix
from flockd.ground.datasets.tables import read_rows


def open_rgbd_folder(path: Path, calibration: Path | None) -> FileDataset:
    """Frame i is the i-th file name of images/ in order, and row i of poses.txt; its time is i seconds.

    depth/, with the same names, and poses.txt may be missing. Raises DatasetError and ConfigError.
    """
    images = _image_files(path / "images")
    size = read_image(images[0]).shape[1::-1]
    camera = read_calibration(calibration or path / "K.txt", (size[0], size[1]))
    depth = _depth_files(path / "depth", images) if (path / "depth").is_dir() else [None] * len(images)
    poses = _poses(path / "poses.txt", images) if (path / "poses.txt").exists() else [None] * len(images)
    entries = (
        Entry(image.name, float(index), image, depth_file, pose)
        for index, (image, depth_file, pose) in enumerate(zip(images, depth, poses, strict=True))
    )
    return FileDataset(path, camera, tuple(entries))


def _image_files(folder: Path) -> list[Path]:
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)
    if not files:
        raise DatasetError(f"{folder}: holds no images; put them there")
    return files


def _depth_files(folder: Path, images: list[Path]) -> list[Path | None]:
    """Checked against the images both ways: a file too many may belong to an image that is gone."""
    depth = {file.stem: file for file in _image_files(folder)}
    stems = [image.stem for image in images]
    missing = [stem for stem in stems if stem not in depth]
    if missing:
        raise DatasetError(
            f"{folder / missing[0]}.png: is missing, and {len(missing) - 1} more are; each image needs its depth"
            if len(missing) > 1
            else f"{folder / missing[0]}.png: is missing; each image needs its depth"
        )
    alone = sorted(depth.keys() - set(stems))
    if alone:
        raise DatasetError(f"{depth[alone[0]]}: its image is missing in {images[0].parent}; restore it, or delete both")
    return [depth[stem] for stem in stems]


def _poses(file: Path, images: list[Path]) -> list[RigidTransform | None]:
    rows = read_rows(file, columns=16, what="one 4x4 camera-to-world matrix a line, 16 numbers")
    if len(rows) != len(images):
        raise DatasetError(
            f"{file}: has {len(rows)} poses, and {images[0].parent} {len(images)} images; give each image its line"
        )
    return [pose_of_matrix(row, f"{file}: pose {number}") for number, row in enumerate(rows, start=1)]
