"""The autopilot stand-in of the autopilot's own stories."""

from tests.autopilot.conftest import port, stand_in

__all__ = ["port", "stand_in"]
