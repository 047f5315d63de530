"""How large the neighbours are, by the parallax of a motion of one's own that they do not answer: the weave.

An apparent size gives a range only in units of the drone's size. If the own drone moves by a known way that its
neighbours do not follow, their bearings shift by that way over the range: the shift gives the metres. Any other motion
gives nothing, as mates move as one does oneself. So, in assumed metres (the size that the network judged over the
apparent size), a neighbour's relative motion is free but for the own weave, which enters times the assumed over the
true size. The problem is linear in that scale: a Kalman filter carries along how its state depends on it (B. Friedland,
"Treatment of bias in recursive filtering", IEEE Transactions on Automatic Control 14(4), 1969), and the innovations
weigh each of many sizes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from flockd.core.config.perception import MAX_DRONE_SIZE_M, MIN_DRONE_SIZE_M
from flockd.core.messages import FloatArray
from flockd.flight.tracking.filter import MIN_RANGE_M
from flockd.flight.tracking.measurement import Measurement
from flockd.flight.tracking.weave_path import AMPLITUDE_SIGMA, DURATION_S, SETTLES_S, climb_m_s, lift_m

LOG_SIZES = np.linspace(math.log(MIN_DRONE_SIZE_M), math.log(MAX_DRONE_SIZE_M), 155)
"""(G,) the sizes that are weighed, as logarithms of metres, 3 % apart."""
_GRID = float(LOG_SIZES[1] - LOG_SIZES[0])
MOST_SIGMA = 0.1
"""An estimate is published below this relative standard deviation."""
_LEAST_SIGMA = 0.04
"""What the model does not know of adds this to every estimate's relative standard deviation."""
_TEMPER = 0.9
"""Power of all likelihoods: errors of cameras and networks last longer than a step, and are no independent evidence. So
chosen that errors are as large as is said."""
_LEVEL, _VERTICAL, _WEAVING = 0.2, (1e-4, 0.02), 3e-4
"""Spectral densities, assumed m^2/s^3, of the acceleration of a neighbour relative to the own drone. Each vertical one
is a motion model: it flies level, rises and sinks in any way, or weaves. They are not of metres, so that they say
nothing of the scale. The level one is that of gusts: of smaller ones beside it, the sizes for which mates happen to
move smoothly profit."""
_SWITCHING = 0.02
"""Probability that a neighbour moves by another model from one step to the next."""
_BEGINS_S, _BEGINS_PER_S = 0.25, 0.01
"""That it begins to weave is asked so often, and has this probability a second."""
_BEGAN_SIGMA_S = 0.1
"""Standard deviation of when it then began, between two times that are asked."""
_GIVEN_UP = -12.0
"""A weave is followed no longer where, for no size near what it looks like, its log probability is above this."""
_SPEED_SIGMA, _CLIMB_SIGMA = 0.7, 0.2
"""Standard deviations of a new neighbour's relative velocity, assumed m/s."""
_ASPECT_SIGMA, _ASPECT_TIME_S, _RANGE_SIGMA = 0.05, 5.0, 0.1
"""Standard deviation of the logarithm of the apparent size by the side that is seen, how long one is seen, and what
else the log range that follows from it errs by beside what the network says. Of unlike drones it is 7 to 13 % together.
More of it as lasting would leave the range to the bearings, and there an extended Kalman filter is biased by their
noise (V. Aidala, "Kalman filter behavior in bearings-only tracking applications", IEEE Transactions on Aerospace and
Electronic Systems 15(1), 1979)."""
_STATE = 9
"""Numbers of a model's state."""
_FIRST_SIGMAS = np.array([_SPEED_SIGMA, _SPEED_SIGMA, _CLIMB_SIGMA, _ASPECT_SIGMA, AMPLITUDE_SIGMA, _BEGAN_SIGMA_S])
"""Standard deviations of all but the position, of a new neighbour."""
_ROBUST_SIGMA = 2.5
"""Innovations beyond this many standard deviations count less and less."""
_ASTRAY = 0.05
"""Probability that a track tells nothing of another's size, though it looks as large: it is false, or mixed up."""
_JUDGED_SIGMA = 0.5
"""By how much the judged size may be off, where the equations are made linear before anything tells of it."""
_LOOKS_ALIKE = 0.2
"""Two drones whose logarithms of the judged sizes differ by much more are of two types: a standard deviation."""
_TOLD = 1.0
"""A track whose log likelihoods differ by less tells nothing of the size."""
_REMEMBERED = 200
"""So many ended tracks are remembered, the newest."""
_MODE_WIDTH, _MODE_SHARE = 0.3, 0.8
"""Of a size's probability so much has to lie within this, in log size, of the likeliest: else there are two."""


