"""The tracker: follows neighbours from frame set to frame set, each with a probability of existing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flockd.core.config.safety import GateParameters
from flockd.core.config.tracking import JITTER_S, TrackingParameters
from flockd.core.messages import BoolArray, FloatArray, Neighbour
from flockd.flight.tracking import existence, filter, imm  # noqa: A004 - the field's word
from flockd.flight.tracking.association import assign
from flockd.flight.tracking.filter import Measurements
from flockd.flight.tracking.measurement import Measurement

_OF_USUAL = 0.02
"""Weight of one detection in the usual range sigma: it averages over about fifty."""
_UNSEEN_SHARE = 0.1
"""A track that is likely to exist is kept unseen for `max_unseen_s`, or for this share of its age if that is longer.
Otherwise its next detection, often a vague one, would start a new track."""
_SUREST = 0.01
"""Least standard deviation of a log range: with a smaller one, a network that is too certain of one neighbour would
keep others from being confirmed."""

Shown = Callable[[FloatArray, float], BoolArray]
"""(positions (n, 3) in metres NED from the own drone, radius in metres) -> (n,) whether a camera now shows the whole
sphere around each position."""
_SIGMA_POINTS = math.sqrt(3) * np.concatenate([np.eye(3), -np.eye(3)])
"""(6, 3) sigma points of equal weight for three independent standard normal numbers (S. Julier, J. Uhlmann, "Unscented
filtering and nonlinear estimation", 2004)."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where a confirmed neighbour is expected next."""

    position: FloatArray
    """(3,) metres, NED, own drone at the origin."""
    size_m: float
    """As of `Detection.size_m`."""


class Tracker:
    """Follows neighbours in level axes that point north, east and down, with the own drone at the origin.

    In each step call `predict`, then `update`, even without measurements, then `neighbours`. Deterministic.
    """

    def __init__(self, parameters: TrackingParameters | None = None, gate: GateParameters | None = None) -> None:
        """`gate`: the own drone's; a neighbour is expected to brake as hard as its limit allows."""
        self.parameters = parameters or TrackingParameters()
        self._braking_m_s2 = (gate or GateParameters()).max_acceleration_m_s2
        self._tracks: list[_Track] = []
        self._motions = imm.nobody()
        """The states of the tracks, in their order."""
        self._usual_log_sigma: float | None = None
        """Logarithm of the usual standard deviation of a confirmed neighbour's log range, as detected."""
        self._time_s = 0.0
        self._created = 0

    def predict(
        self, interval_s: float, own_displacement: FloatArray | None, own_displacement_sigma_m: float = 0.0
    ) -> None:
        """Predicts all tracks `interval_s` ahead.

        `own_displacement` (3,) NED metres is the own drone's displacement meanwhile, with its standard deviation on
        each axis. None: not known; the tracks then keep their places relative to the own drone, as flock mates move
        alike, and their uncertainty grows by `relative_speed_sigma_m_s`.
        """
        self._motions = imm.predicted(
            self._motions, interval_s, own_displacement, own_displacement_sigma_m, self.parameters, self._braking_m_s2
        )
        for track in self._tracks:
            track.existence = self._survives(track, interval_s)

    def update(
        self,
        time_s: float,
        measurements: Sequence[Measurement],
        own_velocity: FloatArray | None = None,
        shown: Shown | None = None,
    ) -> tuple[int, ...]:
        """Takes one frame set's measurements at `time_s`. Returns each one's track number, new if it fits no track.

        `own_velocity` (3,) NED m/s is the velocity that new tracks start with, as flock mates move alike (`imm.first`).
        `shown` tells what the cameras can see (None: everything). A confirmed neighbour that leaves their view keeps
        its probability, except for the share of its possible positions that they see: it is kept until it should have
        come into view again.
        """
        interval_s = max(0.0, time_s - self._time_s)
        weight = min(1.0, interval_s / (self.parameters.evidence_interval_s - JITTER_S))
        self._time_s = time_s
        measured = Measurements.of(measurements, self.parameters)
        squared_distances, log_likelihoods = self._motions.innovations(measured)
        pairs = assign(squared_distances, log_likelihoods, self.parameters.gate_sigma)
        for row in range(len(measurements)):
            if row not in pairs:
                pairs |= self._misjudged(measured, row, set(pairs.values()))
        missed = [column for column in range(len(self._tracks)) if column not in pairs.values()]
        if missed:
            self._miss(missed, interval_s, weight, shown)
        for row, column in pairs.items():
            of_pair = squared_distances[row, column], log_likelihoods[row, column]
            self._detect(self._tracks[column], measurements[row], *of_pair, weight)
        if pairs:
            rows, columns = list(pairs), list(pairs.values())
            detected = imm.updated(self._motions[columns], measured[rows], self.parameters)
            self._motions = self._motions.replaced(columns, detected)
        numbers = []
        for row, measurement in enumerate(measurements):
            if row not in pairs:
                pairs[row] = len(self._tracks)
                self._tracks.append(self._begin(measurement))
                first = imm.first(measurement, own_velocity, self.parameters)
                self._motions = imm.Mixture.concatenate([self._motions, first])
            numbers.append(self._tracks[pairs[row]].number)
        for track in self._tracks:
            self._confirm(track)
        kept = [index for index, track in enumerate(self._tracks) if self._is_kept(track)]
        self._tracks, self._motions = [self._tracks[index] for index in kept], self._motions[kept]
        return tuple(numbers)

    def predictions(self, interval_s: float, own_velocity: FloatArray | None) -> tuple[Prediction, ...]:
        """Expected positions of all tracks that were ever confirmed, after `interval_s`, at constant velocities.

        `own_velocity` (3,) NED m/s; None: all keep their places relative to the own drone. Changes no track.
        """
        displacement = None if own_velocity is None else interval_s * own_velocity
        known = [index for index, track in enumerate(self._tracks) if track.was_confirmed]
        later = imm.predicted(self._motions[known], interval_s, displacement, 0.0, self.parameters, self._braking_m_s2)
        return tuple(Prediction(mean[:3], math.exp(mean[6])) for mean in later.together.mean[:, 0])

    def resize(self, size_m: float, own_velocity: FloatArray | None) -> None:
        """Rescales all neighbours to `size_m`, from tip to tip, and their ranges by the same factor.

        `own_velocity` (3,) NED m/s; None: not known.
        """
        self._motions = imm.resized(self._motions, size_m, own_velocity)

    def forget(self) -> None:
        """Deletes all tracks."""
        self._tracks, self._motions = [], imm.nobody()

    def neighbours(self) -> tuple[Neighbour, ...]:
        """All tracks as of the last `predict` and `update`, confirmed or not, by track number."""
        together = self._motions.together
        return tuple(
            Neighbour(
                track=track.number,
                position=mean[:3],
                velocity=mean[3:6],
                position_sigma_m=self._position_sigma_m(mean, covariance),
                velocity_sigma_m_s=math.sqrt(covariance[3:6, 3:6].trace() / 3),
                age_s=self._time_s - track.first_seen_s,
                unseen_s=self._time_s - track.last_seen_s,
                hits=track.hits,
                confirmed=track.confirmed,
                existence_probability=track.existence * track.drone_probability,
                possible=possible,
            )
            for track, mean, covariance, possible in zip(
                self._tracks, together.mean[:, 0], together.covariance[:, 0], self._motions.possible(), strict=True
            )
        )

    def _survives(self, track: _Track, interval_s: float) -> float:
        """Probability of existence after `interval_s`: a track that was never confirmed decays faster."""
        p = self.parameters
        lasts_s = p.survival_time_s if track.was_confirmed else p.drone_probability_memory_s
        return track.existence * math.exp(-interval_s / lasts_s)

    def _position_sigma_m(self, mean: FloatArray, covariance: FloatArray) -> float:
        """Standard deviation of the position, each axis, with the share of the heading's error."""
        variance = covariance[:3, :3].trace() + (self.parameters.heading_sigma_rad * math.hypot(*mean[:2])) ** 2
        return math.sqrt(variance / 3)

    def _miss(self, missed: Sequence[int], interval_s: float, weight: float, shown: Shown | None) -> None:
        together = self._motions[missed].together
        for place, index in enumerate(missed):
            track, mean, covariance = self._tracks[index], together.mean[place, 0], together.covariance[place, 0]
            in_view = 1.0 if shown is None else _probability_in_view(mean, covariance, shown)
            track.existence = existence.missed(track.existence, in_view, weight, self.parameters)
            track.missing_s += in_view * interval_s

    def _detect(
        self, track: _Track, measurement: Measurement, squared_distance: float, log_likelihood: float, weight: float
    ) -> None:
        interval_s = max(0.0, self._time_s - track.last_seen_s)
        track.hits += 1
        track.agrees = bool(squared_distance <= self.parameters.confirm_sigma**2)
        before, track.share = track.share, self._share(measurement)
        track.agreed += weight * track.agrees * track.share
        if track.confirmed:
            self._remember(measurement, weight)
        persists = (1.0 - before) * (1.0 - track.share)  # both detections are likely false if both are vague
        track.existence = existence.detected(track.existence, log_likelihood, weight, self.parameters, persists)
        track.drone_probability = existence.averaged(
            track.drone_probability, measurement.drone_probability, track.hits, interval_s, self.parameters
        )
        track.last_seen_s, track.missing_s = self._time_s, 0.0

    def _share(self, measurement: Measurement) -> float:
        """The evidence of one detection, 0 to 1: vague ranges count less."""
        if self._usual_log_sigma is None:
            return 1.0
        return min(1.0, self.parameters.vague_factor * math.exp(self._usual_log_sigma - _log_sigma(measurement)))

    def _remember(self, measurement: Measurement, weight: float) -> None:
        """Updates the usual range sigma of confirmed neighbours."""
        log_sigma = _log_sigma(measurement)
        usual = log_sigma if self._usual_log_sigma is None else self._usual_log_sigma
        self._usual_log_sigma = usual + _OF_USUAL * weight * (log_sigma - usual)

    def _misjudged(self, measured: Measurements, row: int, detected: set[int]) -> dict[int, int]:
        """A measurement without a track -> the undetected neighbour that fits its bearing and size, if any.

        Either an unknown drone hides the neighbour, or, more often, the range is wrong. So the measurement is assigned
        to a neighbour that is confirmed and whose last detection was where it was expected.
        """
        known = [i for i, one in enumerate(self._tracks) if one.confirmed and one.agrees and i not in detected]
        if not known:
            return {}
        together = self._motions[known].together
        off = filter.squared_distances_but_range(together.mean[:, 0], together.covariance[:, 0], measured[[row]][:, 0])
        nearest = int(off.argmin())
        return {row: known[nearest]} if off[nearest] <= self.parameters.confirm_sigma**2 else {}

    def _begin(self, measurement: Measurement) -> _Track:
        self._created += 1
        share = self._share(measurement)
        return _Track(
            number=self._created,
            existence=existence.begun(measurement.drone_probability, share, self.parameters),
            drone_probability=measurement.drone_probability,
            first_seen_s=self._time_s,
            last_seen_s=self._time_s,
            share=share,
            agreed=share,
        )

    def _confirm(self, track: _Track) -> None:
        needed = self.parameters.keep_probability if track.confirmed else self.parameters.confirm_probability
        track.confirmed = (
            track.agreed >= self.parameters.confirm_hits and track.existence * track.drone_probability > needed
        )
        track.was_confirmed |= track.confirmed

    def _is_kept(self, track: _Track) -> bool:
        known_s = track.last_seen_s - track.first_seen_s
        longest_s = max(self.parameters.max_unseen_s, _UNSEEN_SHARE * known_s)
        least = self.parameters.drop_probability * track.share  # a vague track is kept until more detections tell
        return track.missing_s <= longest_s + JITTER_S and track.existence >= least


def _probability_in_view(mean: FloatArray, covariance: FloatArray, shown: Shown) -> float:
    """The probability that a camera shows the whole neighbour: one cut by the image's border is often missed."""
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    spread = _SIGMA_POINTS * np.sqrt(np.maximum(variances, 0.0))  # rounding may make one slightly negative
    return float(shown(mean[:3] + spread @ axes.T, math.exp(mean[6]) / 2).mean())


def _log_sigma(measurement: Measurement) -> float:
    """Logarithm of the standard deviation of its log range."""
    return math.log(max(measurement.log_range_variance, _SUREST**2)) / 2


@dataclass
class _Track:
    """One neighbour, without its state."""

    number: int
    existence: float
    """Probability that the track is of something that persists."""
    drone_probability: float
    """Probability that it is a drone if it exists."""
    first_seen_s: float
    last_seen_s: float
    share: float
    """Evidence of the newest detection, 0 to 1."""
    agreed: float
    """Sum of the evidence of hits within `confirm_sigma`: independent and precise ones count 1."""
    hits: int = 1
    missing_s: float = 0.0
    """Time in view without a detection since the last one."""
    agrees: bool = True
    """Whether the last hit was within `confirm_sigma`."""
    confirmed: bool = False
    was_confirmed: bool = False
