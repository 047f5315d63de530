"""A free UDP port, a fake autopilot that hovers there, and its addresses: that port, and a serial device."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.sitl.processes import free_port
from tests.calm import clock
from tests.onboard.autopilot.serial_cable import SerialCable

HOVER_M = 2.5
HEARTBEAT_S = 0.25
"""Quicker than PX4's, so that a story does not begin with a second of waiting."""


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def cable(port: int, tmp_path: Path) -> Iterator[SerialCable]:
    with SerialCable(port, tmp_path / "ttyUSB0") as cable:
        yield cable


@pytest.fixture(params=["udp", "serial"])
def address(port: int, request: pytest.FixtureRequest) -> str:
    """Where the autopilots are heard that send to the port."""
    if request.param == "udp":
        return f"udpin://127.0.0.1:{port}"
    cable: SerialCable = request.getfixturevalue("cable")
    return cable.address


@pytest.fixture
def fake_autopilot(port: int) -> Iterator[FakeAutopilot]:
    with FakeAutopilot(port, height_m=HOVER_M, heartbeat_s=HEARTBEAT_S, clock=clock) as fake_autopilot:
        yield fake_autopilot
