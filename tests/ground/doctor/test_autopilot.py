"""What is asked of the autopilot over real MAVLink, a fake, not PX4, and what is made of its replies."""

from __future__ import annotations

from typing import Any

import pytest

from flockd.core.choices import HeightSource
from flockd.core.config import DroneConfig, load_drone
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.config.safety import GateParameters, SafetyParameters
from flockd.core.data import data_path
from flockd.core.messages import RangeReading
from flockd.ground.doctor import Check, Finding, Level, run_checks
from flockd.ground.doctor.autopilot_checks import (
    check_autopilot,
    judge_clock,
    judge_firmware,
    judge_messages,
    judge_parameter,
    judge_range_finder,
    judge_signing,
    judge_system_id,
)
from flockd.onboard.autopilot.autopilot_status import Firmware
from flockd.onboard.autopilot.clock_sync import ClockEstimate
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.autopilot.fake_range_finder import FakeRangeFinder, level_ground
from flockd.sim.scenario import RangeFinderConfig
from flockd.sim.sitl.ports import free_port
from tests.onboard.autopilot.conftest import HEARTBEAT_S

GOOD: dict[str, float | int] = {
    "COM_OF_LOSS_T": 1.0,
    "COM_OBL_RC_ACT": 5,
    "COM_LOW_BAT_ACT": 3,
    "GF_ACTION": 2,
    "GF_MAX_HOR_DIST": 60.0,
    "GF_MAX_VER_DIST": 15.0,
    "CP_DIST": -1.0,
}
"""For the quadrotor's own fence of 50 m and 10 m of height."""
QUESTIONS = {511, 512, 401}
"""MAV_CMD_SET_MESSAGE_INTERVAL, _REQUEST_MESSAGE and _RUN_PREARM_CHECKS."""


def _config(port: int) -> DroneConfig:
    quadrotor = load_drone(data_path("config") / "quadrotor.yaml")
    return quadrotor.model_copy(update={"autopilot": AutopilotParameters(address=f"udpin://127.0.0.1:{port}")})


def _examined(port: int, heard_s: float = 60.0) -> dict[str, Finding]:
    check = Check("autopilot", lambda: check_autopilot(_config(port), heard_s), limit_s=60.0)
    return {finding.about: finding for finding in run_checks([check], lambda done, total: None)["autopilot"]}


class _Noting(FakeAutopilot):
    """Keeps what it is asked for; its cable is cut before the question for ``cut_at``."""

    asked: tuple[int, ...] = ()
    cut_at = ""

    def _obey(self, command: int, message: Any) -> int:
        self.asked += (command,)
        return super()._obey(command, message)

    def _send_parameter(self, name: str) -> None:
        self.silent = name == self.cut_at
        super()._send_parameter(name)


def test_an_autopilot_that_is_set_up_well_and_left_as_it_is() -> None:
    port = free_port()
    finder = FakeRangeFinder(RangeFinderConfig(dropouts_per_min=0.0), level_ground, (0,))
    with _Noting(port, heartbeat_s=HEARTBEAT_S, range_finder=finder) as fake_autopilot:
        fake_autopilot.parameters.update(GOOD)
        found = _examined(port)
        assert (fake_autopilot.armed, fake_autopilot.mode) == (False, "LOITER")
        assert not fake_autopilot.setpoints
        assert fake_autopilot.refused_setpoints == 0
        assert fake_autopilot.parameters == {**fake_autopilot.parameters, **GOOD}
    assert set(fake_autopilot.asked) <= QUESTIONS, "it listens and asks, and commands nothing"
    assert found.keys() == {"heartbeat", "system id", "firmware", "signing", "arming", "clock", "range finder", *GOOD}
    del found["clock"]  # how even it is depends on how busy this computer is
    assert {about for about, finding in found.items() if finding.level is not Level.PASS} == {"firmware", "system id"}
    assert found["firmware"].measured.startswith("PX4 0.0.1 is older than 1.14"), "the fake autopilot is not PX4"
    assert "system 1 at udpin://127.0.0.1" in found["heartbeat"].measured
    assert "disarmed, in flight mode hold" in found["heartbeat"].measured


