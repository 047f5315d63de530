"""Two autopilots on one link: flockd does not guess which is its own."""

from __future__ import annotations

import asyncio

import pytest

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.errors import ExitCode
from flockd.onboard.autopilot import mavlink_messages, mavsdk_link
from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.mavsdk_link import AutopilotLink
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from tests.calm import clock
from tests.onboard.autopilot.flight import attended, until

TOLD = "autopilot.system_id: is missing, and the autopilots of systems 1, 2 are heard at "


def _neighbour(port: int, system_id: int = 2) -> FakeAutopilot:
    """As PX4 does it sends a heartbeat a second; it is switched on now."""
    return FakeAutopilot(port, system_id=system_id, height_m=2.5, clock=clock)


async def test_two_that_are_heard_are_refused_with_their_ids_and_the_key(
    port: int, address: str, fake_autopilot: FakeAutopilot
) -> None:
    with _neighbour(port), pytest.raises(AutopilotError) as refused:
        await AutopilotLink.connect(AutopilotParameters(address=address), clock=clock)
    assert refused.value.exit_code is ExitCode.BAD_CONFIGURATION
    assert str(refused.value) == f"{TOLD}{address}; write the MAV_SYS_ID of this drone's own"


@pytest.mark.parametrize("own", [1, 2])
async def test_by_its_id_either_is_flown(port: int, address: str, fake_autopilot: FakeAutopilot, own: int) -> None:
    with _neighbour(port) as neighbour:
        link = await AutopilotLink.connect(AutopilotParameters(address=address, system_id=own), clock=clock)
        await link.land()
        await until(lambda: "LAND" in {neighbour.mode, fake_autopilot.mode})
        assert (fake_autopilot.mode, neighbour.mode) == (("LAND", "LOITER") if own == 1 else ("LOITER", "LAND"))
        assert link.unusable() is None
        await link.close()


@pytest.mark.fault("serial-port")
async def test_a_second_one_that_comes_later_is_told_and_ends_it(
    port: int, address: str, fake_autopilot: FakeAutopilot
) -> None:
    async with attended(address, system_id=None) as link:
        assert link.unusable() is None
        with _neighbour(port):
            await until(lambda: link.unusable() is not None)
            error = link.unusable()
            assert error is not None
            assert error.exit_code is ExitCode.BAD_CONFIGURATION
            await until(lambda: bool(link.take_reports() == [str(error)]))
            assert str(error) == f"{TOLD}{address}; write the MAV_SYS_ID of this drone's own"
            assert link.system_id == 1


@pytest.mark.fault("serial-port")
@pytest.mark.parametrize("clocks_agree", [False, True])
async def test_one_of_the_same_id_is_told_by_its_clock_or_its_board_once_and_ends_it(
    port: int, address: str, fake_autopilot: FakeAutopilot, clocks_agree: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mavsdk_link, "VERSION_AGAIN_S", 0.5)
    async with attended(address) as link:
        await until(lambda: link.vehicle_state() is not None)
        await asyncio.sleep(1.0)
        assert link.unusable() is None
        with _neighbour(port, system_id=1) as neighbour:
            if clocks_agree:
                monkeypatch.setattr(mavlink_messages, "OTHER_CLOCK_MS", 1 << 40)
            else:
                neighbour.board = fake_autopilot.board
            await until(lambda: link.unusable() is not None)
            error = link.unusable()
            assert error is not None
            assert error.exit_code is ExitCode.BAD_CONFIGURATION
            assert str(error) == (
                f"autopilot.system_id: two autopilots of system 1 are heard at {address}; "
                "disconnect the other one, or give it another MAV_SYS_ID"
            )
            said = [report for report in link.take_reports() if "two autopilots with the same" in report]
            assert len(said) == 1
