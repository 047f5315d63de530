"""Calibrations by other programs give rays that OpenCV gives for them. OpenCV and ROS have whole pixel centres."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flockd.core.config import load_drone
from flockd.core.config.document import read_document
from flockd.core.errors import ConfigError
from flockd.core.messages import FloatArray
from flockd.flight.geometry import build_rig
from tests.conftest import Told

Imported = Callable[..., str]
K = np.array([[652.3, 0.0, 324.1], [0.0, 647.9, 235.0], [0.0, 0.0, 1.0]])
PINHOLE = [-0.15, 0.136, 0.0035, 0.0083, -0.34]
FISHEYE = [0.0035, 0.0007, -0.002, 0.0002]
RATIONAL = [0.11, -0.02, 0.0003, -0.0002, 0.003, 0.42, -0.03, 0.001]
ROWS = "[652.3, 0., 324.1, 0., 647.9, 235.0, 0., 0., 1.]"
ROS = f"""\
image_width: 640
image_height: 480
camera_name: Head Camera
camera_matrix: {{rows: 3, cols: 3, data: {ROWS}}}
distortion_model: MODEL
distortion_coefficients: {{rows: 1, cols: 5, data: COEFFICIENTS}}
"""
KALIBR = """\
cam0:
  camera_model: CAMERA
  distortion_coeffs: COEFFICIENTS
  distortion_model: MODEL
  intrinsics: [652.3, 647.9, 324.1, 235.0]
  resolution: [640, 480]
"""
COLMAP = """\
# Camera list with one line of data per camera:
1 OPENCV 640 480 652.3 647.9 324.6 235.5 -0.15 0.136 0.0035 0.0083
2 SIMPLE_RADIAL 640 480 650 320 240 -0.1
"""
"""Pixel centres at +0.5."""
ECHOED = f"""\
header: {{stamp: {{sec: 1, nanosec: 2}}, frame_id: front}}
height: 480
width: 640
distortion_model: plumb_bob
d: {PINHOLE}
k: {ROWS}
r: [1, 0, 0, 0, 1, 0, 0, 0, 1]
---
"""


def _filled(text: str, coefficients: list[float], **words: str) -> str:
    for word, value in {**words, "COEFFICIENTS": str(coefficients)}.items():
        text = text.replace(word, value)
    return text


def _points() -> FloatArray:
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 7))
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)


@pytest.fixture
def imported(tmp_path: Path, told: Told) -> Imported:
    """What `flockd calibrate import` says of a file, or of one with this text, that it writes to `ours.yaml`."""

    def run(code: int, given: str | Path, *options: object) -> str:
        file = given if isinstance(given, Path) else tmp_path / "theirs.yaml"
        if isinstance(given, str):
            file.write_text(given, encoding="utf-8")
        return told(code, "calibrate", "import", file, "--out", tmp_path / "ours.yaml", *options)

    return run


def stored(file: Path, **values: Any) -> Path:
    """As OpenCV's programs write it."""
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value if isinstance(value, int) else np.array(value))
    storage.release()
    return file


@pytest.mark.parametrize(
    ("text", "coefficients", "matrix", "fisheye"),
    [
        (_filled(ROS, PINHOLE, MODEL="plumb_bob"), PINHOLE, K, False),
        (_filled(ROS, FISHEYE, MODEL="equidistant"), FISHEYE, K, True),
        (_filled(KALIBR, PINHOLE[:4], MODEL="radtan", CAMERA="pinhole"), PINHOLE[:4], K, False),
        (_filled(KALIBR, FISHEYE, MODEL="equidistant", CAMERA="pinhole"), FISHEYE, K, True),
        (COLMAP, PINHOLE[:4], K, False),
        (ECHOED, PINHOLE, K, False),
        (ECHOED.replace("k:", "K:").replace("d:", "D:").replace("---", ""), PINHOLE, K, False),
    ],
    ids=["ros", "ros fisheye", "kalibr", "kalibr fisheye", "colmap", "ros2 topic echo", "rostopic echo"],
)
def test_points_are_where_opencv_images_them(
    text: str, coefficients: list[float], matrix: FloatArray, fisheye: bool, tmp_path: Path, imported: Imported
) -> None:
    imported(0, text)
    (name, *_) = (rig := build_rig(load_drone(tmp_path / "ours.yaml").rig)).cameras
    still, project = np.zeros(3), cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    pixels: Any = project(_points()[:, None], still, still, matrix, np.array(coefficients))[0]
    np.testing.assert_allclose(rig.cameras[name].camera.project(_points()), pixels.reshape(-1, 2) + 0.5, atol=1e-3)


