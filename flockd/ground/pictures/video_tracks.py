"""Drones followed through the frames of a video, of whose camera neither motion nor ranges are known: in the image.

SORT (A. Bewley et al., "Simple online and realtime tracking", ICIP 2016): a Kalman filter of place and size for each
track, and the optimal assignment; with flight's own existence probability in place of counts of frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from flockd.core.config.tracking import TrackingParameters
from flockd.core.messages import FloatArray
from flockd.flight.tracking import existence
from flockd.flight.tracking.association import assign
from flockd.ground.pictures.single_frame import DetectedDrone

_MANOEUVRE = 0.5
"""Motion of drone and hand-held camera, in longer sides of the image: standard deviation of the speed of a new track,
per s, and of the change of a speed within a second."""
_PLACE_SIGMA = 0.1
"""Of a box's middle, in sizes of the box."""
_SIZE_SIGMA = 0.15
"""Standard deviation of the logarithm of a box's size: outer propellers appear and vanish."""
_SIZE_DRIFT = 0.5
"""Of the same, for each square root of a second: drones turn and come nearer."""


@dataclass
class _Track:
    number: int
    """0 until it is confirmed."""
    drone: DetectedDrone
    """As last detected."""
    mean: FloatArray
    """(2, 2): place right and down and velocity, in shares of the longer side."""
    covariance: FloatArray
    """(2, 2) of place and velocity along either axis."""
    log_size: float
    log_size_variance: float
    existence: float
    drone_probability: float
    seen_s: float
    hits: int = 1
    agreed: float = 1.0
    confirmed: bool = False


