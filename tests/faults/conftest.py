"""A drone in this process flies on the clock that it shares with the fake autopilot; one of its own in real time."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import AbstractAsyncContextManager
from pathlib import Path

import pytest

from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.sitl.ports import free_port
from tests import calm
from tests.onboard.autopilot.conftest import HEARTBEAT_S, HOVER_M
from tests.onboard.daemon.aboard import Aboard, aboard

InTheAir = Callable[..., AbstractAsyncContextManager[Aboard]]


def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """See `tests.calm`; by its fixtures a test says where its drone flies."""
    return calm.run_coroutine_test(pyfuncitem, calm.run) if "port" in pyfuncitem.fixturenames else None


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def fake_autopilot(port: int) -> Iterator[FakeAutopilot]:
    with FakeAutopilot(port, height_m=HOVER_M, heartbeat_s=HEARTBEAT_S, clock=calm.clock) as fake_autopilot:
        yield fake_autopilot


@pytest.fixture
def in_the_air(fake_autopilot: FakeAutopilot, port: int, tmp_path: Path) -> InTheAir:
    """Runs a daemon in this process, as `aboard` does, beside a vehicle in the air."""
    return functools.partial(aboard, fake_autopilot, port, tmp_path)
