"""Lens models that flockd has not, from their published equations, and the lens of flockd nearest to one."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from flockd.core.choices import LENS_MODELS, LensModel
from flockd.core.config.rig import WIDEST_DEG
from flockd.core.messages import FloatArray
from flockd.flight.geometry import PinholeCamera, WideAngleCamera
from flockd.ground.calibration.board import CalibrationError

DISTORTIONS = {
    "none": "",
    "plumb_bob": "k1 k2 p1 p2",
    "radtan": "k1 k2 p1 p2",
    "rational_polynomial": "k1 k2 p1 p2 k3 k4 k5 k6",
    "equidistant": "k1 k2 k3 k4",
    "thin_prism_fisheye": "k1 k2 p1 p2 k3 k4 s1 s2",
    "fov": "omega",
    "division": "k",
}
"""The coefficients of each, in their order."""
_GRID = 25
"""Points along each side of an image at which lenses are compared."""
_ROUNDS = 200
"""Of an inversion by fixed point."""


@dataclass(frozen=True)
class ForeignLens:
    """One camera of a file, with pixel centres at +0.5."""

    name: str
    size: tuple[int, int]
    label: str
    """The file's own word."""
    model: str
    """Of its distortion, as in `DISTORTIONS`."""
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, ...]
    skew: float = 0.0
    """Of the camera matrix, in pixels."""
    xi: float = 0.0
    alpha: float = 0.0
    beta: float = 1.0
    """Of a double sphere (xi, alpha), of EUCM (alpha, beta) or of an omnidirectional camera (xi, by C. Mei)."""

    @property
    def is_pinhole(self) -> bool:
        """Whether xi, alpha and beta are a pinhole's."""
        return (self.xi, self.alpha, self.beta) == (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class NearestLens:
    """The lens of flockd that fits best."""

    model: LensModel
    numbers: FloatArray
    """fx, fy, cx, cy, then the distortion."""
    off_deg: float
    """Largest angle between the directions of both lenses over the image."""
    rms_deg: float


def nearest_lens(lens: ForeignLens, where: str) -> NearestLens:
    """Fits each lens model of flockd over the image by least squares. Raises CalibrationError if none can be fitted."""
    sides = [np.linspace(0.5, side - 0.5, _GRID) for side in lens.size]
    pixels = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    try:
        rays = _rays(lens, pixels)
    except (cv2.error, ValueError) as error:
        told = f"{len(lens.distortion)} coefficients of {lens.label}"
        raise CalibrationError(f"{where}: there is no lens with {told}; check the file") from error
    imaged = np.isfinite(rays).all(axis=1)
    if imaged.sum() < _GRID:
        raise CalibrationError(f"{where}: by its parameters it images hardly anything; check the file")
    narrow = rays[imaged, 2].min() > np.cos(np.radians(WIDEST_DEG["pinhole"] / 2))
    fits = [_fitted(one, lens, pixels[imaged], rays[imaged]) for one in LENS_MODELS if narrow or one != "pinhole"]
    fits = [fit for fit in fits if np.isfinite(fit.off_deg)]
    if not fits:
        raise CalibrationError(f"{where}: no lens of flockd images all that this {lens.label} does; crop its images")
    return min(fits, key=lambda fit: fit.off_deg)


def _rays(lens: ForeignLens, pixels: FloatArray) -> FloatArray:
    """Unit vectors (n, 3) of pixels (n, 2), NaN where the lens images nothing.

    The double sphere (V. Usenko and others, "The double sphere camera model", 2018, Eq. 46-52) is Mei's model for an
    alpha of 0. Its depth is that of EUCM (B. Khomutenko and others, 2016) for a beta of 1.
    """
    y = (pixels[:, 1] - lens.centre[1]) / lens.focal[1]
    x = (pixels[:, 0] - lens.centre[0] - lens.skew * y) / lens.focal[0]
    xi, alpha, beta = lens.xi, lens.alpha, lens.beta
    with np.errstate(all="ignore"):
        plane = _undistorted(np.stack([x, y], axis=1), lens)
        square = np.sum(plane * plane, axis=1)
        root = np.sqrt(1.0 - (2.0 * alpha - 1.0) * beta * square)
        depth = (1.0 - beta * alpha**2 * square) / (alpha * root + 1.0 - alpha)
        scale = (depth * xi + np.sqrt(depth**2 + (1.0 - xi**2) * square)) / (depth**2 + square)
    rays: FloatArray = np.concatenate([plane, depth[:, None]], axis=1) * scale[:, None] - (0.0, 0.0, xi)
    return rays


def _undistorted(plane: FloatArray, lens: ForeignLens) -> FloatArray:
    """(n, 2) points of the plane at a depth of 1, NaN where there is none. Raises for a wrong count of coefficients."""
    k, radius = lens.distortion, np.linalg.norm(plane, axis=1, keepdims=True)
    match lens.model:
        case "fov":  # F. Devernay and O. Faugeras, 2001, Eq. 14
            (omega,) = k
            scale = np.tan(radius * omega) / (2.0 * np.tan(omega / 2.0) * radius)
            return np.where(radius * omega < np.pi / 2, plane * scale, np.nan)
        case "division":  # A. Fitzgibbon, 2001
            (k1,) = k
            return np.where(1.0 + k1 * radius**2 > 0.0, plane / (1.0 + k1 * radius**2), np.nan)
        case "thin_prism_fisheye":
            return _of_angles(plane, *k)
        case "none" | "plumb_bob" | "radtan" | "rational_polynomial":
            return _by_opencv(plane, np.array(k)) if k else plane
    k1, k2, k3, k4 = k or (0.0,) * 4
    return _of_angles(plane, k1, k2, 0.0, 0.0, k3, k4, 0.0, 0.0)


def _by_opencv(plane: FloatArray, k: FloatArray) -> FloatArray:
    exactly = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ROUNDS, 1e-12)
    found = np.asarray(cv2.undistortPoints(plane[:, None], np.eye(3), k, None, None, None, exactly), np.float64)
    points = cv2.convertPointsToHomogeneous(found)
    again = np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), k)[0], np.float64)
    return _where_exact(found.reshape(-1, 2), again.reshape(-1, 2) - plane)


