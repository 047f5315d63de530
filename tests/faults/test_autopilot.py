"""Faults of the autopilot and its link, while a whole drone flies."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mavlink

from flockd.core.config import DroneConfig
from flockd.core.errors import ExitCode
from flockd.onboard.autopilot.autopilot_status import AutopilotError
from flockd.onboard.autopilot.mavlink_messages import ReceivedMessages
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.autopilot.fake_telemetry import Mode, TelemetryStreams
from flockd.sim.autopilot.fake_vehicle import Demand, Flown, MotionState
from tests.calm import clock
from tests.faults.conftest import InTheAir, never_alone
from tests.faults.stories import Reacted
from tests.make import changed
from tests.onboard.autopilot.conftest import HEARTBEAT_S, HOVER_M
from tests.onboard.autopilot.flight import Foreigner, until
from tests.onboard.daemon.aboard import QUIET_S, SECONDS_TO_FAIL, SPEED_M_S, aboard

pytestmark = pytest.mark.slow
REASON = "Arming and offboard are denied: the estimator of this vehicle has not converged yet"


@pytest.mark.fault("pilot-takes-over", within_s=0.3)
async def test_the_pilot_takes_over(in_flight: InTheAir, reacted: Reacted) -> None:
    async with in_flight() as ship:
        fault_s = clock()
        ship.fake_autopilot.pilot_selects("POSCTL")
        await ship.until_event("silent: the flight mode is position")
        await asyncio.sleep(QUIET_S)
        reacted("pilot-takes-over", max(0.0, ship.last_setpoint_s() - fault_s))
        async with ship.sends_nothing():
            ship.fake_autopilot.pilot_selects("LOITER")
        assert (ship.fake_autopilot.mode, ship.state()) == ("LOITER", "silent")


class _Particular(FakeAutopilot):
    """Notes the commands with which somebody has asked it to arm or to change its mode; it may refuse to change it."""

    refuses: Callable[[Mode], bool] = staticmethod(lambda mode: False)
    reason = ""
    """Of its refusals, in messages of 50 bytes."""

    def __init__(self, port: int, **options: Any) -> None:
        super().__init__(port, **{"heartbeat_s": HEARTBEAT_S, "clock": clock, **options})
        self.asked: list[int] = []

    def _select(self, mode: Mode, component: int) -> bool:
        if not self.refuses(mode):
            return super()._select(mode, component)
        for at in range(0, len(self.reason), 50):
            self._mav.statustext_send(2, self.reason[at : at + 50].encode(), id=17, chunk_seq=at // 50)
        return False

    def _obey(self, command: int, message: Any) -> int:
        if command in {mavlink.MAV_CMD_DO_SET_MODE, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_NAV_TAKEOFF}:
            self.asked.append(command)
        return super()._obey(command, message)


@pytest.mark.fault("offboard-refused", within_s=2.0)
@pytest.mark.fault("text-in-chunks")
async def test_offboard_is_refused_and_the_whole_reason_reported(tmp_path: Path, port: int, reacted: Reacted) -> None:
    with _Particular(port, height_m=HOVER_M) as autopilot:
        autopilot.refuses, autopilot.reason = (lambda mode: mode == "OFFBOARD"), REASON
        async with aboard(autopilot, port, tmp_path, change=never_alone) as ship:
            await ship.is_ready_in_the_air()
            await until(lambda: autopilot.has_ground_station, SECONDS_TO_FAIL)
            asked_s = clock()
            station = mavlink.MAVLink(None, srcSystem=255, srcComponent=mavlink.MAV_COMP_ID_MISSIONPLANNER)
            request = station.command_long_encode(1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, 1, 6, 0, 0, 0, 0, 0)
            autopilot.send_from_elsewhere(bytes(request.pack(station)))
            await ship.until_event(f"the autopilot says: {REASON}")
            reacted("offboard-refused", clock() - asked_s)
            await asyncio.sleep(QUIET_S)
            assert (ship.state(), autopilot.mode) == ("ready", "LOITER")


@pytest.mark.fault("silent-autopilot", within_s=2.0)
async def test_an_autopilot_that_refuses_without_a_word_is_told_as_such(
    tmp_path: Path, port: int, reacted: Reacted
) -> None:
    with _Particular(port, height_m=HOVER_M) as autopilot:
        async with aboard(autopilot, port, tmp_path, change=never_alone) as ship:
            await ship.is_ready_in_the_air()
            await ship.flies()
            autopilot.refuses = lambda mode: True
            assert (await ship.ask("ask/land"))["accepted"] is True
            asked_s = clock()
            await ship.until_event("the autopilot was asked for hold, which was refused for now without a reason")
            reacted("silent-autopilot", clock() - asked_s)
            autopilot.refuses = lambda mode: mode == "LAND"
            await ship.until_event("the autopilot was asked for land, which was refused for now without a reason")
            autopilot.refuses = lambda mode: False
            await ship.until_mode("LAND")


@pytest.mark.fault("landed-after-a-restart")
async def test_started_in_the_air_and_landed_by_the_pilot_it_asks_for_nothing(tmp_path: Path, port: int) -> None:
    with _Particular(port, height_m=HOVER_M) as autopilot:
        async with aboard(autopilot, port, tmp_path) as ship:
            await ship.until_matters("started")
            autopilot.pilot_selects("LAND")
            await until(lambda: not autopilot.armed, SECONDS_TO_FAIL)
            await ship.until_matters("not_armed", over=("started",))
            await asyncio.sleep(2 * QUIET_S)
            assert (autopilot.armed, autopilot.asked, len(autopilot.setpoints)) == (False, [], 0)


@pytest.mark.fault("climb-interrupted")
async def test_the_pilot_changes_the_mode_while_it_climbs_and_by_hand_and_it_asks_for_nothing(
    tmp_path: Path, port: int
) -> None:
    with _Particular(port) as autopilot:
        async with aboard(autopilot, port, tmp_path) as ship:
            await ship.until_matters("not_armed", over=("started",))
            autopilot.pilot_arms()
            autopilot.pilot_selects("TAKEOFF")
            await until(lambda: float(autopilot.state.position[2]) < -0.5 * HOVER_M, SECONDS_TO_FAIL)
            for mode in ("LOITER", "POSCTL", "LOITER"):
                autopilot.pilot_selects(mode)
                await ship.until_state("ready")
                await asyncio.sleep(QUIET_S)
                assert (autopilot.mode, autopilot.asked) == (mode, [])


Happens = Callable[[FakeAutopilot], AbstractContextManager[object]]


def _sets(**values: Any) -> Happens:
    """Attributes of the autopilot, from now on."""
    return lambda autopilot: nullcontext(vars(autopilot).update(values))


def _parameter(autopilot: FakeAutopilot, **values: float) -> AbstractContextManager[object]:
    return nullcontext(autopilot.parameters.update(values))


def _jumps(*frame_off: float, heading_off_rad: float = 0.0) -> Happens:
    return _sets(frame_off=np.array(frame_off), heading_off_rad=heading_off_rad)


JUMPED = "asking: the autopilot's estimate of position or heading has jumped"
FRAME = (JUMPED, "the autopilot's local frame jumped by ")
FOREIGN = ("asking: another program sends setpoints: the autopilot follows ",)
CHANGED = (
    "the autopilot's COM_OBL_RC_ACT was changed in flight from 5 to -1",
    "asking: the autopilot's COM_OBL_RC_ACT is -1: it would not stop",
)


@pytest.mark.fault("battery-or-estimate", within_s=3.0)
@pytest.mark.fault("others-interfere", within_s=2.0)
@pytest.mark.fault("frame-jumps", within_s=2.0)
@pytest.mark.parametrize(
    ("fault", "happens", "matter", "told", "mode"),
    [
        ("battery-or-estimate", _sets(battery_share=0.05), "battery_low", ("silent: ",), "LOITER"),
        ("battery-or-estimate", _sets(battery_share=0.05), "battery_low", ("silent: ",), "RTL"),
        ("battery-or-estimate", _sets(estimate_ok=False), "position_lost", ("silent: ",), "LOITER"),
        ("others-interfere", partial(Foreigner, north_m_s=0.0, east_m_s=1.0), "foreign_setpoints", FOREIGN, "LOITER"),
        ("others-interfere", partial(_parameter, COM_OBL_RC_ACT=-1), "parameters_unsuitable", CHANGED, "LOITER"),
        ("frame-jumps", _jumps(0.0, 0.0, -4.0), "frame_jumped", FRAME, "LOITER"),
        ("frame-jumps", _jumps(0.0, 0.0, 30.0), "frame_jumped", FRAME, "LOITER"),
        ("frame-jumps", _jumps(20.0, 0.0, 0.0), "frame_jumped", FRAME, "LOITER"),
        (
            "frame-jumps", _jumps(0.0, 0.0, 0.0, heading_off_rad=0.8), "frame_jumped",
            (JUMPED, "the autopilot's heading jumped by "), "LOITER",
        ),
    ],
    ids=["battery", "battery, to return", "estimate", "foreign setpoints", "a parameter of the failsafe is changed",
         "4 m up", "30 m down", "20 m north", "heading"],
)  # fmt: skip
async def test_what_it_must_not_fly_with_is_told_once_and_ends_in_hold(
    fault: str, happens: Happens, matter: str, told: tuple[str, ...], mode: str, in_flight: InTheAir,
    fake_autopilot: FakeAutopilot, reacted: Reacted,
) -> None:  # fmt: skip
    """Not even one setpoint follows a jump."""
    async with in_flight(partial(never_alone, on_battery_low="return" if mode == "RTL" else "hold")) as ship:
        await asyncio.sleep(2.0)  # all parameters have been read
        height_m, began_s = -float(fake_autopilot.state.position[2]), clock()
        with happens(fake_autopilot):
            await ship.until_event(told[0])
            reacted(fault, clock() - began_s)
            await ship.until_mode(mode)
            assert clock() - began_s < 3.5
            await ship.until_matters(matter)
        assert not fake_autopilot.failsafe or matter == "position_lost"
        await ship.until_state("silent")
        await asyncio.sleep(0.2)  # what was sent before has arrived
        async with ship.sends_nothing():
            for beginning in told[1:]:
                await ship.until_event(beginning)
        assert [sum(event.startswith(beginning) for event in ship.events) for beginning in told] == [1] * len(told)
        sunk_m_s = [asked.sink_m_s for at_s, asked in list(fake_autopilot.setpoints) if at_s > began_s]
        assert max(map(abs, sunk_m_s), default=0.0) < 0.3
        assert mode == "RTL" or -float(fake_autopilot.state.position[2]) == pytest.approx(height_m, abs=0.4)


@pytest.mark.fault("heartbeats-lost", within_s=2.5)
async def test_forty_heartbeats_are_lost_one_at_a_time_and_no_flight_ends(
    tmp_path: Path, port: int, reacted: Reacted, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of PX4's, one a second; each of the forty could end a flight. Time stands still while one is on its way."""
    send, take, way_s = TelemetryStreams._send_heartbeat, ReceivedMessages._count_heartbeats, {"sent": 0.0, "came": 0.0}

    def sends(streams: TelemetryStreams) -> None:
        way_s["sent"] = 0.0 if streams.heartbeats_to_lose else time.monotonic()
        send(streams)

    def takes(messages: ReceivedMessages, time_s: float) -> None:
        take(messages, time_s)
        way_s["came"] = time.monotonic()

    monkeypatch.setattr(TelemetryStreams, "_send_heartbeat", sends)
    monkeypatch.setattr(ReceivedMessages, "_count_heartbeats", takes)
    with FakeAutopilot(port, height_m=HOVER_M, clock=clock) as autopilot:
        async with aboard(autopilot, port, tmp_path, change=never_alone) as ship:
            await ship.is_ready_in_the_air()
            await ship.flies()

            def lost() -> int:
                return int(ship.heard()["flight"].message["heartbeats_lost"])

            monkeypatch.setattr(clock, "stands", lambda: way_s["sent"] > way_s["came"])
            slowest_s = 0.0
            for number in range(1, 41):
                lost_s = clock()
                autopilot.streams.heartbeats_to_lose = 1
                await until(lambda n=number: lost() >= n, SECONDS_TO_FAIL)  # type: ignore[misc]
                slowest_s = max(slowest_s, clock() - lost_s)
                assert autopilot.mode == "OFFBOARD"
                assert ship.state() in {"normal", "degraded"}
            reacted("heartbeats-lost", slowest_s - 1.0)
            assert lost() == 40
            assert sum(event.startswith("the autopilot's heartbeat did not come") for event in ship.events) <= 1


