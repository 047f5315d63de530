"""A free UDP port, and an autopilot stand-in that hovers there."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.free_ports import free_port
from tests.calm import clock

HOVER_M = 2.5
HEARTBEAT_S = 0.25
"""Quicker than PX4's, so that a story does not begin with a second of waiting."""


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def fake_autopilot(port: int) -> Iterator[FakeAutopilot]:
    with FakeAutopilot(port, height_m=HOVER_M, heartbeat_s=HEARTBEAT_S, clock=clock) as fake_autopilot:
        yield fake_autopilot
