"""What one frame set says of one neighbour, in the axes the tracker works in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flockd.messages import FloatArray


@dataclass(frozen=True, eq=False)
class Measurement:
    """One detection in axes that point north, east and down. Raises ValueError for numbers that are not finite."""

    position: FloatArray
    """(3,) metres, relative to the own drone; not zero."""
    covariance: FloatArray
    """(3, 3) m^2 of `position`."""
    size_m: float
    """As of `Detection.size_m`."""
    drone_probability: float = 1.0
    """Of being a drone at all, 0 to 1."""
    velocity: FloatArray | None = None
    """(3,) m/s over ground, where one was estimated (Eq. 36)."""
    velocity_sigma_m_s: float = 1.0
    """Standard deviation of `velocity`, each axis."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.position).all() and np.any(self.position)):
            raise ValueError("a measured position must be finite and not zero")
        if not np.isfinite(self.covariance).all():
            raise ValueError("a measured position's covariance must be finite")
        if not (np.isfinite(self.size_m) and self.size_m > 0):
            raise ValueError(f"a measured size must be finite and positive, not {self.size_m} m")
        if not 0 <= self.drone_probability <= 1:
            raise ValueError(f"a probability lies between 0 and 1, not at {self.drone_probability}")
        if self.velocity is not None and not np.isfinite(self.velocity).all():
            raise ValueError("a measured velocity must be finite")
        if not (np.isfinite(self.velocity_sigma_m_s) and self.velocity_sigma_m_s > 0):
            raise ValueError(f"a velocity's sigma must be finite and positive, not {self.velocity_sigma_m_s} m/s")


def detection_covariance(position: FloatArray, range_sigma_m: float, bearing_sigma_rad: float) -> FloatArray:
    """(3, 3) m^2 of a position (3,) whose range and bearing err apart: sigma_r along it, range * sigma_b across."""
    distance = float(np.linalg.norm(position))
    along = np.outer(position, position) / distance**2
    across_variance = (distance * bearing_sigma_rad) ** 2
    return np.asarray(across_variance * np.eye(3) + (range_sigma_m**2 - across_variance) * along, dtype=float)
