"""The ground below the drone: followed from ranges, and what it tells of the own motion's scale."""

from flockd.flight.pilot.ground.ground_filter import GroundFilter, level_ground
from flockd.flight.pilot.ground.ground_scale import scaled_by_ground

__all__ = ["GroundFilter", "level_ground", "scaled_by_ground"]
