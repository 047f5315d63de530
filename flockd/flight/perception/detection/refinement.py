"""The second stage as a cascade: each crop's estimate aims the next one, until the next would show nearly the same."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import BoolArray, FloatArray, IntArray, LearnedSize, Reason, ReasonKind, UInt8Array
from flockd.flight.geometry import Rig, log_polar_covariance, virtual_crops
from flockd.flight.perception.detection.proposals import Proposal, angles_between, pixel_angles
from flockd.flight.perception.interface import Crops, Networks, RangeEstimates

_SAME_RANGE = math.log(1.5)
"""Largest difference of log range between a drone that is seen and the one predicted there."""
LIKELY = 0.5
"""A proposal that is likelier a drone than not is a candidate: the tracker weighs the probability."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A drone from the crops of one proposal, in log-polar coordinates of the body."""

    proposal: Proposal
    bearing: FloatArray
    """(3,) unit vector."""
    log_range: float
    """Natural logarithm of the range in metres."""
    log_range_sigma: float
    """Standard deviation of `log_range`, given the size."""
    bearing_sigma_rad: float
    size_m: float
    drone_probability: float = 1.0
    log_size_sigma: float = 0.0
    """As of `RangeEstimates`."""

    @property
    def range_m(self) -> float:
        """Range from the body's origin."""
        return math.exp(self.log_range)

    @cached_property
    def covariance(self) -> FloatArray:
        """(3, 3) as of `Detection.covariance`."""
        return log_polar_covariance(self.bearing, self.log_range_sigma, self.bearing_sigma_rad)


class Refined(NamedTuple):
    """The proposals after the second stage."""

    candidates: list[Candidate]
    rejected: list[Proposal]
    """Proposals that are certainly not drones."""


class Estimates(NamedTuple):
    """Estimates from n crops in log-polar coordinates; the fields are those of `Candidate`."""

    bearing: FloatArray
    """(n, 3)"""
    log_range: FloatArray
    log_range_sigma: FloatArray
    size_m: FloatArray
    drone_probability: FloatArray
    log_size_sigma: FloatArray

    def take(self, which: IntArray | BoolArray) -> Estimates:
        """Those at these indices, or of this mask."""
        return Estimates(*(column[which] for column in self))

    def of_size(self, known: LearnedSize) -> Estimates:
        """The ranges at which drones of the known size have these apparent sizes.

        The error of the apparent size stays; the known size's sigma replaces that of the estimated one.
        """
        possible = (self.size_m > 0) & np.isfinite(self.size_m)
        log_judged = np.log(self.size_m, where=possible, out=np.full_like(self.size_m, np.nan))
        return self._replace(
            log_range=math.log(known.size_m) - (log_judged - self.log_range),
            size_m=np.full_like(self.size_m, known.size_m),
            log_size_sigma=np.full_like(self.size_m, known.sigma),
        )

    def mean(self, other: Estimates) -> Estimates:
        """The mean of log range, bearing, log size and sigmas, weighted by the variances; the lesser probability."""
        weight = self.log_range_sigma**-2 / (self.log_range_sigma**-2 + other.log_range_sigma**-2)

        def mean(a: FloatArray, b: FloatArray) -> FloatArray:
            return np.asarray((weight * a.T + (1.0 - weight) * b.T).T)

        bearing = mean(self.bearing, other.bearing)
        return Estimates(
            bearing / np.linalg.norm(bearing, axis=1, keepdims=True),
            mean(self.log_range, other.log_range),
            np.exp(mean(np.log(self.log_range_sigma), np.log(other.log_range_sigma))),
            np.exp(mean(np.log(self.size_m), np.log(other.size_m))),
            np.minimum(self.drone_probability, other.drone_probability),
            mean(self.log_size_sigma, other.log_size_sigma),
        )


class _Aims(NamedTuple):
    """Directions and ranges of the next crops of n proposals."""

    direction: FloatArray
    """(n, 3)"""
    half_angle: FloatArray
    range_m: FloatArray
    """(n,) range of the target, for the parallax between cameras; NaN: not known yet."""


