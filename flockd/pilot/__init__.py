"""The pure line from pixels to command."""

from flockd.pilot.pilot import FlockPilot, StepTrace

__all__ = ["FlockPilot", "StepTrace"]
