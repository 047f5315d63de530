"""Neighbours over time: which detection is which drone, where it is now and how it moves."""

from __future__ import annotations

from flockd.config.tracking import TrackingParameters
from flockd.tracking.measurement import Measurement, detection_covariance
from flockd.tracking.tracker import Blind, ExpectedNeighbour, Tracker

__all__ = ["Blind", "ExpectedNeighbour", "Measurement", "Tracker", "TrackingParameters", "detection_covariance"]
