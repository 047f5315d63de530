"""Calibrations by other programs give rays that OpenCV gives for them. OpenCV and ROS have whole pixel centres."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flockd.cli import main
from flockd.core.config import load_drone
from flockd.core.config.document import read_document
from flockd.core.errors import ConfigError
from flockd.core.messages import FloatArray
from flockd.flight.geometry import build_rig

Capture = pytest.CaptureFixture[str]
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


def _filled(text: str, coefficients: list[float], **words: str) -> str:
    for word, value in {**words, "COEFFICIENTS": str(coefficients)}.items():
        text = text.replace(word, value)
    return text


def _points() -> FloatArray:
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 7))
    return np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)


@pytest.mark.parametrize(
    ("text", "coefficients", "matrix", "fisheye"),
    [
        (_filled(ROS, PINHOLE, MODEL="plumb_bob"), PINHOLE, K, False),
        (_filled(ROS, FISHEYE, MODEL="equidistant"), FISHEYE, K, True),
        (_filled(KALIBR, PINHOLE[:4], MODEL="radtan", CAMERA="pinhole"), PINHOLE[:4], K, False),
        (_filled(KALIBR, FISHEYE, MODEL="equidistant", CAMERA="pinhole"), FISHEYE, K, True),
        (COLMAP, PINHOLE[:4], K, False),
    ],
    ids=["ros", "ros fisheye", "kalibr", "kalibr fisheye", "colmap"],
)
def test_points_are_where_opencv_images_them(
    text: str, coefficients: list[float], matrix: FloatArray, fisheye: bool, tmp_path: Path
) -> None:
    (tmp_path / "theirs.yaml").write_text(text, encoding="utf-8")
    out = tmp_path / "ours.yaml"
    assert main(["calibrate", "import", str(tmp_path / "theirs.yaml"), "--out", str(out)]) == 0
    (name, *_) = (rig := build_rig(load_drone(out).rig)).cameras
    still, project = np.zeros(3), cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    pixels: Any = project(_points()[:, None], still, still, matrix, np.array(coefficients))[0]
    np.testing.assert_allclose(rig.cameras[name].camera.project(_points()), pixels.reshape(-1, 2) + 0.5, atol=1e-3)


def test_what_opencv_stores_is_read_under_its_names_and_needs_a_size(tmp_path: Path, capsys: Capture) -> None:
    file, out = tmp_path / "lens.yml", tmp_path / "ours.yaml"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("K", K)
    storage.write("D", np.array(PINHOLE))
    storage.release()
    assert main(["calibrate", "import", str(file), "--out", str(out)]) == 1
    assert "lacks or garbles the size of the images, which --size gives" in capsys.readouterr().err
    assert main(["calibrate", "import", str(file), "--out", str(out), "--size", "640x480"]) == 0
    (camera,) = load_drone(out).rig.cameras
    assert (camera.size_px, camera.intrinsics.cx, camera.intrinsics.distortion) == ((640, 480), 324.6, tuple(PINHOLE))


def test_a_lens_without_an_equal_is_refused_with_how_far_the_nearest_is_off(tmp_path: Path, capsys: Capture) -> None:
    """Against what OpenCV undistorts, of 8 coefficients."""
    file, out = tmp_path / "theirs.yaml", tmp_path / "ours.yaml"
    file.write_text(_filled(ROS, RATIONAL, MODEL="rational_polynomial"), encoding="utf-8")
    assert main(["calibrate", "import", str(file), "--out", str(out)]) == 1
    assert "its rational_polynomial of 8 coefficients has no equivalent; the nearest" in capsys.readouterr().err
    assert main(["calibrate", "import", str(file), "--out", str(out), "--nearest", "--json"]) == 0
    off_deg = json.loads(capsys.readouterr().out)["cameras"][0]["off_deg"]
    camera = build_rig(load_drone(out).rig).cameras["head_camera"].camera
    pixels = np.array([[10.5, 10.5], [320.5, 240.5], [600.5, 100.5], [639.5, 479.5]])
    exactly = (cv2.TERM_CRITERIA_COUNT, 200, 0.0)
    plane: Any = cv2.undistortPoints(pixels[:, None] - 0.5, K, np.array(RATIONAL), None, None, None, exactly)
    theirs = np.concatenate([plane.reshape(-1, 2), np.ones((4, 1))], axis=1)
    cosines = np.sum(theirs / np.linalg.norm(theirs, axis=1, keepdims=True) * camera.rays(pixels), axis=1)
    assert 0 < np.degrees(np.arccos(cosines.min())) <= off_deg + 1e-3
    assert off_deg < 0.05


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (_filled(KALIBR, [], MODEL="none", CAMERA="omni"), "cam0: has the lens model omni, which is not known"),
        (_filled(KALIBR, [0.9], MODEL="fov", CAMERA="pinhole"), "cam0: has the lens model fov, which is not known"),
        ("1 THIN_PRISM_FISHEYE 640 480 1 2 3\n", "camera1: has the lens model THIN_PRISM_FISHEYE"),
        (
            _filled(ROS, PINHOLE, MODEL="plumb_bob").replace("640", "320"),
            "head_camera: intrinsics.cx: 324.6 is 51% of the image",
        ),
        ("cam0: 5\n", "holds no camera; give Kalibr's camchain"),
        ("rig: {}\n", "is a drone's own file; copy the cameras of its `rig`"),
        ("just a text\n", "lacks or garbles keys with values; give Kalibr's camchain"),
        (
            _filled(KALIBR, [], MODEL="none", CAMERA="pinhole").replace(", 324.1, 235.0]", "]"),
            "lacks or garbles fx, fy, cx, cy and coefficients of cam0",
        ),
        (_filled(KALIBR, [0.1, 0, 0, math.nan], MODEL="radtan", CAMERA="pinhole").replace("nan", ".nan"), "finite"),
        ("1 OPENCV 640 480 1 2 3\n", "lacks or garbles the parameters of OPENCV, fx fy cx cy k1 k2 p1 p2"),
        ("camera_matrix: 3\n", "give Kalibr's camchain"),
        ("camera_matrix: {data: [1, 2]}\n", "lacks or garbles the camera_matrix, 2 numbers; give Kalibr's camchain"),
        (f"camera_matrix: {{data: {[0] * 9}}}\n", "the camera_matrix, 9 numbers that are 0; give Kalibr's camchain"),
        ("[\n", "cannot be read ("),
        ("%YAML:1.0\n---\nK: 3\n", "OpenCV cannot read it; write it again"),
    ],
)
def test_what_cannot_be_taken_is_said_in_one_sentence(text: str, told: str, tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "theirs.yaml").write_text(text, encoding="utf-8")
    assert main(["calibrate", "import", str(tmp_path / "theirs.yaml"), "--out", str(tmp_path / "ours.yaml")]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert told in error
    assert not (tmp_path / "ours.yaml").exists()


@pytest.mark.parametrize("text", [ROS, KALIBR, "%YAML:1.0\n---\nK: 3\n"])
def test_where_a_drones_file_is_needed_a_calibration_is_known_as_one(text: str, tmp_path: Path) -> None:
    (tmp_path / "theirs.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="is another program's calibration; `flockd calibrate import FILE` gives its"):
        read_document(tmp_path / "theirs.yaml")