@pytest.mark.fault("failsafe-then-resume", within_s=2.0)
@pytest.mark.fault("own-stall", within_s=2.0)
async def test_after_the_autopilots_failsafe_it_says_what_to_select_and_is_not_ready_before(
    in_flight: InTheAir, fake_autopilot: FakeAutopilot, reacted: Reacted
) -> None:
    async with in_flight() as ship:
        time.sleep(2.0)  # the loop is stuck, and the autopilot's failsafe acts
        awake_s = clock()
        await ship.until_event("silent: setpoints ended: the control loop is late, for more than 0.5 s")
        reacted("own-stall", clock() - awake_s)
        await until(lambda: ship.heard()["flight"].message["state"] == "silent", SECONDS_TO_FAIL)
        reasons = [reason["event"] for reason in ship.heard()["flight"].message["reasons"]]
        assert reasons.index("stream_ended") == 0
        assert "not_offboard" in reasons, "the consequence stands beside the cause"
        assert (await ship.ask("ask/resume"))["accepted"] is True
        resumed_s, sent = clock(), len(fake_autopilot.setpoints)
        await until(lambda: ship.state() == "idle" and "autopilot_failsafe" in ship.matters(), SECONDS_TO_FAIL)
        reacted("failsafe-then-resume", clock() - resumed_s)
        await asyncio.sleep(QUIET_S)
        assert (ship.state(), len(fake_autopilot.setpoints)) == ("idle", sent)
        fake_autopilot.pilot_selects("LOITER")
        await ship.until_state("ready")
        await ship.flies()


