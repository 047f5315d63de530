"""The Kalman filter of many states at once: update in log-polar coordinates and size.

Range errors persist from frame to frame, so many measurements within a short time tell little more than one. The state
holds the persistent error besides the motion (coloured measurement noise: A. Bryson, L. Henrikson, "Estimation using
sampled data containing sequentially correlated noise", Journal of Spacecraft and Rockets 5(6), 1968), in standard
deviations of the newest detection's log range: a first-order Gauss-Markov process with the time constant
`range_error_time_s`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flockd.core.config.tracking import TrackingParameters
from flockd.core.messages import FloatArray
from flockd.flight.geometry import log_polar_residual
from flockd.flight.geometry.pairs import Columns
from flockd.flight.tracking.measurement import Measurement

SIZE = 8
"""Elements of a state: position relative to the own drone (3, metres) and velocity over ground (3, m/s), NED, natural
logarithm of the size in metres, and the persistent error of log ranges in standard deviations."""
_LINEARISATIONS = 3
"""Linearisations of the iterated update (B. Bell, F. Cathey, IEEE Transactions on Automatic Control 38(2), 1993)."""
MIN_RANGE_M = 0.01
"""Shortest range of a predicted position; nearer, inside the drone itself, it has no bearing."""


@dataclass(frozen=True, eq=False)
class Measurements(Columns):
    """Measurements as arrays of shape (...), which broadcasts with the shape of the states."""

    bearing: FloatArray
    """(..., 3)"""
    log_range: FloatArray
    log_size: FloatArray
    lasting: FloatArray
    """Standard deviation of the persistent part of a log range's error."""
    noise: FloatArray
    """(..., 4, 4) covariance of the independent part of the error, in log-polar coordinates and log size. The error of
    the size itself (`Detection.log_size_sigma`) is left out because it persists. A filter that took it for noise would
    derive the range from the neighbour's motion, which does not show it in a flock (`pilot.size_learner`)."""

    @classmethod
    def of(cls, measurements: Sequence[Measurement], parameters: TrackingParameters) -> Measurements:
        """(n, 1): each measurement is compared with all motions of a track."""
        count = len(measurements)
        bearing = np.array([m.bearing for m in measurements]).reshape(count, 3)
        variance = np.array([m.log_range_variance for m in measurements])
        lasting = parameters.range_error_lasts * variance
        noise = np.zeros((count, 4, 4))
        noise[:, :3, :3] = np.array([m.covariance for m in measurements]).reshape(count, 3, 3)
        noise[:, :3, :3] -= lasting[:, None, None] * bearing[:, :, None] * bearing[:, None]
        noise[:, 3, 3] = variance
        log_range = np.array([m.log_range for m in measurements])
        log_size = np.log([m.size_m for m in measurements])
        return cls(*(a[:, None] for a in (bearing, log_range, log_size, np.sqrt(lasting), noise)))


@dataclass(frozen=True, eq=False)
class Innovations:
    """Differences between measurements and their predictions, in log-polar coordinates and log size."""

    residual: FloatArray
    """(..., 4) measured minus predicted, as `flockd.flight.geometry.log_polar_residual`, and of the log size."""
    covariance: FloatArray
    """(..., 4, 4) of the residual: sum of the prediction's and the measurement's covariance."""
    squared_distance: FloatArray
    """(...) the squared Mahalanobis distance."""

    @property
    def log_likelihood(self) -> FloatArray:
        """(...) logarithm of the Gaussian density, per steradian, unit of log range and unit of log size."""
        log_determinant = np.linalg.slogdet(self.covariance).logabsdet
        density: FloatArray = -0.5 * (self.squared_distance + log_determinant + 4 * math.log(2 * math.pi))
        return density


def initial(
    measurement: Measurement, velocities: FloatArray, covariances: FloatArray, parameters: TrackingParameters
) -> tuple[FloatArray, FloatArray]:
    """Means (m, 8) and covariances (m, 8, 8) after the first detection of a drone, for m hypotheses of its velocity:
    `velocities` (m, 3) m/s with `covariances` (m, 3, 3)."""
    measured = Measurements.of([measurement], parameters)
    of_place = np.zeros((SIZE, 5))
    of_place[:3, :3], of_place[6, 3], of_place[7, 4] = measurement.range_m * np.eye(3), 1.0, 1.0
    of_place[:3, 4] = -measurement.range_m * measurement.bearing * measured.lasting[0]
    noise = np.eye(5)
    noise[:4, :4] = measured.noise[0, 0]
    covariance = np.repeat((of_place @ noise @ of_place.T)[None], len(velocities), axis=0)
    covariance[:, 3:6, 3:6] = covariances
    mean = np.zeros((len(velocities), SIZE))
    mean[:, :3], mean[:, 3:6], mean[:, 6] = measurement.position, velocities, measured.log_size[0, 0]
    return mean, covariance


