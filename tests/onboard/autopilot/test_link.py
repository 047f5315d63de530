"""MAVSDK itself against the fake autopilot over real UDP: what the link says is true, and what it is told happens."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from typing import Any

import numpy as np
import pytest
from mavsdk.connection_result import ConnectionResult
from mavsdk.logging import LogLevel
from mavsdk.mavsdk import Mavsdk
from mavsdk.system import System
from pymavlink.dialects.v20 import common as mavlink

from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.messages import Setpoint, VehicleState, Wanted
from flockd.onboard.autopilot.autopilot_status import AutopilotError, Firmware
from flockd.onboard.autopilot.mavsdk_link import (
    RECEIVED,
    SETPOINT_TYPE_MASK,
    TIME_SYNC,
    AutopilotLink,
    Severity,
    _tell_once,
    _to_logging,
)
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.autopilot.fake_range_finder import FakeRangeFinder, level_ground
from flockd.sim.autopilot.fake_telemetry import Mode
from flockd.sim.autopilot.fake_vehicle import Demand, MotionState
from flockd.sim.scenario import RangeFinderConfig
from flockd.sim.sitl.ground_station import GroundStation
from flockd.sim.sitl.processes import free_port
from tests.calm import clock
from tests.onboard.autopilot.conftest import HEARTBEAT_S, HOVER_M
from tests.onboard.autopilot.flight import Wire, attended, flying, until


def _parameters(address: str, system_id: int | None = 1) -> AutopilotParameters:
    return AutopilotParameters(address=address, system_id=system_id)


def test_the_type_mask_says_velocity_and_yaw() -> None:
    ignored = ("X", "Y", "Z", "AX", "AY", "AZ", "YAW_RATE")
    assert sum(getattr(mavlink, f"POSITION_TARGET_TYPEMASK_{name}_IGNORE") for name in ignored) == SETPOINT_TYPE_MASK


async def test_telemetry_is_what_the_vehicle_does(port: int, address: str) -> None:
    # Nose east, 30 degrees right side down; climbing to the north-east.
    sin, cos = math.sin(math.radians(30.0)), math.cos(math.radians(30.0))
    east_and_leaning = np.array([[0.0, -cos, sin], [1.0, 0.0, 0.0], [0.0, sin, cos]])
    truth = MotionState(np.array([3.0, -4.0, -7.5]), np.array([1.0, 2.0, -0.5]), east_and_leaning)

    def still(_demand: Demand, _interval_s: float) -> MotionState:
        return truth

    with FakeAutopilot(port, height_m=7.5, motion=still, heartbeat_s=HEARTBEAT_S, clock=clock) as fake_autopilot:
        fake_autopilot.battery_share, fake_autopilot.drifts = 0.42, False
        link = await AutopilotLink.connect(_parameters(address), clock=clock)
        await until(lambda: link.vehicle_state() is not None and link.status().battery_share is not None)
        await until(lambda: None not in {link.status().estimate_ok, link.status().gps_ok} and link.status().in_air)
        state, status = link.vehicle_state(), link.status()
        assert state is not None
        np.testing.assert_allclose(state.R_ned_body, east_and_leaning, atol=1e-6)
        assert state.velocity_ned is not None
        assert status.position_ned is not None
        np.testing.assert_allclose(state.velocity_ned, truth.velocity, atol=1e-6)
        assert state.height_m == pytest.approx(7.5, abs=1e-5)
        assert state.time_s <= status.time_s
        np.testing.assert_allclose(status.position_ned, truth.position, atol=1e-6)
        assert (status.flight_mode, status.armed, status.failsafe, status.in_air) == ("hold", True, False, True)
        await until(lambda: link.status().heartbeat_age_s < 2 * HEARTBEAT_S)
        assert (status.estimate_ok, status.gps_ok) == (True, True)
        assert status.battery_share == pytest.approx(0.42)

        fake_autopilot.estimate_ok = False
        await until(lambda: link.status().estimate_ok is False)
        fake_autopilot.silent = True
        await until(lambda: link.status().heartbeat_age_s > 4 * HEARTBEAT_S)
        await link.close()


async def test_what_another_component_of_its_system_sends_is_not_the_autopilots(
    port: int, address: str, fake_autopilot: FakeAutopilot
) -> None:
    """A gimbal's heartbeat has a mode of its own, and goes on when the autopilot's does not."""
    async with attended(address) as link:
        fake_autopilot.silent = True
        gimbal = mavlink.MAVLink(Wire(port), srcSystem=1, srcComponent=mavlink.MAV_COMP_ID_GIMBAL)

        def ages() -> bool:
            gimbal.heartbeat_send(mavlink.MAV_TYPE_GIMBAL, mavlink.MAV_AUTOPILOT_INVALID, 0, 6 << 16, 4)
            return link.status().heartbeat_age_s > 3 * HEARTBEAT_S

        await until(ages)
        assert link.status().flight_mode == "hold"


async def test_firmware_and_failsafe_parameters_can_be_read(address: str, fake_autopilot: FakeAutopilot) -> None:
    fake_autopilot.parameters |= {"COM_OF_LOSS_T": 0.75, "COM_OBL_RC_ACT": 4, "COM_LOW_BAT_ACT": -3}
    link = await AutopilotLink.connect(_parameters(address), clock=clock)
    assert await link.parameter("COM_OF_LOSS_T", float) == 0.75
    assert await link.parameter("COM_OBL_RC_ACT", int) == 4
    assert await link.parameter("COM_LOW_BAT_ACT", int) == -3
    assert await link.firmware() == Firmware("PX4", "0.0.1")
    with pytest.raises(AutopilotError, match="parameter COM_OBL_RC_ACT could not be read"):
        await link.parameter("COM_OBL_RC_ACT", float)
    await link.close()


@pytest.mark.fault("silent-autopilot")
async def test_an_autopilot_that_acts_on_the_loss_of_its_ground_station_hears_none_and_sends_no_texts(
    address: str, fake_autopilot: FakeAutopilot
) -> None:
    """Flockd's announcement would hide that loss. Its events tell the reason all the same."""
    fake_autopilot.parameters["NAV_DLL_ACT"] = 2
    async with attended(address) as link:
        await until(lambda: bool(link.received.parameters.values))
        assert not link.announces()
        fake_autopilot.parameters["NAV_DLL_ACT"] = 0
        await until(lambda: fake_autopilot.has_ground_station)
        fake_autopilot.parameters["NAV_DLL_ACT"] = 3
        await until(lambda: not fake_autopilot.has_ground_station)


