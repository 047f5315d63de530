"""The pure line from pixels to command."""

from flockd.pilot.pilot import FlockPilot
from flockd.pilot.views import Perceiver

__all__ = ["FlockPilot", "Perceiver"]
