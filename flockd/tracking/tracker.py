"""The tracker: one Kalman filter a neighbour, nearest-neighbour association, confirmation and forgetting."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flockd.config.tracking import TrackingParameters
from flockd.messages import BoolArray, FloatArray, Neighbour
from flockd.tracking.measurement import Measurement

_RELATIVE_SPEED_SIGMA_M_S = 0.7
"""How much flock mates' velocities differ: what is assumed of a drone just seen for the first time."""
_SPEED_SIGMA_M_S = 1.5
"""The same where the own velocity is not known either."""
_MANOEUVRE_TIME_S = 0.5
"""How long an acceleration lasts: turns its standard deviation into a spectral density."""
_ROBUST_SIGMA = 2.5
"""Innovations beyond this many standard deviations count less and less (90 % of honest ones are nearer)."""
_EVIDENCE_STEPS = 10
"""How far back the question goes whether a track is a drone."""
_ANGULAR_SIZE_SIGMA = 0.01
"""Relative error of a drone's angular size in one frame set."""

Blind = Callable[[FloatArray], BoolArray]
"""Of places (n, 3), metres NED from the own drone: which (n,) no camera could show at this time."""

_POSITION = np.hstack([np.eye(3), np.zeros((3, 3))])
_VELOCITY = np.hstack([np.zeros((3, 3)), np.eye(3)])


@dataclass(frozen=True, eq=False)
class ExpectedNeighbour:
    """Where a drone should be seen next."""

    position: FloatArray
    """(3,) metres, NED, own drone at the origin."""
    size_m: float
    """As of `Detection.size_m`."""


@dataclass
class _Track:
    """State (6,): position relative to the own drone and velocity over ground, NED."""

    number: int
    state: FloatArray
    covariance: FloatArray
    first_seen_s: float
    last_seen_s: float
    sizes: deque[float]
    size_m: float
    evidence: deque[float]
    """Of the last steps in which it could be seen, 2 p - 1 for the probability p of being a drone; 0 if it was not."""
    hits: int = 1
    confirmed: bool = False
    was_confirmed: bool = False


