"""The fake autopilot of the autopilot's own stories."""

from tests.onboard.autopilot.conftest import fake_autopilot, port

__all__ = ["fake_autopilot", "port"]