def innovations(mean: FloatArray, covariance: FloatArray, measured: Measurements) -> Innovations:
    """Measurements against predicted states (..., 8) with covariances (..., 8, 8)."""
    residual, derivative = _linearised(mean, measured)
    spread = derivative @ covariance @ derivative.swapaxes(-1, -2) + measured.noise
    squared = (residual * np.linalg.solve(spread, residual[..., None])[..., 0]).sum(axis=-1)
    return Innovations(residual, spread, squared)


def squared_distances_but_range(mean: FloatArray, covariance: FloatArray, measured: Measurements) -> FloatArray:
    """(n,) squared Mahalanobis distances of one measurement, (1,), from states (n, 8), in bearing and size only."""
    found = innovations(mean, covariance, measured)
    others = np.zeros((len(mean), 3, 4))
    others[:, :2, :3] = np.linalg.svd(mean[:, None, :3])[2][:, 1:]  # across the line of sight
    others[:, 2, 3] = 1.0
    off = others @ found.residual[..., None]
    squared: FloatArray = (off * np.linalg.solve(others @ found.covariance @ others.swapaxes(1, 2), off)).sum((1, 2))
    return squared


def update(
    mean: FloatArray, covariance: FloatArray, measured: Measurements, parameters: TrackingParameters
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means (..., 8), covariances (..., 8, 8) and log likelihoods (...) after measurements: an iterated extended Kalman
    update in log-polar coordinates.

    The first linearisation is at the measurement: at a vague prediction, e.g. of a new track, the update would
    overshoot. The covariance of an innovation of d > `robust_sigma` standard deviations is enlarged by (d /
    robust_sigma)^2: outliers move the state less.
    """
    predicted = innovations(mean, covariance, measured)
    excess = np.maximum(1.0, predicted.squared_distance / parameters.robust_sigma**2)
    robust = Innovations(
        predicted.residual, excess[..., None, None] * predicted.covariance, predicted.squared_distance / excess
    )
    noise = measured.noise + robust.covariance - predicted.covariance
    updated = mean.copy()
    range_m = np.exp(measured.log_range - measured.lasting * mean[..., 7])
    updated[..., :3] = range_m[..., None] * measured.bearing
    updated[..., 6] = measured.log_size
    for _ in range(_LINEARISATIONS):
        residual, derivative = _linearised(updated, measured)
        residual = residual - (derivative @ (mean - updated)[..., None])[..., 0]
        updated, posterior = _kalman(mean, covariance, derivative, residual, noise)
    return updated, posterior, robust.log_likelihood


def _linearised(mean: FloatArray, measured: Measurements) -> tuple[FloatArray, FloatArray]:
    """Residuals (..., 4) of measurements from states (..., 8), and derivatives (..., 4, 8) of what is predicted."""
    distance_m = np.sqrt((mean[..., :3] ** 2).sum(axis=-1))
    range_m = np.maximum(distance_m, MIN_RANGE_M)
    near = (distance_m < MIN_RANGE_M)[..., None]
    bearing = np.where(near, measured.bearing, mean[..., :3] / range_m[..., None])
    log_range = np.log(range_m) + measured.lasting * mean[..., 7]
    place = log_polar_residual(measured.bearing, measured.log_range, bearing, log_range)
    derivative = np.zeros((*place.shape[:-1], 4, SIZE))
    derivative[..., :3, :3] = np.eye(3) / range_m[..., None, None]
    derivative[..., :3, 7] = measured.lasting[..., None] * bearing
    derivative[..., 3, 6] = 1.0
    residual = np.empty((*place.shape[:-1], 4))
    residual[..., :3] = place
    residual[..., 3] = measured.log_size - mean[..., 6]
    return residual, derivative


def _kalman(
    mean: FloatArray, covariance: FloatArray, derivative: FloatArray, residual: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Means (..., 8) and covariances (..., 8, 8), in Joseph's form, after residuals (..., 4) with `noise`."""
    spread = derivative @ covariance @ derivative.swapaxes(-1, -2) + noise
    gain = np.linalg.solve(spread, derivative @ covariance).swapaxes(-1, -2)
    left = np.eye(SIZE) - gain @ derivative
    posterior = left @ covariance @ left.swapaxes(-1, -2) + gain @ noise @ gain.swapaxes(-1, -2)
    return mean + (gain @ residual[..., None])[..., 0], posterior