@pytest.mark.fault("link-lost", within_s=2.0)
@pytest.mark.fault("link-gap", within_s=1.0)
async def test_a_gap_that_the_autopilots_failsafe_does_not_outlast_ends_the_stream_before_it(
    in_flight: InTheAir, fake_autopilot: FakeAutopilot, reacted: Reacted
) -> None:
    """A setpoint after it would bring the autopilot back to offboard, and the next gap into its failsafe again."""
    async with in_flight() as ship:
        fake_autopilot.silent = True
        fault_s = clock()
        await ship.until_event("silent: setpoints ended: nothing was heard of the autopilot for 0.")
        for fault in ("link-lost", "link-gap"):
            reacted(fault, clock() - fault_s)
        await asyncio.sleep(max(0.0, fault_s + 1.5 - clock()))
        assert (fake_autopilot.mode, fake_autopilot.failsafe) == ("LOITER", True), "COM_OF_LOSS_T is 1 s"
        fake_autopilot.silent = False
        async with ship.sends_nothing():
            await ship.until_linked()
            await asyncio.sleep(2 * QUIET_S)
        assert (ship.state(), fake_autopilot.mode) == ("silent", "LOITER")


class _Sluggish:
    """A vehicle that follows what it is asked for some time later."""

    def __init__(self, late_s: float) -> None:
        self._flown, self._late_s, self._now_s = Flown(np.array([0.0, 0.0, -HOVER_M])), late_s, 0.0
        self._asked: deque[tuple[float, Demand]] = deque()

    def __call__(self, demand: Demand, interval_s: float) -> MotionState:
        self._now_s += interval_s
        self._asked.append((self._now_s + self._late_s, demand))
        while len(self._asked) > 1 and self._asked[1][0] <= self._now_s:
            self._asked.popleft()
        return self._flown(self._asked[0][1], interval_s)


