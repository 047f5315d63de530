"""How neighbours move: three motions that interact (IMM), none of which is ever discarded.

H. Blom, Y. Bar-Shalom, "The interacting multiple model algorithm for systems with Markovian switching coefficients",
IEEE Transactions on Automatic Control 33(8), 1988. A neighbour flies as the own drone does, flies a course of its own,
or brakes to standstill. It may switch at any time. Each motion has its own filter, which is mixed with the others'
states before a prediction; detections weigh the motions by Bayes' rule.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flockd.core.config.tracking import JITTER_S, TrackingParameters
from flockd.core.messages import FloatArray, PossibleMotion
from flockd.flight.geometry.pairs import Columns
from flockd.flight.tracking import filter  # noqa: A004 - the field's word
from flockd.flight.tracking.filter import Measurements
from flockd.flight.tracking.measurement import Measurement

_LASTS_S = 20.0
"""Mean time in s between switches of a neighbour's motion."""
_HARDER = 2.0
"""Factor on the acceleration's standard deviation of a neighbour on its own course."""


@dataclass(frozen=True, eq=False)
class Mixture(Columns):
    """States of n neighbours, each with m possible motions: flies as the own drone does, its own course, brakes."""

    probability: FloatArray
    """(n, m) probability of each motion; each row adds up to 1."""
    mean: FloatArray
    """(n, m, 8) states, see `filter`."""
    covariance: FloatArray
    """(n, m, 8, 8)"""

    def replaced(self, index: Sequence[int], by: Mixture) -> Mixture:
        """A copy in which the neighbours at `index` are those of another mixture."""
        probability, mean, covariance = self.probability.copy(), self.mean.copy(), self.covariance.copy()
        probability[index], mean[index], covariance[index] = by.probability, by.mean, by.covariance
        return Mixture(probability, mean, covariance)

    @property
    def together(self) -> Mixture:
        """Mean and covariance of each neighbour over all its motions, as a mixture of one motion."""
        mean, covariance = _mixed(self.probability[:, :, None], self.mean, self.covariance)
        return Mixture(np.ones((len(mean), 1)), mean, covariance)

    def innovations(self, measured: Measurements) -> tuple[FloatArray, FloatArray]:
        """Squared Mahalanobis distances (k, n) of k measurements from n neighbours, by the motion that explains each
        best, and logarithms of the densities times that motion's probability."""
        found = filter.innovations(self.mean, self.covariance, measured[:, None])
        prior = np.log(self.probability)
        likelihood = found.log_likelihood + prior
        best = likelihood.argmax(axis=-1)[..., None]
        return (
            np.take_along_axis(found.squared_distance - 2.0 * prior, best, axis=-1)[..., 0],
            np.take_along_axis(likelihood, best, axis=-1)[..., 0],
        )

    def possible(self) -> list[tuple[PossibleMotion, ...]]:
        """The motions of each neighbour for the gate, the likeliest first."""
        places = self.mean[..., :3]
        bearings = places / np.maximum(np.sqrt((places**2).sum(axis=-1, keepdims=True)), filter.MIN_RANGE_M)
        blocks = self.covariance[..., :3, :3], self.covariance[..., 3:6, 3:6]
        sigmas = [np.sqrt(np.einsum("nmx,nmxy,nmy->nm", bearings, block, bearings)) for block in blocks]
        return [
            tuple(
                PossibleMotion(
                    float(self.probability[i, j]), places[i, j], self.mean[i, j, 3:6],
                    range_sigma_m=float(sigmas[0][i, j]), closing_sigma_m_s=float(sigmas[1][i, j]),
                )
                for j in order
            )
            for i, order in enumerate((-self.probability).argsort(axis=-1, kind="stable").tolist())
        ]  # fmt: skip


def nobody() -> Mixture:
    """A mixture of no neighbours."""
    return Mixture(np.empty((0, 3)), np.empty((0, 3, filter.SIZE)), np.empty((0, 3, filter.SIZE, filter.SIZE)))


def first(measurement: Measurement, own_velocity: FloatArray | None, parameters: TrackingParameters) -> Mixture:
    """The mixture after a first detection. `own_velocity` (3,) NED m/s; None: not known.

    A drone on a collision course has a constant bearing, as a flock mate has. Only the range tells them apart: its
    relative rate is the inverse of the time to contact (D. Lee, "A theory of visual control of braking based on
    information about time-to-collision", Perception 5, 1976). So the motion "own course" starts as a collision course.
    """
    p = parameters
    unknown, alike = p.speed_sigma_m_s**2 * np.eye(3), p.relative_speed_sigma_m_s**2 * np.eye(3)
    velocities, covariances = np.zeros((3, 3)), np.array([unknown] * 3)
    if own_velocity is not None:
        along = np.outer(measurement.bearing, measurement.bearing)
        velocities[:] = own_velocity - along @ own_velocity
        covariances[:] = alike + along @ (unknown - alike)
        velocities[0], covariances[0] = own_velocity, alike
    mean, covariance = filter.initial(measurement, velocities, covariances, p)
    return Mixture(_probabilities(p.stranger_probability)[None], mean[None], covariance[None])


