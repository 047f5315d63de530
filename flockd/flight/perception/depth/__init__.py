"""The metric scale of depth that a network leaves open, fixed by the height above ground."""

from flockd.flight.perception.depth.by_height import fix_by_height
from flockd.flight.perception.depth.ground_below import OF_HEIGHT, GroundBelow, NoGround

__all__ = ["OF_HEIGHT", "GroundBelow", "NoGround", "fix_by_height"]