@pytest.mark.fault("autopilot-oscillates", within_s=25.0)
@pytest.mark.parametrize(
    ("late_s", "state", "told"),
    [(0.6, "degraded", "follows them 0.5 s later than expected"), (1.7, "asking", " s later than expected (limits")],
    ids=["half a second", "seconds"],
)
async def test_an_autopilot_that_follows_late_is_told_as_such_and_nothing_makes_up_for_it(
    late_s: float, state: str, told: str, tmp_path: Path, port: int, reacted: Reacted
) -> None:
    """On a narrow circle, as straight flight shows no delay."""

    def circling(config: DroneConfig) -> DroneConfig:
        return never_alone(changed(config, mission__circle_until_s=1000.0, mission__radius_m=2.0))

    with FakeAutopilot(
        port, height_m=HOVER_M, motion=_Sluggish(late_s), heartbeat_s=HEARTBEAT_S, clock=clock
    ) as autopilot:
        autopilot.drifts = False
        async with aboard(autopilot, port, tmp_path, change=circling) as ship:
            await ship.is_ready_in_the_air()
            await until(lambda: len(autopilot.setpoints) > 5, SECONDS_TO_FAIL)
            autopilot.pilot_selects("OFFBOARD")
            selected_s = clock()
            await until(
                lambda: any(text.startswith(f"{state}: ") and told in text for text in ship.events), SECONDS_TO_FAIL
            )
            reacted("autopilot-oscillates", clock() - selected_s)
            await until(lambda: autopilot.mode == ("OFFBOARD" if state == "degraded" else "LOITER"), SECONDS_TO_FAIL)
            await asyncio.sleep(2.0)
            assert not any("gust" in text for text in ship.events), ship.events
            fastest_m_s = max(np.linalg.norm(asked.velocity) for _, asked in list(autopilot.setpoints))
            assert fastest_m_s <= SPEED_M_S + 1e-6