class Cascade:
    """Refines proposals with the network of the second stage, in the images of one moment."""

    def __init__(
        self,
        network: Networks,
        parameters: DetectionParameters,
        known_size: LearnedSize | None,
        rig: Rig,
        images: Mapping[str, UInt8Array],
    ) -> None:
        """``known_size``: of every drone; None: the network estimates each one's. ``rig``: the cameras that have an
        image, ``images`` (h, w, 3) by camera."""
        self._network, self._known_size = network, known_size
        self._stage, self._rules, self._parameters = network.second_stage, network.second_stage.rules, parameters
        self._rig, self._images = rig, images
        self.reasons: list[Reason] = []
        """Why proposals were dropped."""

    def refine(self, instances: Sequence[Proposal], predicted: Sequence[Proposal]) -> Refined:
        """The drones among the proposals of all cameras, and the proposals that are certainly not drones.

        Each proposal gets at least two crops. The later ones are cut to the drone's size and centred on it; the last
        one is mirrored. If two cameras share the drone, the crops show it whole. A predicted drone that the first crops
        of the instances show gets none of its own.
        """
        proposals = [*instances, *predicted]
        count, of = len(proposals), np.array(proposals, np.object_)
        aims = _Aims(
            np.array([one.direction for one in proposals]).reshape(-1, 3),
            np.array([one.half_angle for one in proposals]),
            np.array([one.range_m for one in proposals]),
        )
        shown = Estimates(np.empty((count, 3)), *np.empty((5, count)))
        # Least probability of the earlier crops, without the first, which may not fit the drone.
        least, rejected, settled = np.ones(count), np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        at = np.arange(len(instances))
        for number in range(1, self._rules.max_crops + 1):
            at, estimates = self._estimated(of, at, aims)
            probability = np.minimum(least[at], estimates.drone_probability)
            rejected[at] = probability <= self._stage.another_crop_probability
            good = ~rejected[at] & self._is_in_range(estimates)
            at, estimates, probability = at[good], estimates.take(good), probability[good]
            repeats = self._aim(of[at], at, aims, estimates)
            if number == 1:
                at = np.append(at, len(instances) + unseen(predicted, estimates).nonzero()[0])
                continue
            least[at] = probability
            enough = repeats | (number == self._rules.max_crops)
            settled[at] = enough & (probability > LIKELY)  # a mirrored crop would not raise it
            for column, values in zip(shown, estimates, strict=True):
                column[at] = values
            at = at[~enough]
            if not len(at):
                break
        at, estimates = self._with_mirrored(of, settled.nonzero()[0], aims, shown)
        probability = np.minimum(least[at], estimates.drone_probability)
        rejected[at] = probability <= self._stage.another_crop_probability
        likely = (~rejected[at] & (probability > LIKELY)).nonzero()[0]
        estimates, across = (
            estimates._replace(drone_probability=probability).take(likely),
            self._stage.bearing_sigma_rad,
        )
        rows = zip(of[at[likely]], estimates.bearing, *(column.tolist() for column in estimates[1:]), strict=True)
        found = [Candidate(one, bearing, log_r, sigma, across, *rest) for one, bearing, log_r, sigma, *rest in rows]
        return Refined(found, of[rejected].tolist())

    def _estimated(
        self, proposals: NDArray[Any], at: IntArray, aims: _Aims, *, mirrored: bool = False
    ) -> tuple[IntArray, Estimates]:
        """The network's estimates from crops of the proposals at these indices, and the indices that have one."""
        if not len(at):
            return at, Estimates(np.empty((0, 3)), *np.empty((5, 0)))
        directions, range_m = aims.direction[at], aims.range_m[at]
        views = virtual_crops(self._rig, directions, aims.half_angle[at], self._stage.crop_size)
        seen = (views.main >= 0).nonzero()[0]
        for one in directions[views.main < 0]:
            self._drop(f"no camera sees the body direction {one.round(3).tolist()}")
        at, views = at[seen], views.take(seen)
        pictures, _ = views.sample(self._images, range_m[seen])
        evidence = np.array([one.evidence for one in proposals[at]])
        mirror = np.full(len(at), mirrored)
        crops = Crops(pictures, views.focal_px, views.R_body_virtual, views.centres, mirror, evidence)
        log_range, sigma, centre, *rest = self._ranges(crops)
        estimates = Estimates(views.rays(centre), log_range, sigma, *rest)
        if self._known_size is not None:
            estimates = estimates.of_size(self._known_size)
        # The camera is not at the body's origin, so bearing and range change a little.
        near = np.isfinite(estimates.log_range) & (estimates.log_range < math.log(2 * self._parameters.max_range_m))
        ranges = np.exp(np.where(near, estimates.log_range, 0.0))[:, None]
        places = np.where(near[:, None], views.centres, 0.0) + ranges * estimates.bearing
        range_m = np.maximum(np.linalg.norm(places, axis=1), np.finfo(np.float64).tiny)
        log_range = np.where(near, np.log(range_m), estimates.log_range)
        return at, estimates._replace(bearing=places / range_m[:, None], log_range=log_range)

    def _ranges(self, crops: Crops) -> RangeEstimates:
        """An estimate for each crop. If the network fails on several, each half is tried alone: one crop is lost."""
        try:
            return self._network.ranges(crops)
        except (FloatingPointError, ValueError) as error:
            if len(crops) == 1:
                self._drop(str(error))
                return RangeEstimates.unknown(1)
            half = len(crops) // 2
            halves = self._ranges(crops[:half]), self._ranges(crops[half:])
            return RangeEstimates(*(np.concatenate(columns) for columns in zip(*halves, strict=True)))

    def _with_mirrored(
        self, proposals: NDArray[Any], at: IntArray, aims: _Aims, shown: Estimates
    ) -> tuple[IntArray, Estimates]:
        """The mean of each estimate and that of its mirrored crop; estimates that it contradicts are dropped."""
        mirrored = aims._replace(half_angle=self._rules.mirror_scale * aims.half_angle)
        at, others = self._estimated(proposals, at, mirrored, mirrored=True)
        estimates = shown.take(at)
        agree = self._is_in_range(others) & (np.minimum(estimates.log_range_sigma, others.log_range_sigma) > 0)
        both = estimates.take(agree).mean(others.take(agree))
        sigma = np.maximum(self._stage.mean_sigma_factor * both.log_range_sigma, self._stage.min_relative_sigma)
        return at[agree], both._replace(log_range_sigma=sigma)

    def _aim(self, proposals: NDArray[Any], at: IntArray, aims: _Aims, estimates: Estimates) -> BoolArray:
        """Aims the next crops (n,), and tells which of them would show nearly the same as the last.

        They are centred on the drones, or on the proposals if no camera sees that direction.
        """
        first = np.array([one.direction for one in proposals]).reshape(-1, 3)
        direction = np.where(self._rig.covers(estimates.bearing)[:, None], estimates.bearing, first)
        finest = pixel_angles(self._rig, [one.cameras for one in proposals], direction)
        before, range_m, most = aims.half_angle[at], np.exp(estimates.log_range), self._rules.max_resize
        fitting = np.maximum(self._rules.fitting(estimates.size_m, range_m), before / most)
        half_angle = self._rules.bounded(np.minimum(fitting, before * most), finest)
        moved = angles_between(aims.direction[at], direction) / before
        resized = np.abs(np.log(half_angle / before))
        for column, values in zip(aims, (direction, half_angle, range_m), strict=True):
            column[at] = values
        return (moved < self._parameters.crop_shift) & (resized < math.log(self._parameters.crop_resize))

    def _is_in_range(self, estimates: Estimates) -> BoolArray:
        """(n,) whether each range is possible; false for NaN."""
        low, high = math.log(self._parameters.min_range_m), math.log(self._parameters.max_range_m)
        return (low < estimates.log_range) & (estimates.log_range < high)

    def _drop(self, why: str) -> None:
        self.reasons.append(Reason(ReasonKind.PROPOSAL, f"proposal: {why}"))


def unseen(predicted: Sequence[Proposal], shown: Estimates) -> BoolArray:
    """(k,) which predicted drones none of the estimates is of. One at another range, behind or in front, is not."""
    direction = np.array([one.direction for one in predicted]).reshape(-1, 1, 3)
    half_angle, range_m = np.array([(one.half_angle, one.range_m) for one in predicted]).reshape(-1, 2).T
    same = angles_between(direction, shown.bearing) < half_angle[:, None]
    same &= np.abs(np.log(range_m)[:, None] - shown.log_range) < _SAME_RANGE
    return np.asarray(~same.any(axis=1))
