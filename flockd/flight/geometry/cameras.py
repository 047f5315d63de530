"""Cameras: from points in the optical frame (RDF) to pixels and back (Eq. 1-6), with lens distortion."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import cv2
import numpy as np
from numpy.polynomial.polynomial import polyval

from flockd.core.messages import BoolArray, FloatArray

_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class Camera(ABC):
    """A projection with intrinsics ``matrix`` (3, 3) in pixels and ``size`` (width, height).

    Pixels are (u, v) with pixel centres at +0.5. Two cameras are the same only if they are one object. Raises
    ValueError for a matrix with skew or without focal length, for an empty image and for a wrong number of
    distortion coefficients.
    """

    matrix: FloatArray
    size: tuple[int, int]
    distortion: tuple[float, ...] = ()

    _coefficient_counts: ClassVar[tuple[int, ...]]

    def __post_init__(self) -> None:
        matrix = np.asarray(self.matrix, dtype=np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise ValueError("a camera matrix is (3, 3) and finite")
        fx, fy = matrix[0, 0], matrix[1, 1]
        if fx <= 0.0 or fy <= 0.0 or np.any(matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] != (0, 0, 0, 0, 1)):
            raise ValueError("a camera matrix is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy")
        if min(self.size) < 1:
            raise ValueError(f"a camera's size is a positive width and height, not {self.size}")
        if len(self.distortion) not in self._coefficient_counts:
            raise ValueError(
                f"{type(self).__name__} takes {self._coefficient_counts} distortion coefficients, "
                f"not {len(self.distortion)}"
            )
        object.__setattr__(self, "matrix", matrix)

    @abstractmethod
    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points (n, 3), inside the image or not; NaN rows for points that the lens does not image."""

    @abstractmethod
    def jacobian(self, points: FloatArray) -> FloatArray:
        """(n, 2, 3) derivative of `project`, pixels per metre; NaN where `project` is."""

    @abstractmethod
    def rays(self, pixels: FloatArray) -> FloatArray:
        """Unit vectors (n, 3) along the rays of pixels (n, 2); NaN rows outside the lens's image."""

    @abstractmethod
    def pixel_angle(self, rays: FloatArray) -> FloatArray:
        """(n,) radians that a pixel spans along unit vectors (n, 3), in the direction in which it spans more.

        Computed without distortion, which changes it little.
        """

    def unproject(self, pixels: FloatArray, range_m: FloatArray) -> FloatArray:
        """Points (n, 3) at ``range_m`` (n,) metres along the rays of pixels (n, 2) (Eq. 6); NaN where `rays` is."""
        points: FloatArray = self.rays(pixels) * np.asarray(range_m, dtype=np.float64)[:, None]
        return points

    def block_rays(self, stride: int) -> FloatArray:
        """(h / stride, w / stride, 3) unit vectors along the rays of the blocks' centres; NaN as in `rays`."""
        width, height = (length // stride for length in self.size)
        middles = np.indices((height, width), np.float64)[::-1].reshape(2, -1).T + 0.5
        return self.rays(np.asarray(stride * middles, np.float64)).reshape(height, width, 3)

    def in_image(self, pixels: FloatArray) -> BoolArray:
        """Mask (n,): which pixels (n, 2) lie inside the image; false for NaN."""
        u, v = pixels[:, 0], pixels[:, 1]
        inside: BoolArray = (u >= 0.0) & (u < self.size[0]) & (v >= 0.0) & (v < self.size[1])
        return inside

    @property
    def focal_px(self) -> float:
        """Pixels per radian at the principal point, the geometric mean of both axes."""
        return math.sqrt(float(self.matrix[0, 0] * self.matrix[1, 1]))

    def _to_pixels(self, normalised: FloatArray) -> FloatArray:
        return np.asarray(normalised * self.matrix[[0, 1], [0, 1]] + self.matrix[:2, 2])

    def _from_pixels(self, pixels: FloatArray) -> FloatArray:
        return np.asarray((pixels - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]])


