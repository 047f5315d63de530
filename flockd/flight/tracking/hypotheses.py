"""What a drone may be that was just seen: a flock mate, which moves as one does oneself, or a stranger, which may come.

A stranger may fly anywhere, or be on a course to meet: its bearing then stays the same, as a mate's does, and the range
alone tells them apart, by its rate over itself: the inverse of the time to contact, which is how fast the drone grows
in the image, whatever its size (D. Lee, "A theory of visual control of braking based on information about
time-to-collision", Perception 5, 1976). As a third hypothesis it is not outweighed by the bearings, which fit a mate.

Static multiple models (Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, section 11.6.2): each hypothesis has a filter of its own, and detections weigh them by Bayes' rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from flockd.core.config.tracking import TrackingParameters
from flockd.core.messages import FloatArray, PossibleMotion
from flockd.flight.tracking import filter  # noqa: A004 - the field's word
from flockd.flight.tracking.filter import Innovation, State
from flockd.flight.tracking.measurement import Measurement

_GIVEN_UP = 0.01
"""A hypothesis that is less probable than this is followed no longer."""
_ALIKE = 0.05
"""Bhattacharyya distance below which two velocities are one (A. Bhattacharyya, "On a measure of divergence between two
statistical populations", 1943): of equal covariances, means 0.6 standard deviations apart."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One of a track's states, and how probable it is that it is the true one."""

    probability: float
    state: State


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """All of one track, the likeliest first; their probabilities add up to 1."""

    each: tuple[Hypothesis, ...]

    @classmethod
    def first(
        cls,
        measurement: Measurement,
        own_velocity: FloatArray | None,
        parameters: TrackingParameters,
        misjudged: State | None = None,
    ) -> Self:
        """After a first detection. `own_velocity` (3,) NED m/s; None: no drone is known to fly with this one.

        `misjudged`: a neighbour that should have been seen in this bearing, and was not, at its own range. It is most
        likely the one that was detected, at a range that is wrong, and flies as it did.
        """
        bearing = measurement.bearing
        along = np.outer(bearing, bearing)
        unknown, alike = parameters.speed_sigma_m_s**2, parameters.relative_speed_sigma_m_s**2
        stranger = filter.initial(measurement, np.zeros(3), unknown * np.eye(3), parameters)
        if own_velocity is None:
            return cls((Hypothesis(1.0, stranger),))
        share = parameters.stranger_probability
        mate = filter.initial(measurement, own_velocity, alike * np.eye(3), parameters)
        if misjudged is not None:
            share = parameters.hiding_stranger_probability
            mate = filter.initial(measurement, misjudged.velocity, misjudged.velocity_covariance, parameters)
        across = own_velocity - along @ own_velocity
        meets = filter.initial(measurement, across, alike * np.eye(3) + (unknown - alike) * along, parameters)
        each = (Hypothesis(1.0 - share, mate), Hypothesis(share / 2, meets), Hypothesis(share / 2, stranger))
        return cls(tuple(_likeliest_first(each)))

    @property
    def state(self) -> State:
        """The mean and the covariance of all together; of one it is its state."""
        if len(self.each) == 1:
            return self.each[0].state
        mean = sum((h.probability * h.state.mean for h in self.each), np.zeros(filter.SIZE))
        covariance = np.zeros((filter.SIZE, filter.SIZE))
        for h in self.each:
            off = h.state.mean - mean
            covariance += h.probability * (h.state.covariance + np.outer(off, off))
        return State(mean, covariance)

    @property
    def possible(self) -> tuple[PossibleMotion, ...]:
        """Each as the gate reckons with it."""
        return tuple(_possible(h) for h in self.each)

    def innovation(self, measurement: Measurement, parameters: TrackingParameters) -> Innovation:
        """Of a measurement against the hypothesis that explains it best."""
        return max(self._innovations(measurement, parameters), key=lambda one: one.log_likelihood)

    def _innovations(self, measurement: Measurement, parameters: TrackingParameters) -> list[Innovation]:
        found = [filter.innovation(h.state, measurement, parameters) for h in self.each]
        return [replace(one, log_prior=math.log(h.probability)) for h, one in zip(self.each, found, strict=True)]

    def changed(self, change: Callable[[State], State]) -> Hypotheses:
        """With every state changed, and the probabilities as they are."""
        return Hypotheses(tuple(replace(h, state=change(h.state)) for h in self.each))

    def updated(self, measurement: Measurement, parameters: TrackingParameters) -> Hypotheses:
        """After a detection."""
        updated = self.changed(lambda state: filter.update(state, measurement, parameters))
        if len(self.each) == 1:
            return updated
        logs = np.array([one.log_likelihood for one in self._innovations(measurement, parameters)])
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        kept = weights >= _GIVEN_UP
        weights = weights * kept / weights[kept].sum()
        each = (
            Hypothesis(float(weight), h.state) for weight, h in zip(weights, updated.each, strict=True) if weight > 0
        )
        return Hypotheses(_merged(_likeliest_first(each)))


def _possible(hypothesis: Hypothesis) -> PossibleMotion:
    state = hypothesis.state
    bearing = state.position / max(float(np.linalg.norm(state.position)), filter.MIN_RANGE_M)
    return PossibleMotion(
        hypothesis.probability,
        state.position,
        state.velocity,
        range_sigma_m=math.sqrt(bearing @ state.position_covariance @ bearing),
        closing_sigma_m_s=math.sqrt(bearing @ state.velocity_covariance @ bearing),
    )


def _likeliest_first(each: Iterable[Hypothesis]) -> list[Hypothesis]:
    return sorted(each, key=lambda h: -h.probability)


def _merged(each: Sequence[Hypothesis]) -> tuple[Hypothesis, ...]:
    """Without those that came to the velocity of a likelier one, which gains their probability."""
    kept: list[Hypothesis] = []
    for one in each:
        alike = (i for i, other in enumerate(kept) if _apart(one.state, other.state) < _ALIKE)
        place = next(alike, None)
        if place is None:
            kept.append(one)
        else:
            kept[place] = replace(kept[place], probability=kept[place].probability + one.probability)
    return tuple(kept)


def _apart(one: State, other: State) -> float:
    """The Bhattacharyya distance of two velocities."""
    off, a, b = other.velocity - one.velocity, one.velocity_covariance, other.velocity_covariance
    mean = (a + b) / 2
    spread = np.linalg.det(mean) / math.sqrt(np.linalg.det(a) * np.linalg.det(b))
    return float(off @ np.linalg.solve(mean, off)) / 8 + math.log(spread) / 2