@dataclass(frozen=True)
class SizeEstimate:
    """A size from tip to tip as the flight shows it."""

    size_m: float
    sigma: float
    """Relative standard deviation, of the size's logarithm."""

    def deviations(self, size_m: float, sigma: float = 0.0) -> float:
        """By how many standard deviations another size, itself uncertain by `sigma`, is off."""
        return abs(math.log(size_m / self.size_m)) / math.hypot(self.sigma, sigma)


class FlockSize:
    """Weighs sizes by what each track shows while the own drone weaves. Deterministic; sums evidence over a flight."""

    def __init__(self) -> None:
        self._tracks: dict[int, _Track] = {}
        self._past: list[_Evidence] = []
        """Of tracks that ended and told something."""

    def step(self, interval_s: float, wove: FloatArray, sighted: Mapping[int, Measurement]) -> None:
        """Take in a step's measurements by track number, `interval_s` after the last.

        `wove` (3,) NED metres is the way that moved the own drone meanwhile and that nobody answers, as the weave.
        """
        for track in self._tracks.values():
            track.predict(interval_s, wove)
        for number, measurement in sighted.items():
            if number in self._tracks:
                self._tracks[number].update(measurement)
            else:
                self._tracks[number] = _Track(measurement)

    def keep(self, numbers: set[int]) -> None:
        """Only these tracks still exist; what the others showed stays."""
        ended = [self._tracks.pop(number) for number in self._tracks.keys() - numbers]
        told = [one.evidence for one in ended if np.ptp(one.log_likelihood) > _TOLD]
        self._past = [*self._past, *told][-_REMEMBERED:]

    def remember(self, looks_m: float, known: SizeEstimate) -> None:
        """That drones which the networks judge to be `looks_m` large were found to have another size."""
        sigma = math.sqrt(max(known.sigma**2 - _LEAST_SIGMA**2, _GRID**2))
        log_likelihood = -0.5 * ((LOG_SIZES - math.log(known.size_m)) / sigma) ** 2
        self._past.append(_Evidence(math.log(looks_m), log_likelihood))

    def of_looks(self, size_m: float) -> SizeEstimate | None:
        """The size of drones that the networks judge to have another, `size_m`; None: not known to `MOST_SIGMA`."""
        return _estimate(self._shared(math.log(size_m), self._evidence(self._tracks.values())))

    def of_track(self, number: int) -> SizeEstimate | None:
        """One track's own size, with what the others' evidence has in common with it; None as of `of_looks`."""
        own = self._tracks.get(number)
        if own is None:
            return None
        others = self._evidence(one for one in self._tracks.values() if one is not own)
        shared = self._shared(own.log_assumed_m, others)
        return _estimate(own.log_likelihood + _if_told(shared, 1.0 - _ASTRAY))

    def _evidence(self, tracks: Iterable[_Track]) -> list[_Evidence]:
        return [*self._past, *(one.evidence for one in tracks)]

    def _shared(self, log_judged_m: float, tracks: Sequence[_Evidence]) -> FloatArray:
        """(G,) log likelihood by what tracks showed of the size of a drone that is judged to be so large."""
        total = np.zeros(len(LOG_SIZES))
        for one in tracks:
            alike = math.exp(-0.5 * ((one.log_assumed_m - log_judged_m) / _LOOKS_ALIKE) ** 2)
            total += _if_told(one.log_likelihood, (1.0 - _ASTRAY) * alike)
        return total


class _Evidence(NamedTuple):
    """What one track showed."""

    log_assumed_m: float
    """As its size was judged."""
    log_likelihood: FloatArray
    """(G,) of the sizes."""


