"""The second stage as a cascade: each crop's estimate aims the next one, until the next would show the same again."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from flockd.core.config.perception import DetectionParameters
from flockd.core.messages import FloatArray, Reason, ReasonKind, UInt8Array
from flockd.flight.geometry import Rig, VirtualCrop, log_polar, log_polar_covariance
from flockd.flight.perception.detection.proposals import Proposal
from flockd.flight.perception.detection.roi import Roi, pixel_angle, take_crop
from flockd.flight.perception.detection.second_stage import SecondStage
from flockd.flight.perception.maps import Crop, KnownSize, RangeEstimate


@dataclass(frozen=True, eq=False)
class Candidate:
    """A drone as one proposal's crops show it, in log-polar coordinates of the body."""

    proposal: Proposal
    bearing: FloatArray
    """(3,) unit vector."""
    log_range: float
    """Natural logarithm of the range in metres."""
    log_range_sigma: float
    """Standard deviation of `log_range`, if the size is right."""
    bearing_sigma_rad: float
    size_m: float
    drone_probability: float = 1.0
    log_size_sigma: float = 0.0
    """As of `RangeEstimate`."""

    @property
    def range_m(self) -> float:
        """From the body's origin."""
        return math.exp(self.log_range)

    @property
    def position(self) -> FloatArray:
        """(3,) metres in the body."""
        return self.range_m * self.bearing

    @property
    def covariance(self) -> FloatArray:
        """(3, 3) as of `Detection.covariance`."""
        return log_polar_covariance(self.bearing, self.log_range_sigma, self.bearing_sigma_rad)


class Refined(NamedTuple):
    """What became of proposals."""

    candidates: list[Candidate]
    rejected: list[Proposal]
    """Those that surely are no drones."""
    reasons: list[Reason]
    """Why others were dropped."""


class RangeNetwork(Protocol):
    """The part of `flockd.flight.perception.interface.Networks` that refinement needs."""

    def ranges(self, crops: Sequence[Crop]) -> tuple[RangeEstimate, ...]:
        """Range and centre of the drone in the middle of each crop."""
        ...


@dataclass(frozen=True, eq=False)
class _Stage:
    """The next crop of a proposal."""

    proposal: Proposal
    roi: Roi
    drone_probability: float = 1.0
    """The least that an earlier crop gave, but for the first, which may be far from what suits the drone."""


@dataclass(frozen=True, eq=False)
class _LastStage(_Stage):
    """The mirror image of the last crop."""

    candidate: Candidate = field(kw_only=True)
    """As the crop itself shows it."""


_S = TypeVar("_S", bound=_Stage)


