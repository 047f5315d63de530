"""Obstacles: kept in a local map for a few seconds, and flown around."""

from __future__ import annotations

from flockd.obstacles.avoidance import Avoidance
from flockd.obstacles.local_map import LocalMap, nearest_points

__all__ = ["Avoidance", "LocalMap", "nearest_points"]
