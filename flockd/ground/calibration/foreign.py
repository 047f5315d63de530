"""Calibrations by other programs: Kalibr's camchain, ROS's camera_info, OpenCV's FileStorage, COLMAP's cameras.txt.

The lenses that these share with flockd are taken as they are. Those that OpenCV can undistort get the nearest lens.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from pydantic import ValidationError
from scipy.optimize import least_squares

from flockd.core.choices import LENS_MODELS, LensModel
from flockd.core.config.rig import CameraConfig, IntrinsicsConfig, MeasurementConfig
from flockd.core.messages import FloatArray
from flockd.flight.geometry import Camera, PinholeCamera, WideAngleCamera
from flockd.ground.calibration.board import CENTRE_PX, CalibrationError
from flockd.ground.calibration.fragment import measured_today

_FISHEYES = {"equidistant", "fisheye", "kannala_brandt", "kannala_brandt4"}
_PINHOLES = {"none", "plumb_bob", "radtan", "rational_polynomial"}
_COLMAP: Mapping[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("none", "f cx cy"),
    "PINHOLE": ("none", "fx fy cx cy"),
    "SIMPLE_RADIAL": ("plumb_bob", "f cx cy k1"),
    "RADIAL": ("plumb_bob", "f cx cy k1 k2"),
    "OPENCV": ("plumb_bob", "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": ("rational_polynomial", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": ("equidistant", "f cx cy k1"),
    "RADIAL_FISHEYE": ("equidistant", "f cx cy k1 k2"),
    "OPENCV_FISHEYE": ("equidistant", "fx fy cx cy k1 k2 k3 k4"),
}
"""The lens of each model, and what its parameters are."""
_GRID = 25
"""Points along each side of an image at which lenses are compared."""


@dataclass(frozen=True)
class ForeignLens:
    """One camera of a file, with pixel centres at +0.5."""

    name: str
    size: tuple[int, int]
    model: str
    """`plumb_bob`, `equidistant` and so on, in the file's own word."""
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, ...]


def foreign_lenses(file: Path, size: tuple[int, int] | None) -> list[ForeignLens]:
    """The cameras of a file; ``size``: of the images, where the file does not say it.

    Raises CalibrationError for what is no such file.
    """
    try:
        found = _read(file, size)
    except cv2.error as error:
        raise CalibrationError(f"{file}: OpenCV cannot read it; write it again with cv2.FileStorage") from error
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{file}: is not text; name the file of a calibration") from error
    except (OSError, yaml.YAMLError) as error:
        raise CalibrationError(f"{file}: cannot be read ({str(error).splitlines()[0]}); use another copy") from error
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        told = f"{file}: lacks or garbles {error}"
        raise CalibrationError(
            f"{told}; give Kalibr's camchain, ROS's camera_info, OpenCV's FileStorage or COLMAP's cameras.txt"
        ) from error
    if not found:
        raise CalibrationError(f"{file}: holds no camera; give Kalibr's camchain, or another calibration")
    return found


def _read(file: Path, size: tuple[int, int] | None) -> list[ForeignLens]:
    text = file.read_text(encoding="utf-8-sig")
    if re.search(r"^\s*\d+\s+[A-Z_]+\s+\d+\s+\d+\s", text, re.MULTILINE):
        return [_of_colmap(line.split()) for line in text.splitlines() if re.match(r"\s*\d", line)]
    if text.startswith("%YAML:1") or "opencv-matrix" in text or "opencv_storage" in text:
        return [_of_matrices(_opencv(file), file.stem, size)]
    values = yaml.safe_load(text)
    if not isinstance(values, dict):
        raise ValueError("keys with values")  # noqa: TRY004 - told as what else is wrong with a file
    if "rig" in values:
        raise CalibrationError(f"{file}: is a drone's own file; copy the cameras of its `rig`, they need no import")
    if "camera_matrix" in values:
        return [_of_matrices(values, file.stem, size)]
    return [_of_kalibr(name, one) for name, one in values.items() if isinstance(one, dict) and "intrinsics" in one]


