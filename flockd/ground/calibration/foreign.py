"""Calibrations by other programs: Kalibr's camchain, ROS's camera_info, OpenCV's FileStorage, COLMAP's cameras.txt.

Lens models that flockd also has are taken over exactly; for others the nearest lens is fitted.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic import ValidationError

from flockd.core.choices import LensModel
from flockd.core.config.document import document_of
from flockd.core.config.rig import CameraConfig, IntrinsicsConfig
from flockd.core.errors import ConfigError
from flockd.ground.calibration.board import CENTRE_PX, CalibrationError
from flockd.ground.calibration.fragment import measured_today
from flockd.ground.calibration.nearest_lens import DISTORTIONS, ForeignLens, nearest_lens

_FISHEYES = {"equidistant", "fisheye", "kannala_brandt", "kannala_brandt4"}
_PINHOLES = {"none", "plumb_bob", "radtan", "rational_polynomial"}
_COLMAP: Mapping[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("none", "f cx cy"),
    "PINHOLE": ("none", "fx fy cx cy"),
    "SIMPLE_RADIAL": ("plumb_bob", "f cx cy k1"),
    "RADIAL": ("plumb_bob", "f cx cy k1 k2"),
    "OPENCV": ("plumb_bob", "fx fy cx cy k1 k2 p1 p2"),
    "FULL_OPENCV": ("rational_polynomial", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_FISHEYE": ("equidistant", "f cx cy"),
    "FISHEYE": ("equidistant", "fx fy cx cy"),
    "SIMPLE_RADIAL_FISHEYE": ("equidistant", "f cx cy k1"),
    "RADIAL_FISHEYE": ("equidistant", "f cx cy k1 k2"),
    "OPENCV_FISHEYE": ("equidistant", "fx fy cx cy k1 k2 k3 k4"),
    "THIN_PRISM_FISHEYE": ("thin_prism_fisheye", "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s2"),
    "FOV": ("fov", "fx fy cx cy omega"),
    "SIMPLE_DIVISION": ("division", "f cx cy k"),
    "DIVISION": ("division", "fx fy cx cy k"),
    "EUCM": ("none", "fx fy cx cy alpha beta"),
}
"""The distortion of each model, and the names of its parameters."""
_KALIBR = {"pinhole": "", "omni": "xi", "ds": "xi alpha", "eucm": "alpha beta"}
"""Names of the parameters before fx, fy, cx, cy."""
_GIVE = "give Kalibr's camchain, ROS's camera_info, OpenCV's FileStorage or COLMAP's cameras.txt"


def foreign_lenses(file: Path, size: tuple[int, int] | None) -> list[ForeignLens]:
    """The cameras of a file; ``size``: of the images, where the file does not say it.

    Raises CalibrationError for what is no such file.
    """
    try:
        found = _read(file, size)
    except (cv2.error, SystemError) as error:  # SystemError: of XML that is cut
        raise CalibrationError(f"{file}: OpenCV cannot read it; write it again with cv2.FileStorage") from error
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{file}: is not text; name the file of a calibration") from error
    except OSError as error:
        raise CalibrationError(f"{file}: cannot be read ({error.strerror}); use another copy") from error
    except ConfigError as error:
        raise CalibrationError(f"{error.problems[0]}, or {_GIVE}") from error
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        told = str(error).replace("could not convert string to float:", "the number")
        raise CalibrationError(f"{file}: lacks or garbles {told}; {_GIVE}") from error
    for lens in found:
        if size not in {None, lens.size}:
            told = f"is of {lens.size[0]} x {lens.size[1]} images, and --size is another; leave it out"
            raise CalibrationError(f"{file}: {lens.name}: {told}")
    names = [lens.name for lens in found]
    if twice := [name for number, name in enumerate(names) if name in names[:number]]:
        raise CalibrationError(f"{file}: has two cameras of the name {twice[0]}; give each its own")
    if not found:
        raise CalibrationError(f"{file}: holds no camera; give Kalibr's camchain, or another calibration")
    return found


def _read(file: Path, size: tuple[int, int] | None) -> list[ForeignLens]:
    text = file.read_text(encoding="utf-8-sig")
    if re.search(r"^\s*\d+\s+[A-Z_]+\s+\d+\s+\d+\s", text, re.MULTILINE):
        return [_of_colmap(line.split()) for line in text.splitlines() if re.match(r"\s*\d", line)]
    if text.startswith("%YAML:1") or "opencv-matrix" in text or "opencv_storage" in text:
        return [_of_matrices(values, name, size) for name, values in _opencv(file)]
    document = document_of(re.sub(r"\n---\s*$", "\n", text), file, "calibration")
    if document.problems:
        raise CalibrationError(str(document.problems[0]))
    values: Mapping[str, Any] = document.values
    if {"width", "height"} <= values.keys():
        values = {_ECHOED.get(key.lower(), key): one for key, one in values.items()}
    if "rig" in values:
        raise CalibrationError(f"{file}: is a drone's own file; copy the cameras of its `rig`, they need no import")
    if "camera_matrix" in values:
        return [_of_matrices(values, file.stem, size)]
    return [_of_kalibr(name, one) for name, one in values.items() if isinstance(one, dict) and "intrinsics" in one]


def _lens(
    name: str, size: Any, label: str, model: str, numbers: Any, distortion: Any, shift: float = 0.0, skew: float = 0.0
) -> ForeignLens:
    """``numbers``: fx, fy, cx, cy, and xi, alpha, beta where the model has them; ``shift``: of pixel centres."""
    coefficients = tuple(float(k) for k in np.ravel(distortion))
    found = np.array([*map(float, numbers), *coefficients, skew])
    if [*map(float, size)] != [*map(int, size)]:
        raise ValueError(f"width and height of {name}, as whole numbers")
    if len(numbers) not in (4, 7) or not np.isfinite(found).all() or not found[:2].min() > 0:
        raise ValueError(f"fx, fy, cx, cy and coefficients of {name}, as finite numbers")
    fx, fy, cx, cy, *mirror = map(float, numbers)
    if len(size) != 2:
        raise ValueError(f"width and height of {name}")
    plain = re.sub("[^a-z0-9_-]", "_", name.lower())
    width, height = (int(value) for value in size)
    centre = cx + shift, cy + shift
    return ForeignLens(plain, (width, height), label, model, (fx, fy), centre, coefficients, skew, *mirror)


def _of_colmap(words: list[str]) -> ForeignLens:
    """CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS; pixel centres at +0.5."""
    name, label = f"camera{words[0]}", words[1]
    if label not in _COLMAP:
        return _lens(name, words[2:4], label, label, (1, 1, 0, 0), ())  # refused by its name
    model, names = _COLMAP[label]
    if len(words) != 4 + len(names.split()):
        raise ValueError(f"the parameters of {label}, {names}")
    found = dict(zip(names.split(), map(float, words[4:]), strict=True))
    focal = (found.get("fx", found.get("f", 0.0)), found.get("fy", found.get("f", 0.0)))
    distortion = [found.get(key, 0.0) for key in DISTORTIONS[model].split()]
    mirror = (0.0, found.get("alpha", 0.0), found.get("beta", 1.0))
    return _lens(name, words[2:4], label, model, (*focal, found["cx"], found["cy"], *mirror), distortion)


def _of_kalibr(name: str, values: Mapping[str, Any]) -> ForeignLens:
    camera, numbers = values["camera_model"], list(values["intrinsics"])
    model, distortion = values.get("distortion_model", "none"), values.get("distortion_coeffs")
    if distortion is None and model != "none":
        raise ValueError(f"distortion_coeffs of {name}, for its {model}")
    if camera not in _KALIBR:
        return _lens(name, values["resolution"], camera, camera, (1, 1, 0, 0), ())
    names = _KALIBR[camera].split()
    if len(numbers) != len(names) + 4:
        raise ValueError(f"the intrinsics of {name}, {' '.join([*names, 'fx fy cx cy'])}")
    found = dict(zip(names, numbers, strict=False))
    mirror = (found.get("xi", 0.0), found.get("alpha", 0.0), found.get("beta", 1.0))
    label = f"{camera}-{model}"
    return _lens(name, values["resolution"], label, model, (*numbers[-4:], *mirror), distortion or (), CENTRE_PX)


def _of_matrices(values: Mapping[str, Any], name: str, size: tuple[int, int] | None) -> ForeignLens:
    """Of ROS and OpenCV."""
    matrix = np.array(_data(values["camera_matrix"]), np.float64)
    if matrix.size != 9 or not matrix.any():
        raise ValueError(f"the camera_matrix, {matrix.size} numbers{'' if matrix.any() else ' that are 0'}")
    matrix = matrix.reshape(3, 3)
    if [*matrix[2], matrix[1, 0]] != [0.0, 0.0, 1.0, 0.0]:
        raise ValueError("the camera_matrix, whose rows are fx s cx, 0 fy cy and 0 0 1")
    if "distortion_coefficients" not in values:
        raise ValueError("the distortion, as distortion_coefficients or D; zeros if there is none")
    distortion = _data(values["distortion_coefficients"])
    roi = values.get("roi") or {}
    if max(values.get("binning_x", 0), values.get("binning_y", 0)) > 1 or any(roi.get(key) for key in _OFFSETS):
        raise ValueError("a lens of whole images, as it is of a part of them (roi) or of summed pixels (binning)")
    if "image_width" in values:
        size = values["image_width"], values["image_height"]
    if size is None:
        raise ValueError("the size of the images, which --size gives")
    model = label = values.get("distortion_model") or "plumb_bob"
    numbers = [*matrix[[0, 1, 0, 1], [0, 1, 2, 2]]]
    if "xi" in values:
        label, numbers = "omnidir", [*numbers, values["xi"], 0.0, 1.0]
    name = str(values.get("camera_name", name))
    return _lens(name, size, label, model, numbers, distortion, CENTRE_PX, float(matrix[0, 1]))


_OFFSETS = ("x_offset", "y_offset")
_NAMES: Mapping[str, tuple[str, ...]] = {
    "camera_matrix": ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M1"),
    "distortion_coefficients": ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "D", "D1"),
    "image_width": ("image_width", "image_Width"),
    "image_height": ("image_height", "image_Height"),
    "xi": ("xi",),
}
"""What OpenCV's programs and tutorials call them."""
_OF_EITHER = 4
"""Coefficients that `cv2.calibrateCamera` may give, and `cv2.fisheye.calibrate` always gives."""
_ECHOED = {"k": "camera_matrix", "d": "distortion_coefficients", "width": "image_width", "height": "image_height"}
"""As `ros2 topic echo` and `rostopic echo` print a CameraInfo."""