def _of_angles(
    plane: FloatArray, k1: float, k2: float, p1: float, p2: float, k3: float, k4: float, s1: float, s2: float
) -> FloatArray:
    """Of points at radii that are angles (COLMAP's `ThinPrismFisheyeCameraModel`), within 90 degrees."""

    def shift(points: FloatArray) -> FloatArray:
        x, y = points.T
        square = x * x + y * y
        radial = square * (k1 + square * (k2 + square * (k3 + square * k4)))
        return np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x) + s1 * square,
                y * radial + 2.0 * p2 * x * y + p1 * (square + 2.0 * y * y) + s2 * square,
            ],
            axis=1,
        )

    points = plane
    for _ in range(_ROUNDS):
        points = plane - shift(points)
    angle = np.linalg.norm(points, axis=1, keepdims=True)
    flat = np.where(angle < np.pi / 2, points * np.tan(angle) / angle, np.nan)
    return _where_exact(flat, points + shift(points) - plane)


def _where_exact(points: FloatArray, residual: FloatArray) -> FloatArray:
    """NaN elsewhere."""
    return np.where(np.abs(residual).max(axis=1, keepdims=True) < 1e-6, points, np.nan)


def _fitted(model: LensModel, lens: ForeignLens, pixels: FloatArray, rays: FloatArray) -> NearestLens:
    """Without the limits of flockd's lenses, whose edges a fit cannot pass; the errors are of its lens as it is."""
    flat = np.linalg.norm(rays[:, :2], axis=1)
    angles = np.arctan2(flat, rays[:, 2])
    sides = rays[:, :2] * (angles / np.maximum(flat, 1e-12))[:, None]
    powers = angles[:, None] ** (2, 4, 6, 8)

    def imaged(k: FloatArray) -> FloatArray:
        if model == "wide_angle":
            return np.asarray(sides * (1.0 + powers @ k)[:, None])
        found = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), np.eye(3), k)[0]
        return np.asarray(found, np.float64).reshape(-1, 2)

    def left(numbers: FloatArray) -> FloatArray:
        return np.asarray(imaged(numbers[4:]) * numbers[:2] + numbers[2:4] - pixels).ravel()

    scale = np.linalg.norm((pixels - lens.centre) / lens.focal, axis=1) @ angles / (angles @ angles)
    begin = [*(scale * np.array(lens.focal)), *lens.centre, *([0.0] * (5 if model == "pinhole" else 4))]
    numbers = np.asarray(least_squares(left, begin, x_scale="jac").x, np.float64)
    matrix = np.array([[numbers[0], 0.0, numbers[2]], [0.0, numbers[1], numbers[3]], [0.0, 0.0, 1.0]])
    camera = (PinholeCamera if model == "pinhole" else WideAngleCamera)(matrix, lens.size, tuple(numbers[4:]))
    cosines = np.sum(camera.rays(pixels) * rays, axis=1)
    off = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return NearestLens(model, numbers, float(off.max()), float(np.sqrt(np.mean(off**2))))