@pytest.mark.fault("silent-autopilot")
async def test_a_list_of_which_events_are_lost_is_asked_for_anew(port: int, address: str) -> None:
    with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S, clock=clock) as fake_autopilot:
        async with attended(address) as link:
            await link.ask_for_checks()
            await until(link.knows_checks)
            fake_autopilot.checks.events_to_lose = 2
            fake_autopilot.failing = {"check_gyro_not_calibrated"}
            await until(lambda: [refusal.reason for refusal in link.refusals()] == ["check_gyro_not_calibrated"])
            fake_autopilot.checks.events_to_lose = 3  # all of them: the number of the newest is what tells
            fake_autopilot.failing = set()
            await until(lambda: link.refusals() == ())
            assert link.knows_checks()


@pytest.mark.fault("silent-autopilot")
async def test_an_autopilot_that_has_started_anew_is_asked_for_its_streams_again(port: int, address: str) -> None:
    with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S, clock=clock) as fake_autopilot:
        async with attended(address) as link:
            await asyncio.sleep(1.5)
            rates = dict(fake_autopilot.streams.intervals_s)
            fake_autopilot.restart()
            assert fake_autopilot.streams.intervals_s != rates
            await until(lambda: dict(fake_autopilot.streams.intervals_s) == rates)
            assert "the autopilot has started anew" in link.take_reports()


