"""The pure line from pixels to command."""

from flockd.flight.pilot.pilot import FlockPilot, StepTrace

__all__ = ["FlockPilot", "StepTrace"]
