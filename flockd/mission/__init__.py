"""Where a drone wants to go: time, own place and own flock to a desired velocity, height and status; one file a kind.

Everything is level but heights. Nothing here knows another drone's intentions.
"""

from __future__ import annotations

from flockd.config.mission import MissionParameters
from flockd.mission.guidance import Guidance, Moment
from flockd.mission.navigator import Navigator
from flockd.mission.orders import order_fault

__all__ = ["Guidance", "MissionParameters", "Moment", "Navigator", "order_fault"]