async def test_all_that_mavsdk_calls_is_kept_until_it_is_destroyed(port: int, address: str) -> None:
    """By attributes of MAVSDK that are its own: another version may name them otherwise."""
    with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S, clock=clock):
        link = await AutopilotLink.connect(_parameters(address))
        subscribed, _ = link._callbacks()
        assert len(subscribed) >= len({*RECEIVED, TIME_SYNC})
        await link.close()


async def test_what_still_sends_over_a_closed_link_is_refused(port: int, address: str) -> None:
    """MAVSDK would call memory that is free, which ends the process."""
    with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S, clock=clock):
        link = await AutopilotLink.connect(_parameters(address))
        attending = asyncio.create_task(link.attend())
        await until(lambda: math.isfinite(link.received.height_m))
        await link.close()
        with pytest.raises(AutopilotError, match="could not send a setpoint"):
            link.send_setpoint(Setpoint(0.0, np.zeros(2), 2.5, 0.0))
        with pytest.raises(AutopilotError, match="could not ask the autopilot"):
            await link.hold()
        attending.cancel()


async def test_the_vehicle_follows_the_velocity_and_holds_its_own_height(
    address: str, fake_autopilot: FakeAutopilot
) -> None:
    wanted = Wanted(np.array([0.6, -0.8]), np.zeros(2), yaw_rad=-0.5, height_m=3.0)

    def flies_as_asked(state: VehicleState | None) -> bool:
        assert state is not None
        assert state.velocity_ned is not None
        off = np.abs(state.velocity_ned - [0.6, -0.8, 0.0]).max()
        return bool(off < 0.15 and abs(state.height_m - 3.0) < 0.15)

    async with flying(address, wanted) as flight:
        await flight.enter_offboard()
        assert fake_autopilot.mode == "OFFBOARD"
        await until(lambda: flies_as_asked(flight.link.vehicle_state()))
        state = flight.link.vehicle_state()
        assert state is not None
        assert math.atan2(state.R_ned_body[1, 0], state.R_ned_body[0, 0]) == pytest.approx(-0.5, abs=0.05)
        assert fake_autopilot.refused_setpoints == 0


async def test_without_a_new_position_the_vehicle_sinks_no_farther(address: str, fake_autopilot: FakeAutopilot) -> None:
    """By its last position it would be above the height asked for, and sink, for ever.

    It stays in Hold: what is asked of it counts, as in a late setpoint stream it would go on with the last one.
    """

    def sink_m_s() -> float:
        link.send_setpoint(Setpoint(0.0, np.zeros(2), 0.5, 0.0))
        return fake_autopilot.setpoints[-1][1].sink_m_s if fake_autopilot.setpoints else math.nan

    async with attended(address) as link:
        await until(lambda: link.vehicle_state() is not None)
        await until(lambda: sink_m_s() == pytest.approx(HOVER_M - 0.5, abs=0.1))
        fake_autopilot.sends_motion = False
        await until(lambda: sink_m_s() == 0.0)


async def test_a_setpoint_that_is_not_finite_never_leaves(address: str, fake_autopilot: FakeAutopilot) -> None:
    link = await AutopilotLink.connect(_parameters(address), clock=clock)
    for broken in (
        Setpoint(0.0, np.array([math.nan, 0.0]), 2.5, 0.0),
        Setpoint(0.0, np.zeros(2), math.inf, 0.0),
        Setpoint(0.0, np.zeros(2), 2.5, math.nan),
    ):
        with pytest.raises(AutopilotError, match="not finite"):
            link.send_setpoint(broken)
    await asyncio.sleep(0.1)
    assert not fake_autopilot.setpoints
    assert fake_autopilot.refused_setpoints == 0
    await link.close()