class VideoTracker:
    """Follows the drones of one video. Deterministic."""

    def __init__(self) -> None:
        self._parameters = TrackingParameters()
        self._side, self._borders = 1.0, np.ones(2)
        self._tracks: list[_Track] = []
        self._time_s, self._numbered = 0.0, 0

    def update(
        self, time_s: float, size: tuple[int, int], detections: Sequence[DetectedDrone]
    ) -> tuple[DetectedDrone, ...]:
        """The confirmed tracks, by number, given the detections in the frame of ``time_s``, which must not decrease.

        A track without a detection has its last one, moved on to where it should be, if that is in view.
        ``size``: width and height of the frame, pixels.
        """
        self._side, self._borders = float(max(size)), np.array(size) / max(size)
        interval_s, self._time_s = max(time_s - self._time_s, 0.0), time_s
        weight = min(1.0, interval_s / self._parameters.evidence_interval_s)
        for track in self._tracks:
            _predict(track, interval_s, self._parameters)
        places = [self._measured(one) for one in detections]
        squared, likelihoods = self._innovations(places)
        pairs = assign(squared, likelihoods, self._parameters.gate_sigma)
        for index, track in enumerate(self._tracks):
            if index not in pairs.values():
                in_view = float(self._in_view(track))
                track.existence = existence.missed(track.existence, in_view, weight, self._parameters)
        for row, one in enumerate(detections):
            if row in pairs:
                self._detect(self._tracks[pairs[row]], one, places[row], likelihoods[row, pairs[row]], weight)
            else:
                self._begin(one, places[row])
        self._tracks = [track for track in self._tracks if self._is_kept(track)]
        shown = (one for one in self._tracks if one.confirmed and (one.seen_s == time_s or self._in_view(one)))
        return tuple(self._shown(track) for track in shown)

    def _measured(self, one: DetectedDrone) -> tuple[FloatArray, float, float]:
        """Place (2,), logarithm of the size, and variance of the place, all in shares of the longer side."""
        left, top, right, bottom = np.array(one.box) / self._side
        size = max(right - left, bottom - top, 1.0 / self._side)
        variance = (_PLACE_SIGMA * size) ** 2 + self._side**-2
        return np.array([left + right, top + bottom]) / 2, math.log(size), variance

    def _innovations(self, places: Sequence[tuple[FloatArray, float, float]]) -> tuple[FloatArray, FloatArray]:
        """Squared Mahalanobis distances (k, n) of detections from tracks, and logarithms of their densities."""
        squared = np.empty((len(places), len(self._tracks)))
        volumes = np.empty_like(squared)
        for row, (place, log_size, variance) in enumerate(places):
            for column, track in enumerate(self._tracks):
                of_place = track.covariance[0, 0] + variance
                of_size = track.log_size_variance + _SIZE_SIGMA**2
                off = place - track.mean[0]
                squared[row, column] = off @ off / of_place + (log_size - track.log_size) ** 2 / of_size
                volumes[row, column] = of_place * math.sqrt(of_size)
        return squared, -0.5 * squared - np.log(volumes * math.tau**1.5)

    def _detect(
        self,
        track: _Track,
        one: DetectedDrone,
        measured: tuple[FloatArray, float, float],
        log_likelihood: float,
        weight: float,
    ) -> None:
        place, log_size, variance = measured
        gain = track.covariance[:, 0] / (track.covariance[0, 0] + variance)
        track.mean = track.mean + np.outer(gain, place - track.mean[0])
        track.covariance = track.covariance - np.outer(gain, track.covariance[0])
        share = track.log_size_variance / (track.log_size_variance + _SIZE_SIGMA**2)
        track.log_size += share * (log_size - track.log_size)
        track.log_size_variance *= 1 - share
        p, since_s = self._parameters, self._time_s - track.seen_s
        track.existence = existence.detected(track.existence, log_likelihood, weight, p)
        track.hits += 1
        track.agreed += weight
        track.drone_probability = existence.averaged(track.drone_probability, one.probability, track.hits, since_s, p)
        track.drone, track.seen_s = one, self._time_s

    def _begin(self, one: DetectedDrone, measured: tuple[FloatArray, float, float]) -> None:
        place, log_size, variance = measured
        self._tracks.append(
            _Track(
                0, one, np.stack([place, np.zeros(2)]), np.diag([variance, _MANOEUVRE**2]), log_size,
                _SIZE_SIGMA**2, self._parameters.birth_probability, one.probability, self._time_s,
            )
        )  # fmt: skip

    def _is_kept(self, track: _Track) -> bool:
        p = self._parameters
        needed = p.keep_probability if track.confirmed else p.confirm_probability
        sure = track.existence * track.drone_probability > needed
        track.confirmed = sure and track.agreed >= p.confirm_hits
        if track.confirmed and not track.number:
            self._numbered += 1
            track.number = self._numbered
        return track.existence >= p.drop_probability and self._time_s - track.seen_s <= p.max_unseen_s

    def _in_view(self, track: _Track) -> bool:
        return bool(((track.mean[0] > 0) & (track.mean[0] < self._borders)).all())

    def _shown(self, track: _Track) -> DetectedDrone:
        if track.seen_s == self._time_s:
            return replace(track.drone, track=track.number)
        left, top, right, bottom = track.drone.box
        middle = self._side * track.mean[0]
        half = np.array([right - left, bottom - top]) / 2
        x0, y0, x1, y1 = (float(value) for value in np.concatenate([middle - half, middle + half]))
        return replace(track.drone, box=(x0, y0, x1, y1), track=track.number, label=0)


def _predict(track: _Track, interval_s: float, parameters: TrackingParameters) -> None:
    """White acceleration (Bar-Shalom, Li & Kirubarajan 2001, section 6.2)."""
    moved = np.array([[1.0, interval_s], [0.0, 1.0]])
    noise = np.array([[interval_s**3 / 3, interval_s**2 / 2], [interval_s**2 / 2, interval_s]])
    track.mean = moved @ track.mean
    track.covariance = moved @ track.covariance @ moved.T + _MANOEUVRE**2 * noise
    track.log_size_variance += _SIZE_DRIFT**2 * interval_s
    track.existence *= math.exp(-interval_s / parameters.survival_time_s)
