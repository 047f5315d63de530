"""Neighbours over time."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from flockd.config.base import Positive, Section


class TrackingParameters(Section):
    """Neighbours over time."""

    confirm_hits: Annotated[int, Field(ge=1)] = 3
    confirm_evidence: Annotated[float, Field(ge=0, lt=1)] = 0.85
    """A track is confirmed when the average of its last ten steps is above this: a detection that is a drone with
    probability p counts 2 p - 1, a step without one 0."""
    keep_evidence: Annotated[float, Field(ge=0, lt=1)] = 0.6
    """It stays confirmed while that average is above this."""
    max_unseen_s: Positive = 1.5
    gate_sigma: Positive = 4.0
    """Association gate in standard deviations."""
    min_gate_m: Positive = 0.5
    acceleration_sigma_m_s2: Positive = 0.2
    """How hard a neighbour may manoeuvre between two frame sets."""
    size_memory: Annotated[int, Field(ge=0)] = 0
    """Number of detections over which a neighbour's physical size is averaged; 0: off."""