def _lens(name: str, size: Any, model: str, numbers: Any, distortion: Any, shift: float) -> ForeignLens:
    """``numbers``: fx, fy, cx, cy; ``shift``: of the file's pixel centres."""
    coefficients = tuple(float(k) for k in np.ravel(distortion))
    if len(numbers) != 4 or not np.isfinite([*map(float, numbers), *coefficients]).all() or not min(numbers[:2]) > 0:
        raise ValueError(f"fx, fy, cx, cy and coefficients of {name}, as finite numbers")
    fx, fy, cx, cy = map(float, numbers)
    if len(size) != 2:
        raise ValueError(f"width and height of {name}")
    plain = re.sub("[^a-z0-9_-]", "_", name.lower())
    width, height = (int(value) for value in size)
    return ForeignLens(plain, (width, height), model, (fx, fy), (cx + shift, cy + shift), coefficients)


def _of_colmap(words: list[str]) -> ForeignLens:
    """CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS; pixel centres at +0.5."""
    if words[1] not in _COLMAP:
        return _lens(f"camera{words[0]}", words[2:4], words[1], (1, 1, 0, 0), (), 0.0)
    model, names = _COLMAP[words[1]]
    if len(words) != 4 + len(names.split()):
        raise ValueError(f"the parameters of {words[1]}, {names}")
    found = dict(zip(names.split(), map(float, words[4:]), strict=True))
    focal = (found.get("fx", found.get("f", 0.0)), found.get("fy", found.get("f", 0.0)))
    order = "k1 k2 k3 k4" if model == "equidistant" else "k1 k2 p1 p2 k3 k4 k5 k6"
    count = {"none": 0, "plumb_bob": 4, "equidistant": 4}.get(model, 8)
    distortion = [found.get(key, 0.0) for key in order.split()[:count]]
    return _lens(f"camera{words[0]}", words[2:4], model, (*focal, found["cx"], found["cy"]), distortion, 0.0)


def _of_kalibr(name: str, values: Mapping[str, Any]) -> ForeignLens:
    if values["camera_model"] != "pinhole":
        return _lens(name, values["resolution"], values["camera_model"], (1, 1, 0, 0), (), 0.0)
    model, distortion = values.get("distortion_model", "none"), values.get("distortion_coeffs", ())
    return _lens(name, values["resolution"], model, values["intrinsics"], distortion, CENTRE_PX)


def _of_matrices(values: Mapping[str, Any], name: str, size: tuple[int, int] | None) -> ForeignLens:
    """Of ROS and OpenCV."""
    matrix = np.array(values["camera_matrix"]["data"], np.float64)
    if matrix.size != 9 or not matrix.any():
        raise ValueError(f"the camera_matrix, {matrix.size} numbers{'' if matrix.any() else ' that are 0'}")
    matrix = matrix.reshape(3, 3)
    distortion = values.get("distortion_coefficients", {"data": ()})["data"]
    if "image_width" in values:
        size = values["image_width"], values["image_height"]
    if size is None:
        raise ValueError("the size of the images, which --size gives")
    model = values.get("distortion_model") or "plumb_bob"
    numbers = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    return _lens(str(values.get("camera_name", name)), size, model, numbers, distortion, CENTRE_PX)


_NAMES: Mapping[str, tuple[str, ...]] = {
    "camera_matrix": ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M1"),
    "distortion_coefficients": ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D", "D1"),
    "image_width": ("image_width", "image_Width"),
    "image_height": ("image_height", "image_Height"),
}
"""What OpenCV's programs and tutorials call them."""


def _opencv(file: Path) -> dict[str, Any]:
    """What `cv2.FileStorage` wrote, under ROS's names."""
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    there = {key: name for key, names in _NAMES.items() for name in names if not storage.getNode(name).empty()}
    found: dict[str, Any] = {}
    for key, name in there.items():
        node = storage.getNode(name)
        found[key] = int(node.real()) if key.startswith("image") else {"data": node.mat().ravel().tolist()}
    if not storage.getNode("fisheye_model").empty() and storage.getNode("fisheye_model").real():
        found["distortion_model"] = "equidistant"
    return found


