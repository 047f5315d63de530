"""The ground below the drone: its filter, and the scale of the own motion that follows from its height."""

from flockd.flight.pilot.ground.ground_filter import GroundFilter, level_ground
from flockd.flight.pilot.ground.ground_scale import scaled_by_ground

__all__ = ["GroundFilter", "level_ground", "scaled_by_ground"]