def test_what_opencv_stores_is_read_under_its_names_and_needs_a_size(tmp_path: Path, imported: Imported) -> None:
    file = stored(tmp_path / "lens.yml", K=K, D=PINHOLE)
    assert "lacks or garbles the size of the images, which --size gives" in imported(1, file)
    imported(0, file, "--size", "640x480")
    (camera,) = load_drone(tmp_path / "ours.yaml").rig.cameras
    assert (camera.size_px, camera.intrinsics.cx, camera.intrinsics.distortion) == ((640, 480), 324.6, tuple(PINHOLE))


def test_both_cameras_of_opencvs_stereo_calibration_are_read(tmp_path: Path, imported: Imported) -> None:
    imported(0, stored(tmp_path / "pair.yml", M1=K, D1=PINHOLE, M2=K, D2=PINHOLE), "--size", "640x480")
    found = {camera.name: camera.intrinsics.distortion for camera in load_drone(tmp_path / "ours.yaml").rig.cameras}
    assert found == {"pair1": tuple(PINHOLE), "pair2": tuple(PINHOLE)}


def test_four_coefficients_of_opencv_are_of_the_lens_that_the_file_names(tmp_path: Path, imported: Imported) -> None:
    size = ("--size", "640x480")
    assert "lacks or garbles fisheye_model, 0 or 1: of 4" in imported(
        1, stored(tmp_path / "a.yml", K=K, D=FISHEYE), *size
    )
    for fisheye, model in enumerate(("pinhole", "wide_angle")):
        file = stored(tmp_path / f"{model}.yml", K=K, D=FISHEYE, fisheye_model=fisheye)
        imported(0, file, *size, "--force")
        (camera,) = load_drone(tmp_path / "ours.yaml").rig.cameras
        assert camera.intrinsics.model == model


def test_a_distortion_under_an_unknown_name_is_not_taken_for_none(tmp_path: Path, imported: Imported) -> None:
    file = stored(tmp_path / "lens.yml", camera_matrix=K, dist_coeffs=PINHOLE)
    assert "lacks or garbles the distortion, as distortion_coefficients or D" in imported(1, file, "--size", "640x480")


def test_another_size_than_the_files_is_refused(imported: Imported) -> None:
    told_of = imported(1, COLMAP, "--size", "1280x960")
    assert "camera1: is of 640 x 480 images, and --size is another; leave it out" in told_of


def _brown(plane: FloatArray, k: list[float], prism: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
    """OpenCV's k1 k2 p1 p2 k3, and COLMAP's k4 of r^8 and thin prism."""
    (x, y), (k1, k2, p1, p2, k3, k4) = plane.T, [*k, 0.0, 0.0][:6]
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + prism[0] * r2,
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y**2) + prism[1] * r2,
        ],
        axis=1,
    )


def _mei(rays: FloatArray) -> FloatArray:
    return _brown(rays[:, :2] / (rays[:, 2:] + 1.2), [-0.1, 0.03, 0.001, -0.002])


def _double_sphere(rays: FloatArray) -> FloatArray:
    shifted = rays + np.array([0.0, 0.0, -0.2])  # by xi; |rays| is 1
    depth = 0.59 * np.linalg.norm(shifted, axis=1, keepdims=True) + 0.41 * shifted[:, 2:]
    return np.asarray(rays[:, :2] / depth)


