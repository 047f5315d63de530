"""A drone in this process flies on the clock that it shares with the fake autopilot; one of its own in real time."""

from __future__ import annotations

import functools
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path

import pytest

from flockd.core.config import DroneConfig
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tests import calm
from tests.make import changed
from tests.onboard.autopilot.conftest import fake_autopilot, port
from tests.onboard.daemon.aboard import Aboard, aboard

__all__ = ["fake_autopilot", "port"]
InTheAir = Callable[..., AbstractAsyncContextManager[Aboard]]


def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """See `tests.calm`; by its fixtures a test says where its drone flies."""
    return calm.run_coroutine_test(pyfuncitem, calm.run) if "port" in pyfuncitem.fixturenames else None


@pytest.fixture
def in_the_air(fake_autopilot: FakeAutopilot, port: int, tmp_path: Path) -> InTheAir:
    """Runs a daemon in this process, as `aboard` does, beside a vehicle in the air."""
    return functools.partial(aboard, fake_autopilot, port, tmp_path)


def never_alone(config: DroneConfig, **safety: object) -> DroneConfig:
    """Flying without neighbours is no fault; ``safety``: other keys of that section."""
    return changed(config, safety__alone_s=None, **{f"safety__{key}": value for key, value in safety.items()})


@pytest.fixture
def in_flight(in_the_air: InTheAir) -> InTheAir:
    """The same, in offboard flight at cruise speed; flying alone is no fault unless ``change`` says so."""

    @asynccontextmanager
    async def fly(change: Callable[[DroneConfig], DroneConfig] = never_alone) -> AsyncIterator[Aboard]:
        async with in_the_air(change=change) as ship:
            await ship.is_ready_in_the_air()
            await ship.flies()
            yield ship

    return fly