class _Track:
    """One track, under every motion model: filters over position and relative velocity, assumed metres, NED, the
    logarithm by which the side that is seen makes the range longer, by what share a weave of its is larger than
    `lift_m`, and how many seconds later it began.

    The first two models are of `_VERTICAL`; each of the others is a weave that began at another time.
    """

    def __init__(self, measurement: Measurement) -> None:
        self.log_assumed_m = math.log(measurement.size_m)
        self._scales = np.exp(self.log_assumed_m - LOG_SIZES)
        """(G,) of each size."""
        self._scale = 1.0
        """The one that the means are for."""
        self._log_prior = -0.5 * ((LOG_SIZES - self.log_assumed_m) / _JUDGED_SIGMA) ** 2
        self._plausible = np.abs(LOG_SIZES - self.log_assumed_m) < 2 * _JUDGED_SIGMA
        self.log_likelihood = np.zeros(len(LOG_SIZES))
        """(G,) of the sizes by all measurements, tempered."""
        mean, covariance = np.zeros(_STATE), np.zeros((_STATE, _STATE))
        mean[:3] = measurement.position
        covariance[:3, :3] = measurement.range_m**2 * _noise(measurement)
        covariance[range(3, _STATE), range(3, _STATE)] = _FIRST_SIGMAS**2
        self._elapsed_s = np.arange(0.0, DURATION_S, _BEGINS_S).tolist()
        """Since each weave began: a new neighbour may have begun before it was seen."""
        models = len(_VERTICAL) + len(self._elapsed_s)
        self._mean, self._covariance = np.tile(mean, (models, 1)), np.tile(covariance, (models, 1, 1))
        self._sensitivity = np.zeros((models, _STATE))
        """The mean's derivative with respect to the scale, the assumed over the true size."""
        self._log_weights = np.full((models, len(LOG_SIZES)), math.log(_BEGINS_PER_S * _BEGINS_S))
        self._log_weights[: len(_VERTICAL)] = -math.log(len(_VERTICAL))
        self._unasked_s = 0.0
        """Since the newest of them."""

    def predict(self, interval_s: float, wove: FloatArray) -> None:
        """`interval_s` later, the own drone having been moved by the weave by `wove` (3,) m."""
        models = len(self._mean)
        transition, noise, way = _motion(interval_s, models), _process_noise(interval_s, models), np.zeros(_STATE)
        way[:3] = wove
        lifts = np.zeros(models)
        for model, elapsed_s in enumerate(self._elapsed_s, len(_VERTICAL)):
            lifts[model] = lift_m(elapsed_s + interval_s) - lift_m(elapsed_s)
            transition[model, 2, 7] = -self._scale * lifts[model]
            transition[model, 2, 8] = self._scale * (climb_m_s(elapsed_s + interval_s) - climb_m_s(elapsed_s))
        moved = np.einsum("mij,mj->mi", transition, self._mean)
        by_scale = np.einsum("mij,mj->mi", transition, self._sensitivity) - way
        by_scale[:, 2] += (
            transition[:, 2, 7] * self._mean[:, 7] + transition[:, 2, 8] * self._mean[:, 8]
        ) / self._scale
        by_scale[:, 2] -= lifts
        self._mean = moved - self._scale * way
        self._mean[:, 2] -= self._scale * lifts
        self._sensitivity = by_scale
        self._covariance = transition @ self._covariance @ transition.transpose(0, 2, 1) + noise
        self._elapsed_s = [elapsed_s + interval_s for elapsed_s in self._elapsed_s]
        self._end_weaves()
        self._unasked_s = min(self._unasked_s + interval_s, DURATION_S)
        while self._unasked_s >= _BEGINS_S - 1e-6:
            self._unasked_s -= _BEGINS_S
            self._begin_weave(self._unasked_s)

    @property
    def evidence(self) -> _Evidence:
        """As of now."""
        return _Evidence(self.log_assumed_m, self.log_likelihood)

    def _begin_weave(self, elapsed_s: float) -> None:
        """One more model: that it flew level, and has woven for `elapsed_s`."""
        self._mean = np.vstack([self._mean, self._mean[:1]])
        self._covariance = np.concatenate([self._covariance, self._covariance[:1]])
        self._sensitivity = np.vstack([self._sensitivity, self._sensitivity[:1]])
        begins = self._log_weights[:1] + math.log(_BEGINS_PER_S * _BEGINS_S)
        self._log_weights = np.vstack([self._log_weights, begins])
        self._elapsed_s.append(elapsed_s)

    def _end_weaves(self) -> None:
        """Those that are over fly level again; those that cannot be are given up."""
        first = len(_VERTICAL)
        over = np.array([elapsed_s > DURATION_S + SETTLES_S for elapsed_s in self._elapsed_s], dtype=bool)
        likely = (self._log_weights[first:, self._plausible] > _GIVEN_UP).any(axis=1)
        size = int(np.argmax(self.log_likelihood + self._log_prior))
        for model in np.flatnonzero(over & likely) + first:
            if self._log_weights[model, size] > self._log_weights[0, size]:
                for each in (self._mean, self._covariance, self._sensitivity):
                    each[0] = each[model]
                self._mean[0, 7:] = self._sensitivity[0, 7:] = 0.0
                self._covariance[0, 7:] = self._covariance[0, :, 7:] = 0.0
                self._covariance[0, [7, 8], [7, 8]] = _FIRST_SIGMAS[4:] ** 2
            self._log_weights[0] = np.logaddexp(self._log_weights[0], self._log_weights[model])
        kept = np.concatenate([np.ones(first, dtype=bool), likely & ~over])
        self._mean, self._covariance, self._sensitivity, self._log_weights = (
            each[kept] for each in (self._mean, self._covariance, self._sensitivity, self._log_weights)
        )
        self._elapsed_s = [elapsed_s for elapsed_s, one in zip(self._elapsed_s, kept[first:], strict=True) if one]

    def update(self, measurement: Measurement) -> None:
        """Takes in a measurement."""
        likeliest = float(self._scales[np.argmax(self.log_likelihood + self._log_prior)])
        self._mean = self._mean + (likeliest - self._scale) * self._sensitivity
        self._scale = likeliest
        residual, derivative = self._linearised(measurement)
        spread = derivative @ self._covariance @ derivative.transpose(0, 2, 1) + _noise(measurement)
        by_scale = np.einsum("mij,mj->mi", derivative, self._sensitivity)
        whole = np.stack([residual, by_scale], axis=2)
        solved = np.linalg.solve(spread, whole)
        # d^2 of each size, as a quadratic function of its scale.
        square = np.einsum("mia,mib->mab", whole, solved)
        off = self._scales - self._scale
        distances = square[:, 0, 0, None] - 2 * square[:, 0, 1, None] * off + square[:, 1, 1, None] * off**2
        excess = np.maximum(1.0, distances.min(axis=1) / _ROBUST_SIGMA**2)
        gain = np.linalg.solve(excess[:, None, None] * spread, derivative @ self._covariance).transpose(0, 2, 1)
        self._weigh(np.maximum(distances, 0.0) / excess[:, None], spread, excess)
        self._mean = self._mean + np.einsum("mij,mj->mi", gain, residual)
        left = np.eye(_STATE) - gain @ derivative
        self._sensitivity = np.einsum("mij,mj->mi", left, self._sensitivity)
        covariance = left @ self._covariance
        self._covariance = (covariance + covariance.transpose(0, 2, 1)) / 2

    def _weigh(self, distances: FloatArray, spread: FloatArray, excess: FloatArray) -> None:
        """Sizes and motion models, by the squared distances (M, G) of an innovation."""
        far = distances > _ROBUST_SIGMA**2
        distances = np.where(far, 2 * _ROBUST_SIGMA * np.sqrt(distances) - _ROBUST_SIGMA**2, distances)
        log_volume = np.linalg.slogdet(spread).logabsdet + 3 * np.log(excess)
        logs = math.log1p(-_SWITCHING) + self._log_weights
        bases = slice(len(_VERTICAL))
        logs[bases] = np.logaddexp(logs[bases], math.log(_SWITCHING / len(_VERTICAL)))
        logs -= 0.5 * (distances + log_volume[:, None])
        marginal = np.logaddexp.reduce(logs, axis=0)
        self._log_weights = logs - marginal
        self.log_likelihood = self.log_likelihood + _TEMPER * marginal

    def _linearised(self, measurement: Measurement) -> tuple[FloatArray, FloatArray]:
        """Residuals (M, 3) as of `log_polar_residual`, and the derivative (M, 3, 9) of the predicted measurement."""
        ranges = np.maximum(np.linalg.norm(self._mean[:, :3], axis=1), MIN_RANGE_M)
        bearings = self._mean[:, :3] / ranges[:, None]
        cosines = np.clip(bearings @ measurement.bearing, -1.0, 1.0)
        across = measurement.bearing - cosines[:, None] * bearings
        sines = np.linalg.norm(across, axis=1)
        turned = across * (np.arctan2(sines, cosines) / np.maximum(sines, 1e-12))[:, None]
        log_range = measurement.log_range - math.log(measurement.size_m) + self.log_assumed_m
        along = log_range - np.log(ranges) - self._mean[:, 6]
        derivative = np.zeros((len(ranges), 3, _STATE))
        derivative[:, range(3), range(3)] = 1.0 / ranges[:, None]
        derivative[:, :, 6] = bearings
        return turned + along[:, None] * bearings, derivative


