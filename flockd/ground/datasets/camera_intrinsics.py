"""The camera of a dataset, from whichever file knows it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import ValidationError

from flockd.core.config import load_drone
from flockd.core.config.rig import CameraConfig, IntrinsicsConfig, RigConfig
from flockd.core.errors import ConfigError
from flockd.flight.geometry import build_rig
from flockd.ground.datasets.tables import read_rows

CAMERA = "camera"
"""Its name where the file has none."""
_HALF_PIXEL = 0.5
"""Other people's matrices count pixel centres from 0; ours lie at +0.5."""
_CENTRAL = (1 / 3, 2 / 3)
"""Where between an image's borders a principal point may lie. A matrix of half or twice the size is outside."""


def read_calibration(file: Path, size: tuple[int, int]) -> CameraConfig:
    """A 3x3 matrix as text, or a drone's YAML with one camera; for images of ``size`` (width, height).

    Raises ConfigError, also where it is of another size.
    """
    if not file.is_file():
        raise ConfigError.at(file, "does not exist; put the calibration there, or name one with --calibration")
    if file.suffix.lower() in {".yaml", ".yml"}:
        return _camera_of_drone(file, size)
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
        camera = CameraConfig(name=CAMERA, size_px=size, intrinsics=intrinsics)
        build_rig(RigConfig(cameras=(camera,)))
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError.at(
            file, f"{'.'.join(map(str, first['loc']))}: {first['msg']}; correct the calibration"
        ) from None
    except ValueError as error:
        raise ConfigError.at(file, f"{error}; correct the calibration") from None
    return camera


def _camera_of_drone(file: Path, size: tuple[int, int]) -> CameraConfig:
    cameras = load_drone(file).rig.cameras
    if len(cameras) != 1:
        raise ConfigError.at(
            file, f"has {len(cameras)} cameras; name a file with the one that took the images", "rig.cameras"
        )
    wanted = cameras[0].size_px
    if wanted != size:
        raise ConfigError.at(
            file,
            f"is the calibration of another size, {wanted[0]} x {wanted[1]}; name the one that belongs to "
            f"{size[0]} x {size[1]} pixels",
            "rig.cameras[0].size_px",
        )
    return cameras[0]