def _eucm(rays: FloatArray) -> FloatArray:
    far = np.sqrt(1.1 * np.sum(rays[:, :2] ** 2, axis=1, keepdims=True) + rays[:, 2:] ** 2)
    return np.asarray(rays[:, :2] / (0.6 * far + 0.4 * rays[:, 2:]))


def _fov(rays: FloatArray) -> FloatArray:
    plane = rays[:, :2] / rays[:, 2:]
    radius = np.linalg.norm(plane, axis=1, keepdims=True)
    return np.asarray(plane * np.arctan(2 * radius * math.tan(0.45)) / (0.9 * radius))


def _thin_prism(rays: FloatArray) -> FloatArray:
    angle = np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2])
    plane = rays[:, :2] * (angle / np.sin(angle))[:, None]
    return _brown(plane, [0.02, -0.01, 0.003, -0.001, 0.002, -0.0004], (0.004, -0.003))


def _division(rays: FloatArray) -> FloatArray:
    flat = np.sum(rays[:, :2] ** 2, axis=1, keepdims=True)
    return np.asarray(2 * rays[:, :2] / (rays[:, 2:] + np.sqrt(rays[:, 2:] ** 2 + 4 * 0.25 * flat)))


def _rational(rays: FloatArray) -> FloatArray:
    found: Any = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), np.eye(3), np.array(RATIONAL))[0]
    return np.asarray(found.reshape(-1, 2), np.float64)


def test_an_omnidirectional_lens_of_opencv_has_its_xi_and_its_skew(tmp_path: Path, imported: Imported) -> None:
    """As `cv2.omnidir.calibrate` gives them, at whole pixel centres."""
    matrix = np.array([[450.0, 20.0, 322.0], [0.0, 452.0, 241.0], [0.0, 0.0, 1.0]])
    coefficients = [[-0.1, 0.03, 0.001, -0.002]]
    file = stored(tmp_path / "lens.yml", camera_matrix=matrix, distortion_coefficients=coefficients, xi=[[1.2]])
    refused = imported(1, file, "--size", "640x480")
    assert "its omnidir with a skew of 20 px has no equivalent; the nearest wide_angle" in refused
    (camera,) = json.loads(imported(0, file, "--size", "640x480", "--nearest", "--json"))["cameras"]
    off_deg = camera["off_deg"]
    assert off_deg < 4
    (mounted,) = build_rig(load_drone(tmp_path / "ours.yaml").rig).cameras.values()
    rays = _points() / np.linalg.norm(_points(), axis=1, keepdims=True)
    pixels = np.column_stack([_mei(rays), np.ones(len(rays))]) @ matrix.T + 0.5
    cosines = np.sum(mounted.camera.rays(pixels[:, :2]) * rays, axis=1)
    assert np.degrees(np.arccos(cosines.min())) < off_deg


def _kalibr(camera: str, model: str, coefficients: list[float], numbers: list[float]) -> str:
    text = KALIBR.replace("[652.3, 647.9, 324.1, 235.0]", str(numbers))
    return _filled(text, coefficients, CAMERA=camera, MODEL=model)


OMNI = _kalibr("omni", "radtan", [-0.1, 0.03, 0.001, -0.002], [1.2, 450, 452, 322, 241])
DOUBLE = _kalibr("ds", "none", [], [-0.2, 0.59, 250, 251, 322, 241])
UNIFIED = _kalibr("eucm", "none", [], [0.6, 1.1, 300, 301, 322, 241])
PRISM = "1 THIN_PRISM_FISHEYE 640 480 300 301 322 241 0.02 -0.01 0.003 -0.001 0.002 -0.0004 0.004 -0.003\n"