async def test_from_offboard_it_lands_by_way_of_hold(
    address: str, fake_autopilot: FakeAutopilot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a landing PX4 returns to the mode before, and cannot be armed in offboard."""
    selected, select = list[str](), FakeAutopilot._select

    def noted(autopilot: FakeAutopilot, mode: Mode, component: int) -> bool:
        selected.append(mode)
        return select(autopilot, mode, component)

    monkeypatch.setattr(FakeAutopilot, "_select", noted)
    async with flying(address) as flight:
        await flight.enter_offboard()
        await flight.link.land()
    assert selected == ["OFFBOARD", "LOITER", "LAND"]


def test_nobody_there_is_told_with_what_to_check(address: str) -> None:
    with pytest.raises(AutopilotError, match=f"no autopilot was heard at {address} within 0.3 s"):
        asyncio.run(AutopilotLink.connect(_parameters(address, None), timeout_s=0.3))


async def test_no_system_outlives_a_search_that_fails(address: str, fake_autopilot: FakeAutopilot) -> None:
    """One that is collected while MAVSDK is destroyed, on another thread, ends the process."""
    handed_out: list[System] = []
    alive_at_the_end: list[int] = []

    class Watched(Mavsdk):  # type: ignore[misc]
        def get_systems(self) -> list[System]:
            found: list[System] = super().get_systems()
            handed_out.extend(system for system in found if system.has_autopilot())
            return found

        def destroy(self) -> None:
            alive_at_the_end.append(sum(system._handle is not None for system in handed_out))
            super().destroy()

    with pytest.raises(AutopilotError, match="heard instead: 1"):
        await AutopilotLink.connect(_parameters(address, system_id=5), timeout_s=3.0, clock=clock, create=Watched)
    await until(lambda: bool(alive_at_the_end))
    assert handed_out
    assert alive_at_the_end[0] == 0


async def test_flockd_is_a_computer_of_the_autopilots_own_system_whatever_its_number(port: int, address: str) -> None:
    """PX4 takes an onboard computer of another system for a stranger, and logs no text of it."""
    senders: set[int] = set()

    class Listening(FakeAutopilot):
        def _handle(self, message: Any, arrived_s: float, *, on_link: bool) -> None:
            senders.add(message.get_srcSystem())
            super()._handle(message, arrived_s, on_link=on_link)

    with Listening(port, system_id=3, height_m=2.5, heartbeat_s=HEARTBEAT_S, clock=clock):
        link = await AutopilotLink.connect(_parameters(address, None), clock=clock)
        senders.clear()
        assert await link.firmware() == Firmware("PX4", "0.0.1")
        assert senders == {3}
        await link.close()


async def test_a_text_reaches_a_ground_station_that_the_autopilot_forwards_to(port: int, address: str) -> None:
    """What is longer than MAVLink's chunks, what is too long, and what is no ASCII."""
    truth = free_port()
    with (
        FakeAutopilot(port, height_m=2.5, heartbeat_s=HEARTBEAT_S, truth_port=truth, clock=clock),
        GroundStation([truth], clock) as station,
    ):
        link = await AutopilotLink.connect(_parameters(address), clock=clock)
        await until(lambda: station.is_connected(0))
        long = "flockd hover: " + "no camera has sent a usable frame; " * 4
        for text, heard in (("flockd ready", "flockd ready"), (long[:100], long[:100]), (long, f"{long[:122]}..."),
                            ("fl\u00fcgge", "fl?gge")):  # fmt: skip
            link.send_text(text, Severity.WARNING)
            await until(lambda heard=heard: station.last_text(0) == heard)  # type: ignore[misc]
        await link.close()


async def test_two_programs_cannot_command_one_drone(address: str, fake_autopilot: FakeAutopilot) -> None:
    link = await AutopilotLink.connect(_parameters(address), clock=clock)
    with pytest.raises(AutopilotError, match=r"is another program on it|in use by another program"):
        await AutopilotLink.connect(_parameters(address), clock=clock)
    await link.close()


async def test_the_range_finder_is_heard_along_the_bodys_down_axis_and_falls_silent_with_it(
    port: int, address: str
) -> None:
    """Leaning by 30 degrees at 6 m: the slant range is 6 m / cos 30; out of its reach it sends no signal."""
    sin, cos = math.sin(math.radians(30.0)), math.cos(math.radians(30.0))
    leaning = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    place = np.array([0.0, 0.0, -6.0])
    config = RangeFinderConfig(noise=0.0, tilt_deg=0.0, dropouts_per_min=0.0, max_m=12.0)

    def still(_demand: Demand, _interval_s: float) -> MotionState:
        return MotionState(place.copy(), np.zeros(3), leaning)

    finder = FakeRangeFinder(config, level_ground, (0,))
    with FakeAutopilot(port, height_m=6.0, motion=still, heartbeat_s=HEARTBEAT_S, range_finder=finder, clock=clock):
        link = await AutopilotLink.connect(_parameters(address), clock=clock)
        await until(lambda: (state := link.vehicle_state()) is not None and state.ground_range is not None)
        reading = link.received.ground_range
        assert reading is not None
        assert reading.range_m == pytest.approx(6.0 / cos, abs=0.05)  # 0.01 m of noise, and centimetres
        assert (reading.min_m, reading.max_m, reading.quality) == pytest.approx((0.15, 12.0, 1.0))
        place[2] = -15.0
        await until(lambda: (reading := link.received.ground_range) is not None and reading.quality == 0.0)
        assert link.received.ranges_s
        await link.close()


async def test_a_start_that_is_given_up_does_not_destroy_mavsdk_under_its_own_call(address: str) -> None:
    """The library then reads freed memory, which ends the process (seen)."""
    told: list[str] = []
    destroyed = asyncio.Event()
    loop = asyncio.get_running_loop()

    class Slow(Mavsdk):  # type: ignore[misc]
        def add_any_connection(self, connection_url: str) -> ConnectionResult:
            told.append("begins")
            time.sleep(0.2)
            told.append("ends")
            return super().add_any_connection(connection_url)

        def destroy(self) -> None:
            told.append("destroyed")
            super().destroy()
            loop.call_soon_threadsafe(destroyed.set)

    connecting = asyncio.create_task(AutopilotLink.connect(_parameters(address), create=Slow))
    await until(lambda: told == ["begins"])
    connecting.cancel()
    await asyncio.wait({connecting})
    await asyncio.wait_for(destroyed.wait(), 10.0)
    assert told[:3] == ["begins", "ends", "destroyed"]


async def test_a_close_that_nobody_waits_for_still_destroys_mavsdk(address: str, fake_autopilot: FakeAutopilot) -> None:
    """Behind a request that the autopilot does not answer. One that is collected instead ends the process (seen)."""
    asked, answer = threading.Event(), threading.Event()
    destroyed = asyncio.Event()
    loop = asyncio.get_running_loop()

    def ask() -> None:
        asked.set()
        answer.wait()

    class Watched(Mavsdk):  # type: ignore[misc]
        def destroy(self) -> None:
            super().destroy()
            loop.call_soon_threadsafe(destroyed.set)

    link = await AutopilotLink.connect(_parameters(address), clock=clock, create=Watched)
    asking = asyncio.create_task(link._call(ask))
    await until(asked.is_set)
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.1):
            await link.close()
    answer.set()
    await asking
    await asyncio.wait_for(destroyed.wait(), 10.0)


def test_what_mavsdk_says_once_a_second_of_a_dead_autopilot_is_in_the_log_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    _tell_once.cache_clear()
    with caplog.at_level(logging.WARNING, logger="flockd.onboard.autopilot"):
        for number in range(180):
            _to_logging(LogLevel.ERROR, "once")
            _to_logging(LogLevel.DEBUG, f"number {number}")
    assert caplog.messages == ["once"]