def test_bad_values_are_read_and_reported_with_what_to_do() -> None:
    port = free_port()
    with FakeAutopilot(port, height_m=2.0, heartbeat_s=HEARTBEAT_S) as fake_autopilot:
        fake_autopilot.parameters.update({**GOOD, "COM_OF_LOSS_T": 2.5, "COM_OBL_RC_ACT": 1, "GF_MAX_HOR_DIST": 0.0})
        del fake_autopilot.parameters["GF_ACTION"]
        found = _examined(port)
    assert found["COM_OF_LOSS_T"].level is Level.WARNING
    assert found["COM_OF_LOSS_T"].measured.startswith("2.5 s: so long it flies on")
    assert found["COM_OF_LOSS_T"].fix == "set COM_OF_LOSS_T to 1 s"
    assert found["COM_OBL_RC_ACT"].level is Level.FAILURE
    assert "drifts on" in found["COM_OBL_RC_ACT"].measured
    assert found["GF_MAX_HOR_DIST"].level is Level.WARNING
    assert found["GF_MAX_HOR_DIST"].fix == "set GF_MAX_HOR_DIST to 60 m, a little outside flockd's own"
    assert found["GF_ACTION"].level is Level.FAILURE
    assert "GF_ACTION could not be read (timeout)" in found["GF_ACTION"].measured
    assert (found["heartbeat"].level, found["heartbeat"].measured[-9:]) == (Level.WARNING, "and armed")


def test_what_keeps_it_from_being_armed_is_a_failure_each_with_what_to_do() -> None:
    port = free_port()
    with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S) as fake_autopilot:
        fake_autopilot.failing = {"check_gyro_not_calibrated"}
        found = _examined(port)["arming"]
    assert (found.level, found.measured, found.fix) == (
        Level.FAILURE, "refuses to arm: a gyroscope is not calibrated", "calibrate it in the ground station"
    )  # fmt: skip


@pytest.mark.parametrize(
    ("error_s", "level", "words"),
    [
        (
            0.0004,
            Level.PASS,
            "-46765.2500 s against this computer's, known to 0.40 ms; single measurements 2.00 ms apart",
        ),
        (
            0.02,
            Level.WARNING,
            "known to 20.00 ms; single measurements 2.00 ms apart, shortest round trip 3.0 ms: so unc",
        ),
    ],
)
def test_a_clock_is_good_as_its_round_trips(error_s: float, level: Level, words: str) -> None:
    finding = judge_clock(ClockEstimate(47_000.0, -46_765.25, error_s, 0.002, 0.003, 0.003))
    assert finding.level is level
    assert words in finding.measured
    assert judge_clock(None).level is Level.WARNING


def test_two_autopilots_are_a_failure_that_names_both_and_one_without_an_id_a_warning() -> None:
    port = free_port()
    with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S), FakeAutopilot(port, system_id=7):
        (finding,) = _examined(port).values()
    assert (finding.level, finding.about) == (Level.FAILURE, "autopilot")
    assert "autopilot.system_id: is missing, and the autopilots of systems 1, 7 are heard at " in finding.measured
    assert finding.fix == "write the MAV_SYS_ID of this drone's own"
    (finding,) = judge_system_id(7, AutopilotParameters())
    assert (finding.level, finding.about) == (Level.WARNING, "system id")
    assert "give each drone of the fleet another MAV_SYS_ID" in finding.fix
    assert judge_system_id(7, AutopilotParameters(system_id=7)) == []


def test_nobody_there_is_a_failure() -> None:
    port = free_port()
    (finding,) = _examined(port, 0.3).values()
    assert (finding.level, finding.about) == (Level.FAILURE, "autopilot")
    assert finding.measured == f"no autopilot was heard at udpin://127.0.0.1:{port} within 0.3 s"
    assert finding.fix.startswith("check autopilot.address")


