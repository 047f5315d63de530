"""The Kalman filter of one track: motion model, update in log-polar coordinates and size.

Errors of ranges last from frame to frame, so that many near in time tell little more than one. The state has the
lasting error beside the motion (coloured measurement noise: A. Bryson, L. Henrikson, "Estimation using sampled data
containing sequentially correlated noise", Journal of Spacecraft and Rockets 5(6), 1968), in standard deviations of the
newest detection's log range: a first-order Gauss-Markov process with the time constant `range_error_time_s`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flockd.core.config.tracking import TrackingParameters
from flockd.core.messages import FloatArray
from flockd.flight.geometry import log_polar_residual
from flockd.flight.tracking.measurement import Measurement

SIZE = 8
"""Of a state."""
_LINEARISATIONS = 3
"""Linearisations of the iterated update (B. Bell, F. Cathey, IEEE Transactions on Automatic Control 38(2), 1993)."""
MIN_RANGE_M = 0.01
"""A predicted position nearer than this, inside the drone itself, has no bearing."""


@dataclass(frozen=True, eq=False)
class State:
    """A neighbour's position relative to the own drone and its velocity over ground, NED, its size, and by how much its
    ranges are wrong."""

    mean: FloatArray
    """(8,) three in metres, three in m/s, the natural logarithm of the size in metres, and the lasting error of log
    ranges, in standard deviations."""
    covariance: FloatArray
    """(8, 8)"""

    @property
    def position(self) -> FloatArray:
        """(3,) metres."""
        return self.mean[:3].copy()

    @property
    def velocity(self) -> FloatArray:
        """(3,) m/s."""
        return self.mean[3:6].copy()

    @property
    def size_m(self) -> float:
        """As of `Detection.size_m`."""
        return math.exp(self.mean[6])

    @property
    def position_covariance(self) -> FloatArray:
        """(3, 3) m^2."""
        return self.covariance[:3, :3].copy()

    @property
    def velocity_covariance(self) -> FloatArray:
        """(3, 3) m^2/s^2."""
        return self.covariance[3:6, 3:6].copy()


@dataclass(frozen=True, eq=False)
class Innovation:
    """How far a measurement is from where a track predicts it, in log-polar coordinates and log size."""

    residual: FloatArray
    """(4,) as of `flockd.flight.geometry.log_polar_residual`, from the prediction to the measurement, and of the log
    size."""
    covariance: FloatArray
    """(4, 4) of the residual, the prediction's and the measurement's together."""
    log_prior: float = 0.0
    """Logarithm of the probability that the prediction is the track's at all, one of several."""

    @property
    def squared_distance(self) -> float:
        """The squared Mahalanobis distance."""
        return float(self.residual @ np.linalg.solve(self.covariance, self.residual))

    def squared_angle(self, position: FloatArray) -> float:
        """The squared Mahalanobis distance of the bearings alone, from that of the predicted `position` (3,) m."""
        across = np.linalg.svd(position[None, :])[2][1:]
        angle = across @ self.residual[:3]
        return float(angle @ np.linalg.solve(across @ self.covariance[:3, :3] @ across.T, angle))

    @property
    def log_determinant(self) -> float:
        """Logarithm of the covariance's determinant."""
        return float(np.linalg.slogdet(self.covariance).logabsdet)

    @property
    def log_likelihood(self) -> float:
        """Logarithm of the Gaussian density, per steradian, unit of log range and unit of log size, times the
        prior."""
        return self.log_prior - 0.5 * (self.squared_distance + self.log_determinant + 4 * math.log(2 * math.pi))


def initial(
    measurement: Measurement, velocity: FloatArray, covariance_m2_s2: FloatArray, parameters: TrackingParameters
) -> State:
    """The state after a first detection of a drone that flies at `velocity` (3,) m/s, uncertain by its covariance."""
    of_place = np.zeros((SIZE, 5))
    of_place[:3, :3], of_place[6, 3], of_place[7, 4] = measurement.range_m * np.eye(3), 1.0, 1.0
    lasting = _lasting_sigma(measurement, parameters)
    of_place[:3, 4] = -measurement.range_m * measurement.bearing * lasting
    of_place[6, 4] = -parameters.size_correlation * lasting
    noise = np.eye(5)
    noise[:4, :4] = _noise(measurement, parameters)
    covariance = of_place @ noise @ of_place.T
    covariance[3:6, 3:6] = covariance_m2_s2
    mean = np.concatenate([measurement.position, velocity, [math.log(measurement.size_m), 0.0]])
    return State(mean, covariance)


def predict(
    state: State,
    interval_s: float,
    own_displacement: FloatArray | None,
    own_displacement_sigma_m: float,
    density: FloatArray,
    parameters: TrackingParameters,
) -> State:
    """The state `interval_s` later, at constant velocity with white acceleration noise of `density` (3,) m^2/s^3.

    `own_displacement` (3,) NED metres is the way the own drone went meanwhile, with its standard deviation an axis.
    None: not known; the neighbour then stays where it is relative to the own drone, as flock mates move alike. Its log
    size drifts by `size_drift`.
    """
    dt = interval_s
    transition, displacement, sigma_m = np.eye(SIZE), np.zeros(3), parameters.relative_speed_sigma_m_s * math.sqrt(dt)
    transition[7, 7] = math.exp(-dt / parameters.range_error_time_s)
    if own_displacement is not None:
        transition[:3, 3:6] = dt * np.eye(3)
        displacement, sigma_m = own_displacement, own_displacement_sigma_m
    noise = np.zeros((SIZE, SIZE))
    noise[:6, :6] = np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.diag(density))
    noise[:3, :3] += sigma_m**2 * np.eye(3)
    noise[6, 6] = parameters.size_drift**2 * dt
    noise[7, 7] = 1.0 - transition[7, 7] ** 2
    return State(
        mean=transition @ state.mean - np.concatenate([displacement, np.zeros(SIZE - 3)]),
        covariance=transition @ state.covariance @ transition.T + noise,
    )