@dataclass(frozen=True, eq=False)
class PinholeCamera(Camera):
    """The pinhole (Eq. 1-6), distorted by OpenCV's k1 k2 p1 p2 [k3].

    Points behind the camera, or beyond the angle at which the distortion polynomial folds back, have NaN pixels.
    """

    _coefficient_counts = (0, 4, 5)

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points (n, 3); NaN rows behind the camera."""
        points = np.asarray(points, dtype=np.float64)
        normalised = points[:, :2] / np.where(points[:, 2:] > 0.0, points[:, 2:], np.nan)
        if self.distortion:
            normalised = self._distort(normalised)
        return self._to_pixels(normalised)

    def jacobian(self, points: FloatArray) -> FloatArray:
        """(n, 2, 3) derivative of `project`."""
        points = np.asarray(points, dtype=np.float64)
        inverse_z = 1.0 / np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        normalised = points[:, :2] * inverse_z[:, None]
        derivative = np.zeros((len(points), 2, 3))
        derivative[:, 0, 0] = inverse_z
        derivative[:, 1, 1] = inverse_z
        derivative[:, :, 2] = -normalised * inverse_z[:, None]
        if self.distortion and len(points):
            derivative = self._distortion_jacobian(normalised) @ derivative
        scaled: FloatArray = derivative * self.matrix[[0, 1], [0, 1]][:, None]
        return scaled

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Unit vectors (n, 3)."""
        normalised = self._from_pixels(pixels)
        if self.distortion:
            normalised = self._undistort(normalised)
        x, y = normalised.T
        z = 1.0 / np.sqrt(x * x + y * y + 1.0)
        return np.array([x * z, y * z, z]).T

    def pixel_angle(self, rays: FloatArray) -> FloatArray:
        """(n,) radians: largest across the direction to the axis, where it falls with the cosine."""
        angle: FloatArray = rays[:, 2] / self.focal_px
        return angle

    def _coefficients(self) -> tuple[float, float, float, float, float]:
        k1, k2, p1, p2 = self.distortion[:4]
        return k1, k2, p1, p2, self.distortion[4] if len(self.distortion) == 5 else 0.0

    @cached_property
    def _radius_limit(self) -> float:
        k1, k2, _, _, k3 = self._coefficients()
        return _first_turning_point((k1, k2, k3))

    def _distort(self, normalised: FloatArray) -> FloatArray:
        k1, k2, p1, p2, k3 = self._coefficients()
        x, y = normalised.T
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        radial = np.where(r2 < self._radius_limit**2, radial, np.nan)
        right = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        return np.array([right, y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y]).T

    def _distortion_jacobian(self, normalised: FloatArray) -> FloatArray:
        """(n, 2, 2) derivative of `_distort`, by OpenCV: of pixels by the translation of points at z = 1."""
        points, still = np.insert(normalised, 2, 1.0, axis=1), np.zeros(3)
        derivative = cv2.projectPoints(points, still, still, np.eye(3), np.array(self.distortion))[1][:, 3:5]
        return np.asarray(derivative, np.float64).reshape(-1, 2, 2)

    def _undistort(self, distorted: FloatArray) -> FloatArray:
        """Newton's method; NaN if no undistorted point gives the distorted one."""
        estimate = distorted.copy()
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                error = self._distort(estimate) - distorted
                if not np.nanmax(np.abs(error), initial=0.0) > _NEWTON_TOLERANCE:
                    break
                (a, b), (c, d) = self._distortion_jacobian(estimate).transpose(1, 2, 0)
                step = np.array([d * error[:, 0] - b * error[:, 1], a * error[:, 1] - c * error[:, 0]]).T
                estimate = estimate - step / (a * d - b * c)[:, None]
            error = self._distort(estimate) - distorted
            converged = np.abs(error).max(axis=1) < 1e-9
        return np.where(converged[:, None], estimate, np.nan)


