"""The ground below the drone, from the autopilot's height and a range finder."""

from flockd.flight.pilot.ground.ground_filter import GroundFilter, level_ground

__all__ = ["GroundFilter", "level_ground"]