@pytest.mark.fault("serial-port", within_s=3.0)
async def test_a_second_autopilot_of_the_same_id_is_told_in_flight_and_the_next_flight_is_refused(
    in_flight: InTheAir, fake_autopilot: FakeAutopilot, port: int, reacted: Reacted
) -> None:
    async with in_flight() as ship:
        await asyncio.sleep(1.0)
        with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S, clock=clock):  # on the ground, and disarmed
            heard_s = clock()
            await ship.until_event("two autopilots with the same system id are heard")
            reacted("serial-port", clock() - heard_s)
            fake_autopilot.pilot_selects("LAND")
            await asyncio.wait({ship.ending}, timeout=SECONDS_TO_FAIL)
        error = ship.ending.exception()
        assert isinstance(error, AutopilotError)
        assert error.exit_code is ExitCode.BAD_CONFIGURATION
        assert "two autopilots of system 1 are heard at " in str(error)


@pytest.mark.fault("setpoints-clipped", within_s=4.0)
async def test_where_the_autopilot_limits_setpoints_flockd_asks_for_no_more_and_nobody_is_accused(
    tmp_path: Path, port: int, fake_autopilot: FakeAutopilot, reacted: Reacted
) -> None:
    fake_autopilot.parameters["MPC_XY_VEL_MAX"] = 0.5
    async with aboard(fake_autopilot, port, tmp_path, change=never_alone) as ship:
        await ship.is_ready_in_the_air()
        await until(lambda: len(fake_autopilot.setpoints) > 50, SECONDS_TO_FAIL)
        fake_autopilot.pilot_selects("OFFBOARD")
        selected_s = clock()
        await ship.until_event("the autopilot's MPC_XY_VEL_MAX is 0.5 m/s: flockd asks for no more in this flight")
        reacted("setpoints-clipped", clock() - selected_s)
        await until(lambda: bool(np.linalg.norm(fake_autopilot.setpoints[-1][1].velocity) > 0.45), SECONDS_TO_FAIL)
        await asyncio.sleep(12.0)  # the memory of the velocity's error, and more
        fastest_m_s = max(np.linalg.norm(demand.velocity) for _, demand in list(fake_autopilot.setpoints))
        assert fastest_m_s <= 0.5 + 1e-6
        assert fake_autopilot.mode == "OFFBOARD"
        assert not any("another program" in event or "differs from its setpoints" in event for event in ship.events)