def _motion(interval_s: float, models: int) -> FloatArray:
    """The transition (M, 9, 9) of each model, but for what a weave does."""
    transition = np.eye(_STATE)
    transition[:3, 3:6] = interval_s * np.eye(3)
    transition[6, 6] = math.exp(-interval_s / _ASPECT_TIME_S)
    return np.tile(transition, (models, 1, 1))


def _process_noise(interval_s: float, models: int) -> FloatArray:
    """(M, 9, 9) of each model."""
    dt = interval_s
    noise = np.zeros((models, _STATE, _STATE))
    by_time = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    for axis in range(3):
        noise[:, axis : axis + 4 : 3, axis : axis + 4 : 3] = by_time
    noise[:, :6, :6] *= _LEVEL
    of_height = np.full(models, _WEAVING)
    of_height[: len(_VERTICAL)] = _VERTICAL
    noise[:, 2:6:3, 2:6:3] *= of_height[:, None, None] / _LEVEL
    noise[:, 6, 6] = -math.expm1(-2 * dt / _ASPECT_TIME_S) * _ASPECT_SIGMA**2
    return noise


def _noise(measurement: Measurement) -> FloatArray:
    """(3, 3) covariance of bearing and assumed log range, in NED axes."""
    noise: FloatArray = measurement.covariance + _RANGE_SIGMA**2 * np.outer(measurement.bearing, measurement.bearing)
    return noise


