"""Neighbours over time."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, model_validator

from flockd.core.config.base import Duration, NonNegative, Positive, Section

JITTER_S = 0.05
"""By how much the time between two frame sets may be shorter than a step: more than a frame of a camera of 30 Hz."""

Probability = Annotated[float, Field(gt=0, lt=1)]


class TrackingParameters(Section):
    """Neighbours over time: motion model, association and existence probability."""

    acceleration_sigma_m_s2: Positive = 0.45
    """Manoeuvres of a flock mate, standard deviation of each axis; of a drone on its own course, twice this."""
    manoeuvre_time_s: Duration = 0.5
    """How long an acceleration lasts. The white acceleration noise of the motion model has the spectral density
    acceleration_sigma_m_s2^2 * manoeuvre_time_s (Bar-Shalom, Li & Kirubarajan 2001, section 6.2)."""
    relative_speed_sigma_m_s: Positive = 0.7
    """Standard deviation, each axis, of the relative velocity of a drone of the same flock before it is measured, and
    again some time later: its velocity returns to the own one as fast as its accelerations allow."""
    speed_sigma_m_s: Positive = 2.0
    """Standard deviation of the closing speed of a drone outside the flock; and, each axis, of the velocity of any
    drone while the own velocity is not known."""
    stranger_probability: Probability = 0.2
    """Probability that a newly seen drone, or one that changes its motion, flies on a course of its own; half of it,
    that it brakes to standstill. All motions are followed, and detections weigh them (IMM: Blom & Bar-Shalom 1988)."""
    robust_sigma: Positive = 2.5
    """Innovations beyond this many standard deviations have less and less weight. Of those of the motion and
    measurement model 82 % are nearer, of measured velocities 90 % (chi-square with 4 and 3 degrees of freedom)."""

    range_error_time_s: Duration = 1.5
    """How long errors of one neighbour's log ranges last. With the shipped networks' detections in the simulator the
    correlation of errors that are 0.5, 1, 2 and 4 s apart is 0.53, 0.38, 0.21 and 0.09 ..."""
    range_error_lasts: Probability = 0.75
    """... so that this share of their variance lasts; the rest is new in each frame set."""
    size_drift: Positive = 0.05
    """How far the log size of one drone drifts, as the network sees it in changing views: standard deviation after one
    second, growing with the square root of the time."""

    gate_sigma: Positive = 6.0
    """Association gate: the largest Mahalanobis distance of a detection from a track, in place and size, in standard
    deviations. Wider than a Gaussian needs, as range errors have heavier tails: a detection left out begins a second
    track."""

    detection_probability: Probability = 0.7
    """P_D: probability that a neighbour in view is detected in one frame set. Lower than the share that the shipped
    networks detect of drones at least 12 px wide, because misses come in runs: at 0.7 a track stays confirmed through
    three frame sets in a row without a detection."""
    clutter_density: Positive = 0.01
    """False detections in one frame set, per steradian, unit of log range and unit of log size. More than the shipped
    networks give on average (9 in 500 images of 1.5 sr, at 0.5 to 20 m and 0.15 to 1.2 m large, are 0.0016), because
    false detections crowd where trees are."""
    survival_time_s: Duration = 60.0
    """Mean time that a neighbour stays within sight: existence probability decays with this time constant."""
    birth_probability: Probability = 0.5
    """Existence probability of a new track from a detection that is certainly of a drone."""
    evidence_interval_s: Duration = 0.5
    """Frame sets nearer to each other in time are not independent evidence of existence: they count in proportion."""
    drone_probability_memory_s: Duration = 5.0
    """Time constant of the average of the network's drone probabilities over a track; its existence probability is
    multiplied by it."""
    heading_sigma_rad: NonNegative = 0.035
    """Error of the autopilot's heading, as PX4's magnetometer has it. It turns all neighbours alike about the drone,
    and lasts: it is added where positions are reported, and not in the filter."""
    confirm_hits: Annotated[int, Field(ge=1)] = 2
    """A track needs this many detections that agree with it to be confirmed; after the first each counts by
    `evidence_interval_s`."""
    vague_factor: Annotated[float, Field(ge=1)] = 2.0
    """A detection whose range is less certain than those of confirmed neighbours usually are, by more than this factor,
    counts less, in proportion: false detections seldom have certain ranges."""
    confirm_sigma: Positive = 3.6
    """A detection farther than this many standard deviations from the track does not agree: 99 % of those of the motion
    and measurement model are nearer (chi-square with 4 degrees of freedom)."""
    confirm_probability: Probability = 0.925
    """A track is confirmed when its existence probability is above this."""
    keep_probability: Probability = 0.6
    """It stays confirmed while its existence probability is above this."""
    drop_probability: Probability = 0.1
    """A track is dropped when its existence probability falls below this."""
    max_unseen_s: Duration = 1.5
    """A track that should have been in view for longer without a detection, and for longer than a tenth of the time
    that it was followed, is dropped whatever its existence probability. A confirmed neighbour that leaves the cameras'
    view, as above or below, is remembered until then."""

    def confirm_steps(self, step_s: float) -> int:
        """With which step, at the earliest, a neighbour is confirmed that all steps of `step_s` show."""
        return 1 + math.ceil((self.confirm_hits - 1) * max((self.evidence_interval_s - JITTER_S) / step_s, 1.0))

    @model_validator(mode="after")
    def _ordered(self) -> TrackingParameters:
        if not self.drop_probability <= self.keep_probability <= self.confirm_probability:
            raise ValueError(
                "drop_probability, keep_probability and confirm_probability must not decrease in this order, "
                f"as {self.drop_probability:g}, {self.keep_probability:g}, {self.confirm_probability:g} do; sort them"
            )
        return self