class Tracker:
    """Follows neighbours in level axes that point north, east and down, with the own drone at the origin.

    Every step: `predict`, then `update`, with no measurements too; then `neighbours`. Deterministic.
    """

    def __init__(self, parameters: TrackingParameters) -> None:
        self.parameters = parameters
        self._tracks: list[_Track] = []
        self._time_s = 0.0
        self._created = 0

    def predict(
        self, interval_s: float, own_displacement: FloatArray | None, own_displacement_sigma_m: float = 0.0
    ) -> None:
        """Move all tracks on by `interval_s`.

        `own_displacement` (3,) NED metres is the way the own drone went meanwhile, with its standard deviation an axis.
        None: not known; the tracks then stay where they are relative to the own drone, as flock mates move alike, and
        grow uncertain by 0.7 m/s.
        """
        dt = interval_s
        transition, displacement, sigma_m = np.eye(6), np.zeros(3), _RELATIVE_SPEED_SIGMA_M_S * dt
        if own_displacement is not None:
            transition[:3, 3:] = dt * np.eye(3)
            displacement, sigma_m = own_displacement, own_displacement_sigma_m
        density = self.parameters.acceleration_sigma_m_s2**2 * _MANOEUVRE_TIME_S
        noise = np.kron(density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(3))
        noise[:3, :3] += sigma_m**2 * np.eye(3)
        for track in self._tracks:
            track.state = transition @ track.state - np.concatenate([displacement, np.zeros(3)])
            track.covariance = transition @ track.covariance @ transition.T + noise

    def update(
        self,
        time_s: float,
        measurements: Sequence[Measurement],
        own_velocity: FloatArray | None = None,
        blind: Blind | None = None,
    ) -> tuple[int, ...]:
        """Take in one frame set's measurements at `time_s`; the track number of each, new where it fits no track.

        `own_velocity` (3,) NED m/s is what a new track starts with: flock mates move alike. A track not yet confirmed
        is forgotten when it is missed once, a confirmed one when unseen for longer than `max_unseen_s`. That a track
        is missed where the rig is `blind` says nothing against it, but it ages as any other. None: blind nowhere.
        """
        self._time_s = time_s
        matches = self._associate(measurements)
        numbers = []
        for index, measurement in enumerate(measurements):
            track = matches.get(index)
            if track is None:
                track = self._begin(measurement, own_velocity)
                self._tracks.append(track)
            else:
                self._see(track, measurement)
            numbers.append(track.number)
        for track, hidden in zip(self._tracks, self._hidden(blind), strict=True):
            self._weigh(track, hidden)
        self._tracks = [track for track in self._tracks if self._is_kept(track)]
        return tuple(numbers)

    def expect(self, interval_s: float, own_velocity: FloatArray | None) -> tuple[ExpectedNeighbour, ...]:
        """Where the confirmed tracks should be after `interval_s`, if everybody flies on; changes nothing.

        `own_velocity` (3,) NED m/s; None: all stay where they are relative to the own drone.
        """
        return tuple(
            ExpectedNeighbour(
                position=track.state[:3]
                + interval_s * (0.0 if own_velocity is None else track.state[3:] - own_velocity),
                size_m=track.size_m,
            )
            for track in self._tracks
            if track.was_confirmed
        )

    def neighbours(self) -> tuple[Neighbour, ...]:
        """All tracks as of the last `predict` and `update`, confirmed or not, by track number."""
        return tuple(
            Neighbour(
                track=track.number,
                position=track.state[:3].copy(),
                velocity=track.state[3:].copy(),
                position_sigma_m=float(np.sqrt(np.trace(track.covariance[:3, :3]) / 3)),
                velocity_sigma_m_s=float(np.sqrt(np.trace(track.covariance[3:, 3:]) / 3)),
                age_s=self._time_s - track.first_seen_s,
                unseen_s=self._time_s - track.last_seen_s,
                hits=track.hits,
                confirmed=track.confirmed,
            )
            for track in self._tracks
        )

    def _hidden(self, blind: Blind | None) -> Sequence[bool]:
        if blind is None or not self._tracks:
            return [False] * len(self._tracks)
        return [bool(one) for one in blind(np.array([track.state[:3] for track in self._tracks]))]

    def _weigh(self, track: _Track, hidden: bool) -> None:
        """Is it a drone? Seen often enough, and on average of the last steps with enough evidence."""
        if track.last_seen_s < self._time_s and not hidden:
            track.evidence.append(0.0)
        evidence = sum(track.evidence) / len(track.evidence)
        needed = self.parameters.keep_evidence if track.confirmed else self.parameters.confirm_evidence
        track.confirmed = track.hits >= self.parameters.confirm_hits and evidence > needed
        track.was_confirmed |= track.confirmed

    def _is_kept(self, track: _Track) -> bool:
        unseen_s = self._time_s - track.last_seen_s
        return unseen_s <= (self.parameters.max_unseen_s if track.was_confirmed else 0.0)

    def _associate(self, measurements: Sequence[Measurement]) -> dict[int, _Track]:
        """Measurement index -> track, one to one: the likeliest pair first, then the next of those left.

        A pair fits when within `gate_sigma` standard deviations or within `min_gate_m`.
        """
        if not measurements or not self._tracks:
            return {}
        innovations = (
            np.array([m.position for m in measurements])[:, None] - np.array([t.state[:3] for t in self._tracks])[None]
        )
        spreads = (
            np.array([m.covariance for m in measurements])[:, None]
            + np.array([t.covariance[:3, :3] for t in self._tracks])[None]
        )
        squared = (innovations * np.linalg.solve(spreads, innovations[..., None])[..., 0]).sum(axis=-1)
        unlikelihoods = squared + np.linalg.slogdet(spreads).logabsdet
        fits = (squared <= self.parameters.gate_sigma**2) | (
            np.linalg.norm(innovations, axis=-1) <= self.parameters.min_gate_m
        )
        matches: dict[int, _Track] = {}
        taken: set[int] = set()
        for flat in np.argsort(unlikelihoods, axis=None, kind="stable"):
            index, column = divmod(int(flat), len(self._tracks))
            if fits[index, column] and index not in matches and column not in taken:
                matches[index] = self._tracks[column]
                taken.add(column)
        return matches

    def _begin(self, measurement: Measurement, own_velocity: FloatArray | None) -> _Track:
        self._created += 1
        velocity, sigma_m_s = np.zeros(3), _SPEED_SIGMA_M_S
        if own_velocity is not None:
            velocity, sigma_m_s = own_velocity, _RELATIVE_SPEED_SIGMA_M_S
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = measurement.covariance
        covariance[3:, 3:] = sigma_m_s**2 * np.eye(3)
        track = _Track(
            number=self._created,
            state=np.concatenate([measurement.position, velocity]),
            covariance=covariance,
            first_seen_s=self._time_s,
            last_seen_s=self._time_s,
            sizes=deque([measurement.size_m], maxlen=self.parameters.size_memory),
            size_m=measurement.size_m,
            evidence=deque([_evidence(measurement)], maxlen=_EVIDENCE_STEPS),
        )
        _absorb_velocity(track, measurement)
        return track

    def _see(self, track: _Track, measurement: Measurement) -> None:
        track.last_seen_s = self._time_s
        track.hits += 1
        track.evidence.append(_evidence(measurement))
        track.sizes.append(measurement.size_m)
        track.size_m = float(np.median(track.sizes)) if track.sizes else measurement.size_m
        position, covariance = measurement.position, measurement.covariance
        if track.sizes:  # size_memory > 0
            position, covariance = range_from_size(measurement, track.sizes)
        _absorb(track, _POSITION, position, covariance)
        _absorb_velocity(track, measurement)


