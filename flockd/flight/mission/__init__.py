"""Missions: from time, own position and own flock to a desired velocity, height and status; one file for each kind.

All is horizontal except heights. No mission knows another drone's intentions.
"""

from __future__ import annotations

from flockd.flight.mission.guidance import Moment
from flockd.flight.mission.navigator import Navigator
from flockd.flight.mission.orders import order_fault

__all__ = ["Moment", "Navigator", "order_fault"]