def camera_of_lens(lens: ForeignLens, file: Path, *, nearest: bool) -> tuple[CameraConfig, float]:
    """As configuration, and by how many degrees at most the two lenses differ over the image: 0 for the same lens.

    Raises CalibrationError for a lens that flockd has not, unless the ``nearest`` may be taken, and for one that cannot
    be true.
    """
    measured = measured_today(camera=f"{lens.name} of {file.name}", source=str(file), views=1)
    count = len(lens.distortion)
    model: LensModel = "wide_angle" if lens.model in _FISHEYES else "pinhole"
    known = _FISHEYES if model == "wide_angle" else _PINHOLES
    where = f"{file}: {lens.name}"
    if lens.model not in known:
        raise CalibrationError(
            f"{where}: has the lens model {lens.model}, which is not known; calibrate it again with one of "
            f"{', '.join(sorted(known | _FISHEYES))}"
        )
    if count in ((0, 4) if model == "wide_angle" else (0, 4, 5)):
        return _config(lens, model, (*lens.focal, *lens.centre), lens.distortion, measured, where), 0.0
    pixels, rays = _directions(lens, where)
    fits = sorted((_fitted(one, lens, pixels, rays) for one in LENS_MODELS), key=lambda fit: fit[0])
    off_deg, own, numbers = fits[0]
    if not nearest:
        raise CalibrationError(
            f"{where}: its {lens.model} of {count} coefficients has no equivalent; the nearest {own} is {off_deg:.3f} "
            "degrees off at most, and --nearest takes it"
        )
    return _config(lens, own, numbers[:4], tuple(numbers[4:]), measured, where), off_deg


def _config(
    lens: ForeignLens, model: LensModel, numbers: Any, distortion: Any, measured: MeasurementConfig, where: str
) -> CameraConfig:
    fx, fy, cx, cy = (round(float(value), 4) for value in numbers)
    kept = tuple(round(float(k), 8) for k in distortion)
    try:
        intrinsics = IntrinsicsConfig(model=model, fx=fx, fy=fy, cx=cx, cy=cy, distortion=kept, measured=measured)
        return CameraConfig(name=lens.name, size_px=lens.size, intrinsics=intrinsics)
    except ValidationError as error:
        first = error.errors()[0]
        raise CalibrationError(f"{where}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def _directions(lens: ForeignLens, where: str) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) all over the image, and unit vectors (n, 3) of them by OpenCV."""
    sides = [np.linspace(0.5, side - 0.5, _GRID) for side in lens.size]
    pixels = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    (fx, fy), (cx, cy) = lens.focal, lens.centre
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    coefficients = np.array(lens.distortion)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    try:
        plane = cv2.undistortPoints(pixels[:, None], matrix, coefficients, None, None, None, criteria)
    except cv2.error as error:
        told = f"{len(coefficients)} coefficients of {lens.model}"
        raise CalibrationError(f"{where}: OpenCV knows no lens with {told}; check the file") from error
    rays = np.concatenate([np.asarray(plane, np.float64).reshape(-1, 2), np.ones((len(pixels), 1))], axis=1)
    return pixels, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _fitted(
    model: LensModel, lens: ForeignLens, pixels: FloatArray, rays: FloatArray
) -> tuple[float, LensModel, FloatArray]:
    """Degrees off at most, the model, and fx, fy, cx, cy with the distortion of the lens that fits best."""

    def camera(numbers: FloatArray) -> Camera:
        fx, fy, cx, cy = numbers[:4]
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        kind = PinholeCamera if model == "pinhole" else WideAngleCamera
        return kind(matrix, lens.size, tuple(numbers[4:]))

    def left(numbers: FloatArray) -> FloatArray:
        found: FloatArray = np.nan_to_num(camera(numbers).project(rays) - pixels, nan=float(max(lens.size)))
        return found.ravel()

    begin = np.array([*lens.focal, *lens.centre, *([0.0] * (5 if model == "pinhole" else 4))])
    numbers = np.asarray(least_squares(left, begin, x_scale="jac").x, np.float64)
    cosines = np.sum(camera(numbers).rays(pixels) * rays, axis=1)
    off = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return (float(off.max()) if np.isfinite(off).all() else 180.0), model, numbers
