"""Neighbours over time: which detection is of which drone, where it is now, how it moves and whether it exists."""

from __future__ import annotations

from flockd.config.tracking import TrackingParameters
from flockd.tracking.measurement import Measurement
from flockd.tracking.tracker import Blind, Prediction, Tracker

__all__ = ["Blind", "Measurement", "Prediction", "Tracker", "TrackingParameters"]