def resized(state: State, size_m: float, own_velocity: FloatArray | None) -> State:
    """The state of a drone that turns out to be of this size: seen as large, it is that much nearer or farther.

    So is its velocity relative to the own one, (3,) NED m/s; None: that is not known, and its velocity stays.
    """
    factor = size_m / state.size_m
    of_velocity = 1.0 if own_velocity is None else factor
    own = np.zeros(3) if own_velocity is None else own_velocity
    scale = np.array([factor] * 3 + [of_velocity] * 3 + [1.0, 1.0])
    mean = scale * state.mean
    mean[3:6] += (1.0 - of_velocity) * own
    mean[6] = math.log(size_m)
    return State(mean, scale[:, None] * state.covariance * scale)


def innovation(state: State, measurement: Measurement, parameters: TrackingParameters) -> Innovation:
    """The innovation of a measurement against the predicted state."""
    residual, derivative = _linearised(state.mean, measurement, parameters)
    return Innovation(residual, derivative @ state.covariance @ derivative.T + _noise(measurement, parameters))


def update(state: State, measurement: Measurement, parameters: TrackingParameters) -> State:
    """The state after a measurement: an iterated extended Kalman update in log-polar coordinates.

    The first linearisation is at the measurement and not at the prediction: where the prediction is vague, e.g. of a
    new track, one at the prediction would overshoot.
    """
    predicted = innovation(state, measurement, parameters)
    excess = _excess(predicted.squared_distance, parameters)
    covariance = _noise(measurement, parameters) + (excess - 1.0) * predicted.covariance
    mean = state.mean.copy()
    mean[:3] = measurement.position * math.exp(-_lasting_sigma(measurement, parameters) * mean[7])
    mean[6] = math.log(measurement.size_m)
    for _ in range(_LINEARISATIONS):
        residual, derivative = _linearised(mean, measurement, parameters)
        mean, posterior = _kalman(state, derivative, residual - derivative @ (state.mean - mean), covariance)
    return State(mean, posterior)


def _noise(measurement: Measurement, parameters: TrackingParameters) -> FloatArray:
    """(4, 4) covariance of what is new in a measurement's log-polar coordinates and log size.

    A range is a size over an apparent size, so that the two err together: by as much, with `size_correlation`. What the
    judged size may be off (`Detection.log_size_sigma`) is no part of it: that lasts, and is no noise. A filter that
    took it for noise would find the range from how the neighbour moves, which in a flock tells nothing of it
    (`pilot.size_learner`).
    """
    variance = measurement.log_range_variance
    lasting = _lasting_sigma(measurement, parameters) ** 2
    bearing = measurement.bearing
    across = parameters.size_correlation * (variance - lasting) * bearing[:, None]
    place = measurement.covariance - lasting * np.outer(bearing, bearing)
    of_size = variance - parameters.size_correlation**2 * lasting
    return np.block([[place, across], [across.T, np.array([[of_size]])]])


def _lasting_sigma(measurement: Measurement, parameters: TrackingParameters) -> float:
    """Standard deviation of what of a log range's error lasts."""
    return math.sqrt(parameters.range_error_lasts * measurement.log_range_variance)


def _excess(squared_distance: float, parameters: TrackingParameters) -> float:
    """By how much an innovation's covariance is enlarged, at least 1.

    An innovation of d > `robust_sigma` standard deviations has its covariance enlarged by (d / robust_sigma)^2: the
    farther off, the less it moves the state.
    """
    return max(1.0, squared_distance / parameters.robust_sigma**2)


def _linearised(
    mean: FloatArray, measurement: Measurement, parameters: TrackingParameters
) -> tuple[FloatArray, FloatArray]:
    """The residual (4,) of a measurement from a state (8,), and the derivative (4, 8) of the predicted measurement."""
    distance_m = float(np.linalg.norm(mean[:3]))
    range_m = max(distance_m, MIN_RANGE_M)
    bearing = mean[:3] / range_m if distance_m >= MIN_RANGE_M else measurement.bearing
    lasting = _lasting_sigma(measurement, parameters)
    log_range = math.log(range_m) + lasting * float(mean[7])
    place = log_polar_residual(measurement.bearing, measurement.log_range, bearing, log_range)
    derivative = np.zeros((4, SIZE))
    derivative[:3, :3] = np.eye(3) / range_m
    derivative[:3, 7] = lasting * bearing
    derivative[3, 6:] = 1.0, parameters.size_correlation * lasting
    return np.append(place, math.log(measurement.size_m) - derivative[3, 6:] @ mean[6:]), derivative


def _kalman(
    state: State, derivative: FloatArray, residual: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean (8,) and covariance (8, 8), in Joseph's form, after `residual` with noise of `covariance`."""
    spread = derivative @ state.covariance @ derivative.T + covariance
    gain = np.linalg.solve(spread, derivative @ state.covariance).T
    left = np.eye(SIZE) - gain @ derivative
    return state.mean + gain @ residual, left @ state.covariance @ left.T + gain @ covariance @ gain.T