def range_from_size(measurement: Measurement, sizes: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """A position (3,) and covariance (3, 3) whose range also draws on a drone's size being constant.

    `sizes`: what the last detections, this one included, took the size for. The mean size over this detection's angular
    size is a second range, blended with the first by their variances.
    """
    distance = float(np.linalg.norm(measurement.position))
    direction = measurement.position / distance
    variance = float(direction @ measurement.covariance @ direction)
    from_size = distance * float(np.mean(sizes)) / measurement.size_m
    from_size_variance = distance**2 * _ANGULAR_SIZE_SIGMA**2 + variance / len(sizes)
    blended = (distance * from_size_variance + from_size * variance) / (variance + from_size_variance)
    blended_variance = variance * from_size_variance / (variance + from_size_variance)
    covariance = measurement.covariance + (blended_variance - variance) * np.outer(direction, direction)
    return blended * direction, covariance


def _evidence(measurement: Measurement) -> float:
    return max(0.0, 2.0 * measurement.drone_probability - 1.0)


def _absorb_velocity(track: _Track, measurement: Measurement) -> None:
    if measurement.velocity is not None:
        _absorb(track, _VELOCITY, measurement.velocity, measurement.velocity_sigma_m_s**2 * np.eye(3))


def _absorb(track: _Track, observation: FloatArray, measured: FloatArray, covariance: FloatArray) -> None:
    """Kalman update with measured = observation @ state + noise of `covariance`, in Joseph's form.

    An innovation of d > 2.5 standard deviations has its own spread blown up to (d / 2.5)^2 of what it was: the
    farther off, the less it moves.
    """
    innovation = measured - observation @ track.state
    spread = observation @ track.covariance @ observation.T + covariance
    excess = float(innovation @ np.linalg.solve(spread, innovation)) / _ROBUST_SIGMA**2
    if excess > 1:
        covariance = covariance + (excess - 1) * spread
        spread = excess * spread
    gain = np.linalg.solve(spread, observation @ track.covariance).T
    rest = np.eye(6) - gain @ observation
    track.state = track.state + gain @ innovation
    track.covariance = rest @ track.covariance @ rest.T + gain @ covariance @ gain.T
