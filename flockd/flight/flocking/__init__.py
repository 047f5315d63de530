"""The flocking law (Eq. 38-42) and how drones pass each other. Everything here is horizontal: north and east."""

from __future__ import annotations

from flockd.core.config.flocking import FlockingParameters
from flockd.flight.flocking.law import FlockingLaw

__all__ = ["FlockingLaw", "FlockingParameters"]
