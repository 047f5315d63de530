"""Neighbours over time: which sighting is which drone, where it is now and how it moves."""

from __future__ import annotations

from flockd.config.tracking import TrackingParameters
from flockd.tracking.measurement import Measurement, sighting_covariance
from flockd.tracking.tracker import Blind, ExpectedNeighbour, Tracker

__all__ = ["Blind", "ExpectedNeighbour", "Measurement", "Tracker", "TrackingParameters", "sighting_covariance"]