@pytest.mark.parametrize(
    ("text", "theirs", "focal_px", "centre_px", "most_deg", "model"),
    [
        (_filled(ROS, RATIONAL, MODEL="rational_polynomial"), _rational, (652.3, 647.9), (324.6, 235.5), 60, "pinhole"),
        (OMNI, _mei, (450, 452), (322.5, 241.5), 110, "wide_angle"),
        (DOUBLE, _double_sphere, (250, 251), (322.5, 241.5), 110, "wide_angle"),
        (UNIFIED, _eucm, (300, 301), (322.5, 241.5), 100, "wide_angle"),
        (_filled(KALIBR, [0.9], CAMERA="pinhole", MODEL="fov"), _fov, (652.3, 647.9), (324.6, 235.5), 60, "pinhole"),
        (PRISM, _thin_prism, (300, 301), (322, 241), 85, "wide_angle"),
        ("1 DIVISION 640 480 500 501 322 241 -0.25\n", _division, (500, 501), (322, 241), 60, ""),
        ("1 EUCM 640 480 300 301 322 241 0.6 1.1\n", _eucm, (300, 301), (322, 241), 85, "wide_angle"),
    ],
    ids=["rational", "mei", "double sphere", "eucm", "fov", "thin prism", "division", "colmap eucm"],
)
def test_a_lens_without_an_equal_is_refused_with_how_far_the_nearest_is_off(
    text: str,
    theirs: Callable[[FloatArray], FloatArray],
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
    most_deg: float,
    model: str,
    tmp_path: Path,
    imported: Imported,
) -> None:
    """Against each model's published projection, of directions all over the image."""
    refused = imported(1, text)
    (result,) = json.loads(imported(0, text, "--nearest", "--json"))["cameras"]
    off_deg, rms_deg = result["off_deg"], result["rms_deg"]
    assert f"nearest {result['intrinsics']['model']} is {off_deg:.3f} degrees off at most, {rms_deg:.3f} RMS" in refused
    assert model in refused
    (mounted,) = build_rig(load_drone(tmp_path / "ours.yaml").rig).cameras.values()
    angle, turn = (grid.ravel() for grid in np.mgrid[0.2:most_deg:400j, 0 : 2 * math.pi : 720j])
    angle = np.radians(angle)
    rays = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    pixels = theirs(rays) * focal_px + centre_px
    seen = np.all((pixels > 0) & (pixels < (640, 480)), axis=1)
    assert np.degrees(angle[seen]).max() > most_deg / 3
    cosines = np.sum(mounted.camera.rays(pixels[seen]) * rays[seen], axis=1)
    off = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    assert off.max() == pytest.approx(off_deg, rel=0.1, abs=2e-3)
    area = (pixels[seen] // 20).astype(int)  # as pixels count, not directions
    _, of, counts = np.unique(area, axis=0, return_inverse=True, return_counts=True)
    rms = math.sqrt(np.average(off**2, weights=1 / counts[of.ravel()]))
    assert rms == pytest.approx(rms_deg, rel=0.1, abs=1e-3)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (_filled(KALIBR, [], MODEL="none", CAMERA="unified"), "cam0: has the lens model unified, which is not known"),
        (_filled(KALIBR, [0.9], MODEL="wave", CAMERA="pinhole"), "cam0: has the lens model wave, which is not known"),
        (_filled(KALIBR, [0.9], MODEL="none", CAMERA="omni"), "the intrinsics of cam0, xi fx fy cx cy; give Kalibr's"),
        (_filled(KALIBR, [0.9, 1], MODEL="fov", CAMERA="pinhole"), "cam0: there is no lens with 2 coefficients of"),
        ("1 EUCM 640 480 300 301 322 241 0.6 90000\n", "camera1: by its parameters it images hardly anything"),
        (
            _filled(ROS, PINHOLE, MODEL="plumb_bob").replace("[652.3, 0.", "[652.3, 9."),
            "its plumb_bob of 5 coefficients with a skew of 9 px has no",
        ),
        ("1 RAD_TAN_THIN_PRISM_FISHEYE 640 480 1 2 3\n", "camera1: has the lens model RAD_TAN_THIN_PRISM_FISHEYE"),
        (_filled(ROS, PINHOLE, MODEL="plumb_bob").replace("640", "320"), "head_camera: intrinsics.cx: 324.6 is 51%"),
        ("cam0: 5\n", "holds no camera; give Kalibr's camchain"),
        (_filled(ROS, PINHOLE, MODEL="plumb_bob").replace("640", "640.5"), "width and height of Head Camera, as whole"),
        (_filled(ROS, PINHOLE, MODEL="plumb_bob").replace("640", "-640"), "head_camera: size: -640 x 480 is not of 32"),
        (ECHOED + ECHOED, "a second document begins here; keep one in a file"),
        (
            _filled(KALIBR, [], MODEL="none", CAMERA="pinhole") * 2,
            "theirs.yaml:7: cam0: is given twice, first in line 1",
        ),
        ("Calibration results\n    type: <class 'a'>\n", "theirs.yaml:2: this cannot stand here"),
        (COLMAP.replace("0.0035", "0,0035"), "garbles the number '0,0035'; give Kalibr's camchain"),
        (_filled(ROS, PINHOLE, MODEL="plumb_bob").replace("0., 1.]", "0., 2.]"), "rows are fx s cx, 0 fy cy and 0 0 1"),
        ("<?xml version='1.0'?>\n<opencv_storage><K type_id='opencv-matrix'><rows>3", "OpenCV cannot read it"),
        ("1 PINHOLE 640 480 650 650 320 240\n" * 2, "has two cameras of the name camera1; give each its own"),
        ("rig: {}\n", "is a drone's own file; copy the cameras of its `rig`"),
        (
            "just a text\n",
            "is a single value at its top level; write keys with values, such as `seed: 0`, or give Kalib",
        ),
        (_filled(KALIBR, [], MODEL="none", CAMERA="pinhole").replace(", 324.1, 235.0]", "]"), "of cam0, fx fy cx cy;"),
        (_filled(KALIBR, [0.1, 0, 0, math.nan], MODEL="radtan", CAMERA="pinhole").replace("nan", ".nan"), "finite"),
        ("1 OPENCV 640 480 1 2 3\n", "lacks or garbles the parameters of OPENCV, fx fy cx cy k1 k2 p1 p2"),
        ("camera_matrix: {data: [1, 2]}\n", "lacks or garbles the camera_matrix, 2 numbers; give Kalibr's camchain"),
        (f"camera_matrix: {{data: {[0] * 9}}}\n", "the camera_matrix, 9 numbers that are 0; give Kalibr's camchain"),
        ("[\n", "a bracket is opened here and not closed properly"),
        (
            ROS.replace("distortion_coefficients", "dist").replace("COEFFICIENTS", "[0]"),
            "lacks or garbles the distortion",
        ),
        (
            _filled(KALIBR, [0.1], MODEL="radtan", CAMERA="pinhole").replace("_coeffs", ""),
            "distortion_coeffs of cam0, for",
        ),
        (_filled(ROS, PINHOLE, MODEL="plumb_bob") + "roi: {x_offset: 9}\n", "lens of whole images, as it is of a part"),
        (_filled(ROS, PINHOLE, MODEL="plumb_bob") + "binning_x: 2\n", "a lens of whole images"),
        ("%YAML:1.0\n---\nK: 3\n", "OpenCV cannot read it; write it again"),
    ],
)
def test_what_cannot_be_taken_is_said_in_one_sentence(
    text: str, sentence: str, tmp_path: Path, imported: Imported
) -> None:
    assert sentence in imported(1, text)
    assert not (tmp_path / "ours.yaml").exists()


@pytest.mark.parametrize("text", [ROS, KALIBR, "%YAML:1.0\n---\nK: 3\n"])
def test_where_a_drones_file_is_needed_a_calibration_is_known_as_one(text: str, tmp_path: Path) -> None:
    (tmp_path / "theirs.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="is another program's calibration; `flockd calibrate import FILE` gives its"):
        read_document(tmp_path / "theirs.yaml")