def _if_told(log_likelihood: FloatArray, probability: float) -> FloatArray:
    """(G,) log likelihood of one's size by what tells of it with a probability, and else of nothing."""
    normal = log_likelihood - np.logaddexp.reduce(log_likelihood)
    told: FloatArray = np.logaddexp(
        math.log(max(probability, 1e-9)) + normal, math.log((1.0 - probability) / len(normal))
    )
    return told


def _estimate(log_likelihood: FloatArray) -> SizeEstimate | None:
    """The likeliest size; None where it is not known well enough, there are two, or it is no size that is weighed."""
    weights = np.exp(log_likelihood - log_likelihood.max())
    likeliest = LOG_SIZES[np.argmax(weights)]
    near = np.abs(LOG_SIZES - likeliest) <= _MODE_WIDTH
    share = weights[near].sum() / weights.sum()
    weights = np.where(near, weights, 0.0) / weights[near].sum()
    mean = float(weights @ LOG_SIZES)
    sigma = math.sqrt(float(weights @ (LOG_SIZES - mean) ** 2) + _LEAST_SIGMA**2)
    inside = LOG_SIZES[0] + _MODE_WIDTH <= likeliest <= LOG_SIZES[-1] - _MODE_WIDTH
    return SizeEstimate(math.exp(mean), sigma) if inside and share >= _MODE_SHARE and sigma < MOST_SIGMA else None
