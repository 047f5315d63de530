"""Where a drone wants to go: time, own place and own flock to a desired velocity, height and status; one file a kind.

Everything is level but heights. Nothing here knows another drone's intentions.
"""

from __future__ import annotations

from flockd.core.config.mission import MissionParameters
from flockd.flight.mission.guidance import Guidance, Moment
from flockd.flight.mission.navigator import Navigator
from flockd.flight.mission.orders import order_fault

__all__ = ["Guidance", "MissionParameters", "Moment", "Navigator", "order_fault"]
