"""Tracking of neighbours: association of detections, position, velocity and probability of existence."""

from __future__ import annotations

from flockd.core.config.tracking import TrackingParameters
from flockd.flight.tracking.measurement import Measurement
from flockd.flight.tracking.tracker import Prediction, Shown, Tracker

__all__ = ["Measurement", "Prediction", "Shown", "Tracker", "TrackingParameters"]