def _data(matrix: Any) -> Any:
    return matrix["data"] if isinstance(matrix, dict) else matrix


def _opencv(file: Path) -> list[tuple[str, dict[str, Any]]]:
    """What `cv2.FileStorage` wrote, under ROS's names: of one camera, or the two of OpenCV's stereo calibration."""
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    if storage.getNode("M2").empty():
        return [(file.stem, _stored(storage, _NAMES))]
    pair = (("1", _NAMES), ("2", {**_NAMES, "camera_matrix": ("M2",), "distortion_coefficients": ("D2",)}))
    return [(f"{file.stem}{number}", _stored(storage, names)) for number, names in pair]


def _stored(storage: cv2.FileStorage, known: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    there = {key: name for key, names in known.items() for name in names if not storage.getNode(name).empty()}
    found: dict[str, Any] = {}
    for key, name in there.items():
        node = storage.getNode(name)
        if key == "xi":
            found[key] = node.real() if node.isReal() else float(node.mat()[0, 0])
        else:
            found[key] = int(node.real()) if key.startswith("image") else {"data": node.mat().ravel().tolist()}
    fisheye = storage.getNode("fisheye_model")
    if (
        fisheye.empty()
        and "xi" not in found
        and len(found.get("distortion_coefficients", {"data": ()})["data"]) == _OF_EITHER
    ):
        raise ValueError("fisheye_model, 0 or 1: of 4 coefficients a pinhole and a fisheye have other meanings")
    if not fisheye.empty() and fisheye.real():
        found["distortion_model"] = "equidistant"
    return found


@dataclass(frozen=True)
class Imported:
    """A camera as configuration, and the difference of its lens from the file's over the image."""

    camera: CameraConfig
    off_deg: float = 0.0
    """Largest difference, degrees; 0 for the same lens."""
    rms_deg: float = 0.0


def camera_of_lens(lens: ForeignLens, file: Path, *, nearest: bool) -> Imported:
    """As flockd has it.

    Raises CalibrationError for an impossible lens, and for a model that flockd lacks unless ``nearest`` permits a fit.
    """
    where, count = f"{file}: {lens.name}", len(lens.distortion)
    model: LensModel = "wide_angle" if lens.model in _FISHEYES else "pinhole"
    known = {*_FISHEYES, *DISTORTIONS}
    if lens.model not in known:
        raise CalibrationError(
            f"{where}: has the lens model {lens.model}, which is not known; calibrate it again with one of "
            f"{', '.join(sorted(known))}"
        )
    same = lens.model in {*_FISHEYES, *_PINHOLES} and count in ((0, 4) if model == "wide_angle" else (0, 4, 5))
    if same and lens.is_pinhole and lens.skew == 0.0:
        return Imported(_config(lens, file, model, (*lens.focal, *lens.centre), lens.distortion))
    fit = nearest_lens(lens, where)
    if not nearest:
        told = f" of {count} coefficients" * (count > 4) + f" with a skew of {lens.skew:g} px" * (lens.skew != 0.0)
        raise CalibrationError(
            f"{where}: its {lens.label}{told} has no equivalent; the nearest {fit.model} is {fit.off_deg:.3f} degrees "
            f"off at most, {fit.rms_deg:.3f} RMS over the image, and --nearest takes it"
        )
    return Imported(_config(lens, file, fit.model, fit.numbers[:4], fit.numbers[4:]), fit.off_deg, fit.rms_deg)


def _config(lens: ForeignLens, file: Path, model: LensModel, numbers: Any, distortion: Any) -> CameraConfig:
    measured = measured_today(camera=f"{lens.name} of {file.name}", source=str(file), views=1)
    fx, fy, cx, cy = (round(float(value), 4) for value in numbers)
    kept = tuple(round(float(k), 8) for k in distortion)
    try:
        intrinsics = IntrinsicsConfig(model=model, fx=fx, fy=fy, cx=cx, cy=cy, distortion=kept, measured=measured)
        return CameraConfig(name=lens.name, size_px=lens.size, intrinsics=intrinsics)
    except ValidationError as error:
        first = error.errors()[0]
        key, told = ".".join(map(str, first["loc"])), first["msg"]
        if first["loc"][0] == "size_px":
            key, told = "size", f"{lens.size[0]} x {lens.size[1]} is not of 32 to 8192 pixels a side; correct it"
        raise CalibrationError(f"{file}: {lens.name}: {key}: {told}") from None
