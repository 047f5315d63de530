"""One detection in the coordinates of the tracker."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from flockd.core.messages import Detection, FloatArray
from flockd.flight.geometry import log_polar, log_polar_covariance


@dataclass(frozen=True, eq=False)
class Measurement:
    """A neighbour measured in log-polar coordinates, in level axes that point north, east and down (NED).

    Raises ValueError for numbers that are not finite or out of range.
    """

    bearing: FloatArray
    """(3,) unit vector from the own drone to the neighbour."""
    log_range: float
    """Natural logarithm of the range in metres."""
    covariance: FloatArray
    """(3, 3) of the residual of `flockd.flight.geometry.log_polar_residual`, in NED axes: along the bearing the
    variance of the log range, across it that of the angle, rad^2."""
    size_m: float
    """As of `Detection.size_m`."""
    drone_probability: float = 1.0
    """Probability that it is a drone, 0 to 1."""
    log_size_sigma: float = 0.0
    """As of `Detection`."""

    def __post_init__(self) -> None:
        if not abs(float(np.linalg.norm(self.bearing)) - 1.0) < 1e-6:  # NaN fails too
            raise ValueError("a measured bearing must be a unit vector")
        if not math.isfinite(self.log_range):
            raise ValueError("a measured log range must be finite")
        if not np.isfinite(self.covariance).all():
            raise ValueError("a measurement's covariance must be finite")
        if not (math.isfinite(self.size_m) and self.size_m > 0):
            raise ValueError(f"a measured size must be finite and positive, not {self.size_m} m")
        if not 0 <= self.drone_probability <= 1:
            raise ValueError(f"a probability lies between 0 and 1, not at {self.drone_probability}")
        if not (math.isfinite(self.log_size_sigma) and self.log_size_sigma >= 0):
            raise ValueError(f"a size's sigma must be finite and not negative, not {self.log_size_sigma}")

    @classmethod
    def of(cls, detection: Detection, R_ned_body: FloatArray) -> Self:
        """A detection, rotated by the attitude (3, 3) from body into NED axes."""
        return cls(
            bearing=R_ned_body @ detection.bearing,
            log_range=detection.log_range,
            covariance=R_ned_body @ detection.covariance @ R_ned_body.T,
            size_m=detection.size_m,
            drone_probability=detection.drone_probability,
            log_size_sigma=detection.log_size_sigma,
        )

    @classmethod
    def of_position(
        cls,
        position: FloatArray,
        *,
        range_sigma_m: float,
        bearing_sigma_rad: float,
        size_m: float,
        drone_probability: float = 1.0,
    ) -> Self:
        """A position (3,) in metres, NED, own drone at the origin, with independent errors of range and bearing.

        `bearing_sigma_rad` is the standard deviation across the line of sight, in each direction. Raises ValueError for
        the origin too.
        """
        bearing, log_range = log_polar(position)
        covariance = log_polar_covariance(bearing, range_sigma_m / math.exp(log_range), bearing_sigma_rad)
        return cls(bearing, log_range, covariance, size_m, drone_probability)

    @property
    def range_m(self) -> float:
        """Range from the own drone."""
        return math.exp(self.log_range)

    @property
    def log_range_variance(self) -> float:
        """The part of `covariance` along the bearing."""
        return float(self.bearing @ self.covariance @ self.bearing)

    @property
    def position(self) -> FloatArray:
        """(3,) metres, NED, own drone at the origin."""
        return self.range_m * self.bearing
