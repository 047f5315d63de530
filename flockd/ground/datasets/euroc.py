"""The EuRoC MAV layout: cam0 with its images, their times and its calibration; the vehicle's true state beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from flockd.core.choices import LensModel
from flockd.core.config.rig import CameraConfig
from flockd.core.errors import ConfigError
from flockd.flight.geometry import RigidTransform
from flockd.ground.datasets.camera_intrinsics import camera_of, read_calibration
from flockd.ground.datasets.dataset import Entry, FileDataset
from flockd.ground.datasets.errors import DatasetError
from flockd.ground.datasets.image_files import read_image
from flockd.ground.datasets.pose_track import PoseTrack, pose_of_matrix, track_of_rows
from flockd.ground.datasets.tables import read_lines, read_rows

_MODELS: Mapping[str, LensModel] = {
    "radial-tangential": "pinhole",
    "equidistant": "wide_angle",
}
_NS_PER_S = 1e9


def open_euroc(path: Path, calibration: Path | None) -> FileDataset:
    """The images of cam0 in the folder ``path``, called mav0. There is no depth.

    Poses are read between those of state_groundtruth_estimate0, if it is there, and carried from the vehicle to the
    camera. Raises DatasetError and ConfigError.
    """
    listed = _listed(path / "cam0" / "data.csv")
    sensor = path / "cam0" / "sensor.yaml"
    settings = _settings(sensor)
    width, height = read_image(listed[0][1]).shape[1::-1]
    camera = (
        read_calibration(calibration, (width, height)) if calibration else _camera(sensor, settings, (width, height))
    )
    truth = path / "state_groundtruth_estimate0" / "data.csv"
    track = _track(truth) if truth.exists() else None
    T_body_camera = pose_of_matrix(_numbers(sensor, settings, "T_BS.data", 16), f"{sensor}: T_BS")
    entries = tuple(Entry(f.name, t, f, None, _camera_pose(track, t, T_body_camera)) for t, f in listed)
    if track and not any(entry.T_world_camera for entry in entries):
        raise DatasetError(f"{truth}: has no pose at the time of any image; it belongs to another")
    return FileDataset(path, camera, entries)


def _listed(table: Path) -> list[tuple[float, Path]]:
    """Time in seconds and file of each image."""
    listed: list[tuple[float, Path]] = []
    for number, line in read_lines(table):
        time_ns, _, name = line.partition(",")
        if not time_ns.strip().isdigit() or not name.strip():
            raise DatasetError(f"{table}:{number}: does not fit; it needs a time in ns and a file name")
        time_s = int(time_ns) / _NS_PER_S
        if listed and time_s <= listed[-1][0]:
            raise DatasetError(f"{table}:{number}: its time is not after the one before; sort it by time")
        listed.append((time_s, table.parent / "data" / name.strip()))
    if not listed:
        raise DatasetError(f"{table}: is empty; it needs a time in ns and a file name a line")
    return listed


def _settings(sensor: Path) -> Mapping[str, Any]:
    # Without comments, and without OpenCV's `%YAML:1.0`, which is no YAML.
    body = "\n".join(line for _, line in read_lines(sensor) if not line.startswith("%"))
    try:
        settings = yaml.safe_load(body)
    except yaml.YAMLError as error:
        raise ConfigError.at(sensor, f"is not YAML ({str(error).splitlines()[0]}); correct it") from None
    if not isinstance(settings, dict):
        raise ConfigError.at(sensor, "holds no calibration; it needs intrinsics, distortion and T_BS")
    return settings


def _camera(sensor: Path, settings: Mapping[str, Any], size: tuple[int, int]) -> CameraConfig:
    resolution = tuple(_numbers(sensor, settings, "resolution", 2))
    if resolution != size:
        raise ConfigError.at(
            sensor,
            f"is {resolution[0]:g} x {resolution[1]:g}, and the images {size[0]} x {size[1]}; "
            "it is the calibration of another size",
            "resolution",
        )
    name = str(settings.get("distortion_model"))
    if name not in _MODELS:
        raise ConfigError.at(sensor, f"is {name}; one of {', '.join(_MODELS)} can be used", "distortion_model")
    intrinsics = _numbers(sensor, settings, "intrinsics", 4)
    distortion = _numbers(sensor, settings, "distortion_coefficients", 4)
    return camera_of(sensor, size, list(intrinsics), list(distortion), _MODELS[name])


def _numbers(sensor: Path, settings: Mapping[str, Any], key: str, count: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    value: Any = settings
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    if not (isinstance(value, list) and len(value) == count and all(isinstance(v, int | float) for v in value)):
        raise ConfigError.at(sensor, f"is no list of {count} numbers; write one", key)
    return np.array(value, np.float64)


def _track(table: Path) -> PoseTrack:
    rows = read_rows(table, columns=8, what="time in ns, position, quaternion w x y z", at_least=True)
    return track_of_rows(table, rows[:, 0] / _NS_PER_S, rows[:, 1:4], rows[:, [5, 6, 7, 4]])


def _camera_pose(track: PoseTrack | None, time_s: float, T_body_camera: RigidTransform) -> RigidTransform | None:
    T_world_body = track.at(time_s) if track else None
    return T_world_body @ T_body_camera if T_world_body else None
