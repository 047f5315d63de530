"""Obstacles in the images: the nearest in each direction, from the metric depth that is computed anyway."""

from __future__ import annotations

from flockd.perception.obstacles.ranging import ObstacleRanging

__all__ = ["ObstacleRanging"]
