"""Neighbours over time."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, model_validator

from flockd.core.config.base import Duration, NonNegative, Positive, Section

JITTER_S = 0.05
"""Tolerance of the time between two frame sets: more than a frame period at 30 Hz."""

Probability = Annotated[float, Field(gt=0, lt=1)]


class TrackingParameters(Section):
    """Neighbours over time: motion model, association and existence probability."""

    acceleration_sigma_m_s2: Positive = 0.45
    """Standard deviation of a flock mate's acceleration, each axis; that of a drone on its own course is twice this."""
    manoeuvre_time_s: Duration = 0.5
    """Duration of an acceleration. The white acceleration noise of the motion model has the spectral density
    acceleration_sigma_m_s2^2 * manoeuvre_time_s (Bar-Shalom, Li & Kirubarajan 2001, section 6.2)."""
    relative_speed_sigma_m_s: Positive = 0.7
    """Standard deviation, each axis, of a flock mate's relative velocity before the first measurement, and long after
    the last one: the estimate then tends to the own velocity."""
    speed_sigma_m_s: Positive = 2.0
    """Standard deviation of the closing speed of a drone outside the flock. While the own velocity is not known, that
    of any drone's velocity, each axis."""
    stranger_probability: Probability = 0.2
    """Probability that a new drone, or one that changes its motion, flies a course of its own; half of this that it
    brakes to standstill. The tracker follows all motions, and detections weigh them (IMM: Blom & Bar-Shalom 1988)."""
    robust_sigma: Positive = 2.5
    """Number of standard deviations beyond which innovations have less weight. By the model, 82 % of innovations are
    below it, and 90 % of measured velocities (chi-square with 4 and 3 degrees of freedom)."""

    range_error_time_s: Duration = 1.5
    """Time constant of the persistent part of log range errors. The errors of the shipped networks in the simulator
    have correlations of 0.53, 0.38, 0.21 and 0.09 over 0.5, 1, 2 and 4 s."""
    range_error_lasts: Probability = 0.75
    """Share of their variance that persists; the rest is new in each frame set."""
    size_drift: Positive = 0.05
    """Drift of a drone's log size, as the network estimates it from changing views: standard deviation after one
    second, which grows with the square root of the time."""

    gate_sigma: Positive = 6.0
    """Association gate: the largest Mahalanobis distance of a detection from a track, in position and size. It is wider
    than Gaussian errors need, because range errors have heavier tails and a detection outside the gate begins a second
    track."""

    detection_probability: Probability = 0.7
    """P_D: probability that a neighbour in view is detected in one frame set. The shipped networks detect a larger
    share of drones that are at least 12 px wide, but misses come in runs: at 0.7 a track stays confirmed through three
    frame sets without a detection."""
    clutter_density: Positive = 0.01
    """Density of false detections in one frame set, per steradian, unit of log range and unit of log size. It is above
    the shipped networks' average of 0.0016 (9 in 500 images of 1.5 sr, at 0.5 to 20 m and sizes of 0.15 to 1.2 m),
    because false detections are frequent where trees are."""
    survival_time_s: Duration = 60.0
    """Mean time that a neighbour stays within sight: existence probability decays with this time constant."""
    birth_probability: Probability = 0.5
    """Existence probability of a new track from a detection that is certainly of a drone."""
    evidence_interval_s: Duration = 0.5
    """Time between frame sets from which they count as independent evidence of existence; at shorter times they count
    in proportion."""
    drone_probability_memory_s: Duration = 5.0
    """Time constant of the average of the network's drone probabilities over a track. The existence probability is
    multiplied by this average."""
    heading_sigma_rad: NonNegative = 0.035
    """Standard deviation of the autopilot's heading, from PX4's magnetometer. This error is the same for all neighbours
    and persists, so it is added to reported positions instead of in the filter."""
    confirm_hits: Annotated[int, Field(ge=1)] = 2
    """Number of detections that must agree with a track to confirm it; each after the first counts by
    `evidence_interval_s`."""
    vague_factor: Annotated[float, Field(ge=1)] = 2.0
    """A detection whose range sigma exceeds the usual one of confirmed neighbours by more than this factor counts less,
    in proportion: most false detections have a large range sigma."""
    confirm_sigma: Positive = 3.6
    """Largest distance, in standard deviations, of a detection that agrees with a track; by the model 99 % are nearer
    (chi-square with 4 degrees of freedom)."""
    confirm_probability: Probability = 0.925
    """Existence probability above which a track is confirmed."""
    keep_probability: Probability = 0.6
    """Existence probability above which it stays confirmed."""
    drop_probability: Probability = 0.1
    """Existence probability below which a track is deleted."""
    max_unseen_s: Duration = 1.5
    """A track is deleted when cameras looked at its place for this time, and for a tenth of its age, without detecting
    it, even at a high existence probability. A confirmed neighbour that leaves the cameras' view is kept until then."""

    def confirm_steps(self, step_s: float) -> int:
        """The first step, of length `step_s`, in which a neighbour that is detected in every step can be confirmed."""
        return 1 + math.ceil((self.confirm_hits - 1) * max((self.evidence_interval_s - JITTER_S) / step_s, 1.0))

    @model_validator(mode="after")
    def _ordered(self) -> TrackingParameters:
        if not self.drop_probability <= self.keep_probability <= self.confirm_probability:
            raise ValueError(
                "drop_probability, keep_probability and confirm_probability must not decrease in this order, "
                f"as {self.drop_probability:g}, {self.keep_probability:g}, {self.confirm_probability:g} do; sort them"
            )
        return self