@pytest.mark.fault("frame-jumps", within_s=2.0)
async def test_a_small_jump_of_the_local_frame_is_said_and_flown_through(
    in_flight: InTheAir, fake_autopilot: FakeAutopilot, reacted: Reacted
) -> None:
    async with in_flight() as ship:
        height_m, jumped_s = -float(fake_autopilot.state.position[2]), clock()
        fake_autopilot.frame_off = np.array([0.0, 0.6, -0.9])
        await ship.until_event("the autopilot's local frame jumped by ")
        reacted("frame-jumps", clock() - jumped_s)
        while clock() < jumped_s + 3.0:
            assert -float(fake_autopilot.state.position[2]) == pytest.approx(height_m, abs=0.15)
            state = ship.heard()["state"].message
            assert state["height_m"] == pytest.approx(height_m, abs=0.2)
            assert state["position_ne"][1] == pytest.approx(0.0, abs=0.45), "east of home, by an estimate that drifts"
            assert (ship.state() in {"normal", "degraded"}, fake_autopilot.mode) == (True, "OFFBOARD"), ship.events
            await asyncio.sleep(0.02)


@pytest.mark.fault("parameters-unsuitable")
@pytest.mark.parametrize(("name", "value"), [("COM_OF_LOSS_T", 20.0), ("COM_OBL_RC_ACT", -1)])
async def test_a_drone_whose_failsafe_would_not_stop_it_waits_and_says_why(
    name: str, value: float, tmp_path: Path, port: int, fake_autopilot: FakeAutopilot
) -> None:
    fake_autopilot.parameters[name] = value
    async with aboard(fake_autopilot, port, tmp_path, change=never_alone) as ship:
        await ship.until_matters("parameters_unsuitable")
        assert any(f"the autopilot's {name} is {value:g}: " in str(heard.message) for heard in ship.heard().values())
        await asyncio.sleep(1.0)
        assert (ship.state(), len(fake_autopilot.setpoints)) == ("idle", 0)
        fake_autopilot.parameters[name] = {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 5}[name]
        await ship.until_matters(over=("parameters_unsuitable",))


@pytest.mark.fault("landed-after-an-order", within_s=2.0)
async def test_landed_and_disarmed_after_an_operators_order_the_next_flight_may_begin(
    in_flight: InTheAir, fake_autopilot: FakeAutopilot, reacted: Reacted
) -> None:
    async with in_flight() as ship:
        assert (await ship.ask("ask/land"))["accepted"] is True
        await until(lambda: not fake_autopilot.armed, SECONDS_TO_FAIL)
        disarmed_s = clock()
        await ship.until_matters("not_armed", over=("land_asked",))
        reacted("landed-after-an-order", clock() - disarmed_s)
        fake_autopilot.pilot_arms()
        fake_autopilot.pilot_selects("TAKEOFF")
        await ship.until_state("ready")
        await ship.flies()


@pytest.mark.fault("ground-reached", within_s=6.0)
async def test_the_ground_is_reached_in_flight(in_flight: InTheAir, reacted: Reacted) -> None:
    """The vehicle sinks whatever it is told; its barometer says zero and less. Landing is reported."""
    async with in_flight() as ship:
        autopilot = ship.fake_autopilot
        autopilot._demand = lambda: Demand(np.zeros(2), 0.4, 0.0)  # type: ignore[method-assign]
        await until(lambda: float(autopilot.state.position[2]) > -0.1, SECONDS_TO_FAIL)
        fault_s = clock()
        await ship.until_mode()
        reacted("ground-reached", clock() - fault_s)
        await until(lambda: ship.heard()["flight"].message["in_air"] is False, SECONDS_TO_FAIL)
        assert any("land" in event or "ground" in event for event in ship.events), ship.events
        await ship.steps_on(3)
        assert not ship.ending.done()
