"""The flocking law (Eq. 38-42), the flock's desired velocity (Eq. 43) and, in `metrics`, figures of a flock.

Everything here is horizontal: north and east.
"""

from __future__ import annotations

from flockd.config.flocking import FlockingParameters, WeightParameters
from flockd.config.mission import DesiredVelocityParameters
from flockd.flocking.desired import course, desired_velocity
from flockd.flocking.law import FlockingLaw, level_offsets, limit_norm

__all__ = [
    "DesiredVelocityParameters",
    "FlockingLaw",
    "FlockingParameters",
    "WeightParameters",
    "course",
    "desired_velocity",
    "level_offsets",
    "limit_norm",
]