@dataclass(frozen=True, eq=False)
class WideAngleCamera(Camera):
    """The equidistant fisheye (Kannala-Brandt k1..k4), also beyond 180 degrees.

    The image radius is ``f theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)`` at ``theta`` off the
    optical axis.
    """

    _coefficient_counts = (0, 4)

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points (n, 3), in front or behind; NaN rows beyond the largest imaged theta."""
        points = np.asarray(points, dtype=np.float64)
        off_axis = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(off_axis, points[:, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(off_axis > 0.0, self._radius(theta) / off_axis, 1.0 / points[:, 2])
        visible = (theta <= self._theta_limit) & ((off_axis > 0.0) | (points[:, 2] > 0.0))
        return self._to_pixels(points[:, :2] * np.where(visible, scale, np.nan)[:, None])

    def jacobian(self, points: FloatArray) -> FloatArray:
        """(n, 2, 3) derivative of `project`."""
        points = np.asarray(points, dtype=np.float64)
        x, y, z = points.T
        # The derivative has a limit on the axis; the formula below gives it very near to the axis.
        off_axis = np.maximum(np.hypot(x, y), 1e-9 * np.abs(z))
        with np.errstate(divide="ignore", invalid="ignore"):
            ex = np.where(np.hypot(x, y) >= off_axis, x / off_axis, 1.0)
            ey = np.where(np.hypot(x, y) >= off_axis, y / off_axis, 0.0)
            theta = np.arctan2(off_axis, z)
            range2 = off_axis**2 + z**2
            radial = np.stack([z * ex, z * ey, -off_axis], axis=1) * (self._slope(theta) / range2)[:, None]
            across = np.stack([-ey, ex, np.zeros_like(x)], axis=1) * (self._radius(theta) / off_axis)[:, None]
        radial[theta > self._theta_limit] = np.nan
        derivative = np.stack(
            [ex[:, None] * radial - ey[:, None] * across, ey[:, None] * radial + ex[:, None] * across], axis=1
        )
        scaled: FloatArray = derivative * self.matrix[[0, 1], [0, 1]][:, None]
        return scaled

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Unit vectors (n, 3)."""
        normalised = self._from_pixels(pixels)
        radius = np.hypot(normalised[:, 0], normalised[:, 1])
        theta = self._theta(radius)
        with np.errstate(divide="ignore", invalid="ignore"):
            sideways = np.where(radius > 0.0, np.sin(theta) / radius, 1.0)
        return np.concatenate([normalised * sideways[:, None], np.cos(theta)[:, None]], axis=1)

    def pixel_angle(self, rays: FloatArray) -> FloatArray:
        """(n,) radians: largest towards the axis, where it is constant."""
        return np.full(len(rays), 1.0 / self.focal_px)

    @cached_property
    def _theta_limit(self) -> float:
        return min(math.pi, _first_turning_point(self.distortion)) if self.distortion else math.pi

    def _radius(self, theta: FloatArray) -> FloatArray:
        return np.asarray(theta * polyval(theta**2, (1.0, *self.distortion)))

    def _slope(self, theta: FloatArray) -> FloatArray:
        return np.asarray(polyval(theta**2, _derivative(self.distortion)))

    def _theta(self, radius: FloatArray) -> FloatArray:
        """Newton's method, by halves where it would leave what is known; NaN beyond the largest imaged angle."""
        limit = self._theta_limit
        theta = np.minimum(radius, limit)
        if self.distortion:
            least, most = np.zeros_like(theta), np.full_like(theta, limit)
            with np.errstate(all="ignore"):
                for _ in range(_NEWTON_STEPS):
                    error = self._radius(theta) - radius
                    if not np.nanmax(np.abs(error), initial=0.0) > _NEWTON_TOLERANCE:
                        break
                    least, most = np.where(error < 0.0, theta, least), np.where(error > 0.0, theta, most)
                    step = theta - error / self._slope(theta)
                    theta = np.where((step >= least) & (step <= most), step, (least + most) / 2.0)
        imaged = np.abs(self._radius(theta) - radius) < 1e-9
        return np.where(imaged, theta, np.nan)


def _derivative(coefficients: tuple[float, ...]) -> list[float]:
    """Coefficients of the derivative of ``x (1 + c1 x^2 + c2 x^4 + ...)``, by powers of x^2."""
    return [1.0, *((2 * power + 1) * c for power, c in enumerate(coefficients, start=1))]


def _first_turning_point(coefficients: tuple[float, ...]) -> float:
    """The smallest positive x at which ``x (1 + c1 x^2 + c2 x^4 + ...)`` stops growing; infinity if it never does.

    Beyond it the polynomial does not describe a lens: directions further out would fold back into the image.
    """
    roots = np.roots(_derivative(coefficients)[::-1])
    turning = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
    return math.sqrt(float(turning.min())) if len(turning) else math.inf