class Cascade:
    """Refines proposals with the network of the second stage."""

    def __init__(
        self,
        network: RangeNetwork,
        second_stage: SecondStage,
        parameters: DetectionParameters,
        known_size: KnownSize | None = None,
    ) -> None:
        """``known_size``: of every drone; None: the network judges each one's."""
        self._network, self._crop_size, self._known_size = network, second_stage.crop_size, known_size
        self._rules, self._thresholds, self._parameters = second_stage.rules, second_stage.thresholds, parameters

    def refine(self, rig: Rig, images: Mapping[str, UInt8Array], proposals: Sequence[Proposal]) -> Refined:
        """The drones among the proposals, the proposals that surely are none, and why others were dropped.

        At least two crops each, the further ones cut to the drone's size with it in the middle, then one of its mirror
        image. Where two cameras share the drone, the crops show it whole.

        Args:
            rig: the cameras that have an image.
            images: (h, w, 3) by camera.
            proposals: of all cameras.
        """
        settled: list[tuple[_Stage, Candidate]] = []
        rejected: list[Proposal] = []
        reasons: list[Reason] = []
        stages = [_Stage(proposal, proposal.roi) for proposal in proposals]
        for number in range(1, self._rules.max_crops + 1):
            if not stages:
                break
            further = []
            judged, dropped = self._candidates(rig, images, stages)
            reasons += dropped
            for stage, candidate in judged:
                probability = min(stage.drone_probability, candidate.drone_probability)
                if probability <= self._thresholds.another_crop:
                    rejected.append(stage.proposal)
                    continue
                if not self._is_in_range(candidate):
                    continue
                roi = self._next_roi(rig, stage, candidate)
                following = _Stage(stage.proposal, roi, probability if number > 1 else 1.0)
                if number == 1 or (number < self._rules.max_crops and not self._would_repeat(stage.roi, roi)):
                    further.append(following)
                elif probability > self._thresholds.drone:  # a mirror image would not raise it
                    settled.append((following, candidate))
            stages = further
        candidates = []
        together, dropped = self._with_mirrored(rig, images, settled)
        reasons += dropped
        for candidate in together:
            if candidate.drone_probability <= self._thresholds.another_crop:
                rejected.append(candidate.proposal)
            elif candidate.drone_probability > self._needed(candidate.proposal):
                candidates.append(candidate)
        return Refined(candidates, rejected, reasons)

    def _candidates(
        self, rig: Rig, images: Mapping[str, UInt8Array], stages: Sequence[_S]
    ) -> tuple[list[tuple[_S, Candidate]], list[Reason]]:
        """What the network says of each crop, in the body, and why some crops were dropped."""
        cut: list[tuple[_S, Crop, VirtualCrop]] = []
        reasons = []
        for stage in stages:
            try:
                crop = take_crop(rig, images, stage.roi, self._crop_size, stage.proposal.evidence)
                cut.append((stage, *crop))
            except ValueError as error:
                reasons.append(_dropped(error))
        ranged, unranged = self._ranges(cut)
        candidates = []
        for stage, view, estimate in ranged:
            try:
                candidates.append((stage, self._candidate(stage, view, estimate)))
            except ValueError as error:
                reasons.append(_dropped(error))
        return candidates, [*reasons, *unranged]

    def _ranges(
        self, cut: Sequence[tuple[_S, Crop, VirtualCrop]]
    ) -> tuple[list[tuple[_S, VirtualCrop, RangeEstimate]], list[Reason]]:
        """One estimate a crop. Where the network fails on several, each half is tried by itself: one crop is lost."""
        if not cut:
            return [], []
        try:
            estimates = self._network.ranges([crop for _, crop, _ in cut])
        except (FloatingPointError, ValueError) as error:
            if len(cut) == 1:
                return [], [_dropped(error)]
            half = len(cut) // 2
            (first, of_first), (second, of_second) = self._ranges(cut[:half]), self._ranges(cut[half:])
            return [*first, *second], [*of_first, *of_second]
        return [(stage, view, one) for (stage, _, view), one in zip(cut, estimates, strict=True)], []

    def _candidate(self, stage: _Stage, view: VirtualCrop, estimate: RangeEstimate) -> Candidate:
        """The camera sits beside the body's origin, so that bearing and range change a little."""
        if self._known_size is not None:
            estimate = estimate.of_size(self._known_size)
        ray = view.camera.rays(estimate.centre[None])[0]
        bearing, log_range = ray, estimate.log_range
        if math.isfinite(log_range) and log_range < math.log(2 * self._parameters.max_range_m):
            place = view.T_body_virtual.apply(math.exp(log_range) * ray[None])[0]
            bearing, log_range = log_polar(place)
        return Candidate(
            stage.proposal, bearing, log_range, estimate.log_range_sigma, self._thresholds.bearing_sigma_rad,
            estimate.size_m, estimate.drone_probability, estimate.log_size_sigma,
        )  # fmt: skip

    def _with_mirrored(
        self, rig: Rig, images: Mapping[str, UInt8Array], settled: Sequence[tuple[_Stage, Candidate]]
    ) -> tuple[list[Candidate], list[Reason]]:
        """Each candidate together with what the mirror image of its crop says; without those that it contradicts."""
        stages = []
        for stage, candidate in settled:
            half_angle = self._rules.mirror_scale * stage.roi.half_angle
            mirrored = replace(stage.roi, half_angle=half_angle, mirrored=True)
            stages.append(_LastStage(stage.proposal, mirrored, stage.drone_probability, candidate=candidate))
        judged, reasons = self._candidates(rig, images, stages)
        together = []
        for stage, other in judged:
            candidate = stage.candidate
            if self._is_in_range(other) and min(candidate.log_range_sigma, other.log_range_sigma) > 0:
                both = mean_candidate(candidate, other)
                sigma = self._thresholds.mean_sigma * both.log_range_sigma
                together.append(
                    replace(
                        both,
                        log_range_sigma=max(sigma, self._thresholds.min_log_range_sigma),
                        drone_probability=min(stage.drone_probability, both.drone_probability),
                    )
                )
        return together, reasons

    def _next_roi(self, rig: Rig, stage: _Stage, candidate: Candidate) -> Roi:
        """With the drone in its middle, or where the proposal was if no camera sees that direction."""
        seen = bool(rig.covers(candidate.bearing[None])[0])
        direction = candidate.bearing if seen else stage.proposal.roi.direction
        finest = pixel_angle(rig, stage.proposal.cameras, direction)
        half_angle = self._rules.half_angle(candidate.size_m, candidate.range_m, finest, stage.roi.half_angle)
        return Roi(direction, half_angle, candidate.range_m)

    def _would_repeat(self, roi: Roi, further: Roi) -> bool:
        return roi.resembles(further, self._parameters.crop_shift, self._parameters.crop_resize)

    def _is_in_range(self, candidate: Candidate) -> bool:
        """False for NaN too."""
        low, high = math.log(self._parameters.min_range_m), math.log(self._parameters.max_range_m)
        return low < candidate.log_range < high

    def _needed(self, proposal: Proposal) -> float:
        return self._thresholds.predicted_drone if proposal.predicted else self._thresholds.drone


def mean_candidate(one: Candidate, other: Candidate) -> Candidate:
    """The mean of log range, bearing, log size and sigmas, weighted by the variances; the lesser probability."""
    weight = one.log_range_sigma**-2 / (one.log_range_sigma**-2 + other.log_range_sigma**-2)

    def mean(a: float, b: float) -> float:
        return weight * a + (1.0 - weight) * b

    bearing = weight * one.bearing + (1.0 - weight) * other.bearing
    return replace(
        one,
        bearing=bearing / np.linalg.norm(bearing),
        log_range=mean(one.log_range, other.log_range),
        log_range_sigma=math.exp(mean(math.log(one.log_range_sigma), math.log(other.log_range_sigma))),
        size_m=math.exp(mean(math.log(one.size_m), math.log(other.size_m))),
        drone_probability=min(one.drone_probability, other.drone_probability),
        log_size_sigma=mean(one.log_size_sigma, other.log_size_sigma),
    )


def _dropped(error: Exception) -> Reason:
    return Reason(ReasonKind.PROPOSAL, f"proposal: {error}")
