"""The metric scale of depth that a network leaves open, fixed by the autopilot's height or by its velocity."""

from flockd.flight.perception.depth.by_height import fix_by_height
from flockd.flight.perception.depth.by_velocity import VelocityScale
from flockd.flight.perception.depth.ground_below import OF_HEIGHT, GroundBelow, NoGround
from flockd.flight.perception.depth.scale import Scale

__all__ = ["OF_HEIGHT", "GroundBelow", "NoGround", "Scale", "VelocityScale", "fix_by_height"]