def test_an_autopilot_that_falls_silent_under_examination_is_a_failure() -> None:
    port = free_port()
    with _Noting(port, heartbeat_s=HEARTBEAT_S) as fake_autopilot:
        fake_autopilot.cut_at = "COM_OBL_RC_ACT"
        fake_autopilot.parameters.update(GOOD)
        check = Check("autopilot", lambda: check_autopilot(_config(port)), limit_s=60.0)
        found = run_checks([check], lambda done, total: None)["autopilot"]
    assert [(finding.about, finding.level) for finding in found] == [
        ("heartbeat", Level.PASS),
        ("system id", Level.WARNING),
        ("firmware", Level.WARNING),
        ("signing", Level.PASS),
        ("COM_OF_LOSS_T", Level.PASS),
        ("COM_OBL_RC_ACT", Level.FAILURE),
        ("heartbeat", Level.FAILURE),
    ]
    assert found[-1].measured.endswith(" s ago and not since")


def test_no_autopilot_is_only_for_the_simulator() -> None:
    (finding,) = check_autopilot(load_drone(data_path("config") / "simulator.yaml"))
    assert finding.level is Level.WARNING
    assert "can be simulated but not flown" in finding.measured


@pytest.mark.parametrize(
    ("name", "value", "level"),
    [
        # PX4's own lists: 0 position, 1 altitude, 2 stabilized, 3 return, 4 land, 5 hold, 6 terminate, 7 disarm.
        *[("COM_OBL_RC_ACT", value, Level.FAILURE) for value in (-1, 1, 2, 6, 7, 8)],
        *[("COM_OBL_RC_ACT", value, Level.PASS) for value in (3, 4, 5)],
        ("COM_OBL_RC_ACT", 0, Level.WARNING),
        # 0 warning, 2 land, 3 return or land.
        *[("COM_LOW_BAT_ACT", value, Level.WARNING) for value in (0, 4)],
        *[("COM_LOW_BAT_ACT", value, Level.PASS) for value in (2, 3)],
        # 0 none, 1 warning, 2 hold, 3 return, 4 terminate, 5 land.
        *[("GF_ACTION", value, Level.WARNING) for value in (0, 1, 4)],
        *[("GF_ACTION", value, Level.PASS) for value in (2, 3, 5)],
        ("COM_OF_LOSS_T", 0.5, Level.FAILURE),  # no longer than the gaps that the streamer may leave
        ("COM_OF_LOSS_T", 0.75, Level.PASS),
        ("COM_OF_LOSS_T", 1.0, Level.PASS),
        ("COM_OF_LOSS_T", 1.1, Level.WARNING),
        ("GF_MAX_HOR_DIST", 0.0, Level.WARNING),
        ("GF_MAX_HOR_DIST", 50.0, Level.WARNING),
        ("GF_MAX_HOR_DIST", 51.0, Level.PASS),
        ("GF_MAX_VER_DIST", 0.0, Level.WARNING),
        ("GF_MAX_VER_DIST", 9.0, Level.WARNING),
        ("GF_MAX_VER_DIST", 12.0, Level.PASS),
        ("CP_DIST", -1.0, Level.PASS),
        ("CP_DIST", 2.0, Level.WARNING),
    ],
)
def test_what_is_made_of_each_value(name: str, value: float, level: Level) -> None:
    finding = judge_parameter(name, value, _config(14540))
    assert (finding.about, finding.level) == (name, level)
    assert (finding.fix == "") == (level is Level.PASS)


@pytest.mark.parametrize(("value", "level"), [(-1.0, Level.WARNING), (2.0, Level.PASS)])
def test_collision_prevention_is_on_where_flockd_sends_for_it(value: float, level: Level) -> None:
    config = _config(14540)
    assert config.autopilot is not None
    sending = config.autopilot.model_copy(update={"obstacle_distance": True})
    finding = judge_parameter("CP_DIST", value, config.model_copy(update={"autopilot": sending}))
    assert (finding.about, finding.level) == ("CP_DIST", level)


