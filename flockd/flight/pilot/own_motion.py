"""The own motion as a state: the autopilot's velocity minus its error, which the images' displacements show.

A Kalman filter of that error on the clock of the frames: a Gauss-Markov process, with equal parameters on each axis.
Over a step, the autopilot's mean velocity minus the images' mean velocity measures the mean error, with the images'
noise. The velocity now is the autopilot's, which follows accelerations within the step, minus the error now. If images
show no motion, or contradict the filter, the autopilot's velocity remains, with a larger sigma.
"""

from __future__ import annotations

import math

import numpy as np

from flockd.core import consistency
from flockd.core.messages import FloatArray, VehicleState

ERROR_M_S, ERROR_LASTS_S = 0.15, 3.0
"""Standard deviation of an autopilot's velocity, each axis, and its time constant in s, from PX4 in simulation."""
SCALE = 0.03
"""Relative standard deviation of the scale of the images' displacements."""
_AGES_M_S2 = 2.0
"""Growth of a velocity's standard deviation with the time between it and the frames, in m/s per second."""
_MOST_M_S = 100.0
"""Velocity above which the autopilot's estimate counts as wrong; also the limit of standard deviations."""


class OwnMotion:
    """The own motion of one drone. Call `update` once a step; the attributes are as of the step's end."""

    def __init__(self, images_sigma_m: float) -> None:
        """``images_sigma_m``: standard deviation of a displacement by images, each axis, besides that of its scale."""
        self._images_sigma_m = images_sigma_m
        self._before: VehicleState | None = None
        self._variance = ERROR_M_S**2
        self.error = np.zeros(3)
        """(3,) error of the autopilot's velocity, m/s NED: what it reports minus the truth."""
        self.disagreement_m_s = 0.0
        """The horizontal error if it is larger than usual, so that autopilot or images are faulty; else 0."""
        self.velocity: FloatArray | None = None
        """(3,) m/s NED; None: not known yet."""
        self.displacement: FloatArray | None = None
        """(3,) metres NED in the step; None: not known yet."""
        self.sigma_m = 0.0
        """Standard deviation of the displacement, each axis."""

    def ahead(self, interval_s: float) -> tuple[FloatArray | None, float]:
        """The displacement expected in the time after the last step, and its standard deviation, each axis."""
        return None if self.velocity is None else interval_s * self.velocity, ERROR_M_S * interval_s

    def update(self, vehicle: VehicleState, interval_s: float, by_images: FloatArray | None) -> bool:
        """Takes a step. Returns whether ``by_images`` fits the filter; if not, it is not used.

        Args:
            vehicle: at the step's end.
            interval_s: time between the frames of both ends; 0: the filter starts anew.
            by_images: (3,) displacement in the interval, metres NED; None: images do not show it.

        A refused displacement enlarges the error's variance, so that the next one fits if it says the same.
        """
        before, self._before = self._before, vehicle
        if before is None:
            return True
        said, said_before = _velocity(vehicle), _velocity(before)
        if said is None or said_before is None or not interval_s > 0.0:
            return self._alone(said, interval_s, by_images)
        limit, mean_said = consistency.EGO_MOTION.limit, (said_before + said) / 2
        stays = self.disagreement_m_s > 0.0 and by_images is not None  # a faulty sensor stays faulty
        kept = 1.0 if stays else math.exp(-interval_s / ERROR_LASTS_S)
        wandered = -math.expm1(-2.0 * interval_s / ERROR_LASTS_S) * ERROR_M_S**2
        error, variance = kept * self.error, kept**2 * self._variance + wandered
        mean, covariance = (self.error + error) / 2, (kept * self._variance + variance) / 2
        late_s = vehicle.time_s - before.time_s - interval_s
        of_mean = ((1 + kept) * self._variance / 2 + covariance) / 2 + min(_AGES_M_S2 * abs(late_s), _MOST_M_S) ** 2
        fits = True
        if by_images is not None:
            innovation = mean_said - by_images / interval_s - mean
            noise = (self._images_sigma_m / interval_s) ** 2 + SCALE**2 * float((mean_said - mean) @ (mean_said - mean))
            off, expected = float(np.linalg.norm(innovation)), of_mean + noise
            fits = off <= limit * math.sqrt(expected)
            if fits:
                error, variance = error + covariance / expected * innovation, variance - covariance**2 / expected
                mean, of_mean = mean + of_mean / expected * innovation, of_mean * noise / expected
            else:
                variance += (2 * off / limit) ** 2  # at least a quarter reaches the next step's mean
        self.error, self._variance, self.velocity = error, variance, said - error
        usual_m_s = limit * math.hypot(ERROR_M_S, SCALE * math.hypot(*mean_said[:2]))
        off_m_s = math.hypot(*error[:2])
        self.disagreement_m_s = off_m_s if off_m_s > usual_m_s else 0.0
        self.displacement = interval_s * (mean_said - mean)
        self.sigma_m = interval_s * (math.sqrt(of_mean) + self.disagreement_m_s)
        return fits

    def _alone(self, said: FloatArray | None, interval_s: float, by_images: FloatArray | None) -> bool:
        """Uses the images or the autopilot alone if the other gives no motion for the step."""
        self._variance, self.disagreement_m_s = ERROR_M_S**2, 0.0
        if said is not None:
            self.velocity = said - self.error
        elif by_images is not None:
            self.velocity = by_images / interval_s  # Eq. 21
        self.displacement, self.sigma_m = self.ahead(interval_s)
        if by_images is not None:
            self.displacement, self.sigma_m = by_images, self._images_sigma_m
        return True


def _velocity(vehicle: VehicleState) -> FloatArray | None:
    """(3,) the autopilot's velocity, m/s NED; None: not known, or impossible."""
    said = vehicle.velocity_ned
    return None if said is None or not np.abs(said).max() <= _MOST_M_S else said
