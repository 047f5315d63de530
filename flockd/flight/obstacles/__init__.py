"""Obstacles: ranges from the images, a local map of the last few seconds, and avoidance."""

from __future__ import annotations

from flockd.flight.obstacles.avoidance import Avoidance
from flockd.flight.obstacles.local_map import AZIMUTHS, LocalMap, in_view, nearest_points, nothing_found
from flockd.flight.obstacles.ranging import ObstacleRanging

__all__ = ["AZIMUTHS", "Avoidance", "LocalMap", "ObstacleRanging", "in_view", "nearest_points", "nothing_found"]