def predicted(
    mixture: Mixture,
    interval_s: float,
    own_displacement: FloatArray | None,
    own_displacement_sigma_m: float,
    parameters: TrackingParameters,
    braking_m_s2: float,
) -> Mixture:
    """The mixture `interval_s` later: motions are mixed, then predicted with white acceleration noise.

    `own_displacement` (3,) NED metres is the own drone's displacement meanwhile, with its standard deviation on each
    axis. None: not known; the neighbour then keeps its place relative to the own drone, as flock mates move alike. Its
    log size drifts by `size_drift`. A braking neighbour decelerates by `braking_m_s2`.
    """
    p, dt = parameters, interval_s
    probability, mean, covariance = _interacted(mixture, dt, p)
    density = p.manoeuvre_time_s * (p.acceleration_sigma_m_s2 * np.array([1.0, _HARDER, 1.0])) ** 2
    kept, way_s, target = np.ones(probability.shape), np.full(probability.shape, dt), np.zeros((3, 3))
    if own_displacement is None or dt <= 0:
        way_s, displacement, sigma_m = 0.0 * way_s, np.zeros(3), p.relative_speed_sigma_m_s * math.sqrt(dt)
    else:
        target[0], displacement, sigma_m = own_displacement / dt, own_displacement, own_displacement_sigma_m
        alike_s = 2 * p.relative_speed_sigma_m_s**2 / density[0]  # a mate's velocity differs by this sigma in the end
        kept[:, 0] = math.exp(-dt / alike_s)
        way_s[:, 0] = alike_s * (1.0 - kept[:, 0])
        squared_speed = (mean[:, 2, 3:6] ** 2).sum(axis=-1) + np.einsum("nxx->n", covariance[:, 2, 3:6, 3:6])
        stops_s = np.maximum(np.sqrt(squared_speed) / braking_m_s2, JITTER_S)
        brakes_s = np.minimum(stops_s, dt)
        kept[:, 2] = 1.0 - brakes_s / stops_s
        way_s[:, 2] = brakes_s * (1.0 + kept[:, 2]) / 2
    axes = np.eye(3)
    transition = np.zeros((*kept.shape, filter.SIZE, filter.SIZE)) + np.eye(filter.SIZE)
    transition[..., :3, 3:6] = way_s[..., None, None] * axes
    transition[..., 3:6, 3:6] *= kept[..., None, None]
    transition[..., 7, 7] = math.exp(-dt / p.range_error_time_s)
    mean = (transition @ mean[..., None])[..., 0]
    mean[..., :3] += (dt - way_s)[..., None] * target - displacement
    mean[..., 3:6] += (1.0 - kept)[..., None] * target
    noise = np.zeros((3, filter.SIZE, filter.SIZE))
    of_place, of_both, of_velocity = (density * dt**power / power for power in (3, 2, 1))
    noise[:, :3, :3] = (of_place + sigma_m**2)[:, None, None] * axes
    noise[:, :3, 3:6] = noise[:, 3:6, :3] = of_both[:, None, None] * axes
    noise[:, 3:6, 3:6] = of_velocity[:, None, None] * axes
    noise[:, 6, 6] = p.size_drift**2 * dt
    noise[:, 7, 7] = 1.0 - math.exp(-2 * dt / p.range_error_time_s)
    return Mixture(probability, mean, transition @ covariance @ transition.swapaxes(-1, -2) + noise)


def updated(mixture: Mixture, measured: Measurements, parameters: TrackingParameters) -> Mixture:
    """The mixture after a detection of each neighbour."""
    mean, covariance, log_likelihood = filter.update(mixture.mean, mixture.covariance, measured, parameters)
    logs = log_likelihood + np.log(mixture.probability)
    weights = np.exp(logs - logs.max(axis=-1, keepdims=True)) + 1e-12
    return Mixture(weights / weights.sum(axis=-1, keepdims=True), mean, covariance)


def resized(mixture: Mixture, size_m: float, own_velocity: FloatArray | None) -> Mixture:
    """Rescales all neighbours to this size: at the same apparent size each is nearer or farther by the same factor.

    The velocity relative to `own_velocity`, (3,) NED m/s, is scaled too; None: not known, and velocities stay.
    """
    scale, mean = np.ones(mixture.mean.shape), mixture.mean
    scale[..., :6] = (size_m / np.exp(mean[..., 6]))[..., None]
    offset = np.zeros(filter.SIZE)
    if own_velocity is None:
        scale[..., 3:6] = 1.0
    else:
        offset[3:6] = own_velocity
    mean = scale * (mean - offset) + offset
    mean[..., 6] = math.log(size_m)
    return Mixture(mixture.probability, mean, scale[..., None] * mixture.covariance * scale[..., None, :])


def _probabilities(stranger: float) -> FloatArray:
    """(3,) of the motions, given the probability that a new neighbour is not a flock mate."""
    return np.array([1.0 - stranger, stranger / 2, stranger / 2])


def _interacted(
    mixture: Mixture, interval_s: float, p: TrackingParameters
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Probabilities, means and covariances after switches within the interval, to motions as likely as at first sight.

    The Markov chain has one time constant, so two short intervals give the same as one long interval.
    """
    keep = math.exp(-interval_s / _LASTS_S)
    transition = keep * np.eye(3) + (1.0 - keep) * _probabilities(p.stranger_probability)
    joint = mixture.probability[:, :, None] * transition
    probability = joint.sum(axis=1)
    return probability, *_mixed(joint / probability[:, None], mixture.mean, mixture.covariance)


def _mixed(weights: FloatArray, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means (n, j, 8) and covariances (n, j, 8, 8) of mixtures by `weights` (n, i, j)."""
    mixed = weights.swapaxes(1, 2) @ mean
    off = mean[:, :, None] - mixed[:, None]
    spread = np.einsum("nij,nijx,nijy->njxy", weights, off, off)
    return mixed, spread + np.einsum("nij,nixy->njxy", weights, covariance)
