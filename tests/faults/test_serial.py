"""Faults of a serial link to the autopilot, while a whole drone flies or waits on the ground."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from flockd.core.config import DroneConfig
from flockd.core.errors import ExitCode
from flockd.onboard.autopilot import mavsdk_link
from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tests.calm import clock
from tests.faults.conftest import InTheAir
from tests.faults.stories import Reacted
from tests.make import changed
from tests.onboard.autopilot.conftest import HEARTBEAT_S
from tests.onboard.autopilot.flight import until
from tests.onboard.autopilot.serial_cable import SerialCable
from tests.onboard.daemon.aboard import SECONDS_TO_FAIL, aboard

pytestmark = pytest.mark.slow
GONE_S = 2.0


def _over(cable: SerialCable) -> Callable[[DroneConfig], DroneConfig]:
    return partial(changed, autopilot__address=cable.address, autopilot__system_id=1)


@pytest.mark.fault("serial-port")
async def test_on_the_ground_it_comes_back_or_the_daemon_ends_for_a_restart(
    port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        SerialCable(port, tmp_path / "ttyUSB0") as cable,
        FakeAutopilot(port, heartbeat_s=HEARTBEAT_S, clock=clock) as autopilot,
    ):
        async with aboard(autopilot, port, tmp_path, change=_over(cable)) as ship:
            await ship.until_state("ready", "idle")
            cable.unplug()
            await ship.until_event(f"the autopilot's serial port {cable.device} is gone (")
            cable.plug_in()
            await ship.until_event(f"the autopilot's serial port {cable.device} is back after ")
            await ship.until_linked()
            assert not ship.ending.done()
            monkeypatch.setattr(mavsdk_link, "GONE_S", GONE_S)  # of real time: a busy computer plugs in late
            cable.unplug()
            await asyncio.wait({ship.ending}, timeout=SECONDS_TO_FAIL)
            error = ship.ending.exception()
            assert isinstance(error, AutopilotError)
            assert error.exit_code is ExitCode.UNAVAILABLE
            assert "has been gone for more than 2 s; check the cable" in str(error)


@pytest.mark.fault("serial-port", within_s=3.0)
async def test_in_flight_it_is_opened_again_however_long_that_takes_and_nothing_is_sent(
    in_the_air: InTheAir, fake_autopilot: FakeAutopilot, port: int, tmp_path: Path, reacted: Reacted,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(mavsdk_link, "GONE_S", GONE_S)
    with SerialCable(port, tmp_path / "ttyUSB0") as cable:
        async with in_the_air(change=_over(cable)) as ship:
            await ship.is_ready_in_the_air()
            await ship.flies()
            cable.unplug()
            fault_s = clock()
            await ship.until_event("silent: ")
            reacted("serial-port", clock() - fault_s)
            await until(lambda: fake_autopilot.mode == "LOITER", SECONDS_TO_FAIL)
            assert fake_autopilot.failsafe
            await asyncio.sleep(3 * GONE_S)
            assert not ship.ending.done(), "it is armed"
            async with ship.sends_nothing():
                cable.plug_in()
                await ship.until_event(f"the autopilot's serial port {cable.device} is back after ")
                await ship.until_linked()
            assert ship.state() == "silent"
