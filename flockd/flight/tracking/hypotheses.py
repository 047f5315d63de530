"""What a drone may be that was just seen: a flock mate, which moves as one does oneself, or a stranger, which may come.

Static multiple models (Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, section 11.6.2): each hypothesis has a filter of its own, and detections weigh them by Bayes' rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from flockd.core.config.tracking import TrackingParameters
from flockd.core.messages import FloatArray
from flockd.flight.tracking import filter  # noqa: A004 - the field's word
from flockd.flight.tracking.filter import Innovation, State
from flockd.flight.tracking.measurement import Measurement

_GIVEN_UP = 0.02
"""A hypothesis that is less probable than this is followed no longer."""
_SETTLED_HITS = 6
"""After so many detections the filters of all hypotheses have learnt the velocity: the likeliest is kept."""


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
    def first(cls, measurement: Measurement, own_velocity: FloatArray | None, parameters: TrackingParameters) -> Self:
        """After a first detection. `own_velocity` (3,) NED m/s; None: no drone is known to fly with this one."""
        stranger = filter.initial(measurement, np.zeros(3), parameters.speed_sigma_m_s, parameters)
        if own_velocity is None:
            return cls((Hypothesis(1.0, stranger),))
        mate = filter.initial(measurement, own_velocity, parameters.relative_speed_sigma_m_s, parameters)
        share = parameters.stranger_probability
        return cls(_sorted((Hypothesis(1.0 - share, mate), Hypothesis(share, stranger))))

    @property
    def state(self) -> State:
        """The mean and the covariance of all together; of one it is its state."""
        if len(self.each) == 1:
            return self.each[0].state
        mean = sum((h.probability * h.state.mean for h in self.each), np.zeros(7))
        covariance = np.zeros((7, 7))
        for h in self.each:
            off = h.state.mean - mean
            covariance += h.probability * (h.state.covariance + np.outer(off, off))
        return State(mean, covariance)

    def innovation(self, measurement: Measurement, parameters: TrackingParameters) -> Innovation:
        """Of a measurement against the hypothesis that explains it best."""
        found = [filter.innovation(h.state, measurement, parameters) for h in self.each]
        best = max(
            zip(self.each, found, strict=True), key=lambda one: math.log(one[0].probability) + one[1].log_likelihood
        )
        return best[1]

    def changed(self, change: Callable[[State], State]) -> Hypotheses:
        """With every state changed, and the probabilities as they are."""
        return Hypotheses(tuple(replace(h, state=change(h.state)) for h in self.each))

    def updated(self, measurement: Measurement, hits: int, parameters: TrackingParameters) -> Hypotheses:
        """After a detection, the track's `hits`-th."""
        updated = self.changed(lambda state: filter.update(state, measurement, parameters))
        if len(self.each) == 1:
            return updated
        logs = np.array(
            [
                math.log(h.probability) + filter.innovation(h.state, measurement, parameters).log_likelihood
                for h in self.each
            ]
        )
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        kept = weights >= (weights.max() if hits >= _SETTLED_HITS else _GIVEN_UP)
        weights = weights * kept / weights[kept].sum()
        each = (
            Hypothesis(float(weight), h.state) for weight, h in zip(weights, updated.each, strict=True) if weight > 0
        )
        return Hypotheses(_sorted(tuple(each)))


def _sorted(each: tuple[Hypothesis, ...]) -> tuple[Hypothesis, ...]:
    return tuple(sorted(each, key=lambda h: -h.probability))