def test_a_fence_with_corners_reaches_as_far_as_the_farthest_inside_the_circle() -> None:
    gate = GateParameters(fence_radius_m=None, fence_corners_m=((30.0, 40.0), (0.0, 10.0), (-10.0, 0.0)))
    config = _config(14540).model_copy(update={"safety": SafetyParameters(gate=gate)})
    assert "50 m" in judge_parameter("GF_MAX_HOR_DIST", 49.0, config).measured
    free = SafetyParameters(gate=GateParameters(fence_radius_m=None))
    endless = judge_parameter("GF_MAX_HOR_DIST", 0.0, config.model_copy(update={"safety": free}))
    assert endless.fix == "set GF_MAX_HOR_DIST to where it must never fly"


def test_other_firmware() -> None:
    assert judge_firmware(Firmware("PX4", "1.16.0")).level is Level.PASS
    assert judge_firmware(Firmware("PX4", "1.13.3")).level is Level.WARNING
    assert judge_firmware(Firmware("autopilot 3", "4.5.7")).level is Level.FAILURE


def test_an_autopilot_that_is_heard_and_never_responds_may_accept_signed_messages_only() -> None:
    assert judge_signing(True, silent=False).level is Level.PASS
    deaf = judge_signing(False, silent=False)
    assert deaf.level is Level.FAILURE
    assert "signed messages only" in deaf.measured
    assert "signing key" in deaf.fix
    assert judge_signing(False, silent=True).level is Level.WARNING, "a link that was cut says nothing of keys"


def test_unknown_values_in_messages_are_a_warning() -> None:
    assert judge_messages({}) == []
    (finding,) = judge_messages({"EXTENDED_SYS_STATE.landed_state = 5": 3})
    assert (finding.level, finding.about) == (Level.WARNING, "messages")
    assert "EXTENDED_SYS_STATE.landed_state = 5 (3 times)" in finding.measured


AT_30_HZ = {25: tuple(k / 30.0 for k in range(46))}
GOOD_RANGE = RangeReading(1.5, 0.12, min_m=0.15, max_m=20.0, quality=1.0)


def _by_height(height: HeightSource) -> DroneConfig:
    drone = load_drone(data_path("config") / "quadrotor.yaml")
    return drone.model_copy(update={"perception": drone.perception.model_copy(update={"height": height})})


def test_one_that_faces_down_passes_and_its_limits_and_rate_are_told() -> None:
    (found,) = judge_range_finder(GOOD_RANGE, AT_30_HZ, _by_height("best"))
    assert found.level is Level.PASS
    assert found.measured == "faces down, 0.12 m now, measures from 0.15 to 20.0 m, 30 times a second"


@pytest.mark.parametrize(("height", "level"), [("range_finder", Level.FAILURE), ("best", Level.WARNING)])
def test_none_is_a_failure_where_nothing_else_gives_the_scale(height: HeightSource, level: Level) -> None:
    (absent,) = judge_range_finder(None, {}, _by_height(height))
    (forward,) = judge_range_finder(None, {0: (1.0,)}, _by_height(height))
    assert absent.level is forward.level is level
    assert "those that are heard face forward" in forward.measured


def test_a_drone_that_flies_by_its_barometer_is_not_asked() -> None:
    assert judge_range_finder(None, {}, _by_height("barometer")) == []


@pytest.mark.parametrize(
    ("reading", "arrivals", "why"),
    [
        (RangeReading(1.5, 1.0, min_m=0.15, max_m=8.0), AT_30_HZ, "the drone may fly at 10 m"),
        (RangeReading(1.5, 1.0, min_m=0.8, max_m=20.0), AT_30_HZ, "measures from 0.80"),
        (GOOD_RANGE, {25: (0.0, 0.2, 0.4)}, "5 times a second"),
        (RangeReading(1.5, 1.0, vertical=True), {}, "PX4's own distance to bottom"),
    ],
)
def test_what_limits_it_is_a_warning(reading: RangeReading, arrivals: dict[int, tuple[float, ...]], why: str) -> None:
    (found,) = judge_range_finder(reading, arrivals, _by_height("best"))
    assert found.level is Level.WARNING
    assert why in found.measured
