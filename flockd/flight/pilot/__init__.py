"""The pure pipeline from images to a velocity command."""

from flockd.flight.pilot.pilot import FlockPilot, StepTrace

__all__ = ["FlockPilot", "StepTrace"]
