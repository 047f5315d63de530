"""What is asked of the autopilot over real MAVLink, a fake, not PX4, and what is made of its replies."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from flockd.core.choices import HeightSource
from flockd.core.config import DroneConfig, load_drone
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.data import data_path
from flockd.core.errors import UnavailableError
from flockd.core.messages import RangeReading
from flockd.ground.doctor import Finding, Level
from flockd.ground.doctor.autopilot_checks import (
    check_autopilot,
    judge_clock,
    judge_firmware,
    judge_parameter,
    judge_range_finder,
)
from flockd.onboard.autopilot.autopilot_status import Firmware
from flockd.onboard.autopilot.clock_sync import ClockEstimate
from flockd.sim.autopilot.fake_autopilot import FakeAutopilot
from flockd.sim.autopilot.fake_range_finder import FakeRangeFinder, level_ground
from flockd.sim.scenario import RangeFinderConfig
from flockd.sim.sitl.processes import free_port
from tests import make
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


def _config(port: int, system_id: int | None = None) -> DroneConfig:
    quadrotor = load_drone(data_path("config") / "quadrotor.yaml")
    autopilot = AutopilotParameters(address=f"udpin://127.0.0.1:{port}", system_id=system_id)
    return make.changed(quadrotor, autopilot=autopilot)


def _examined(port: int) -> list[Finding]:
    return list(check_autopilot(_config(port), 60.0))


def _soon_examined(port: int) -> list[Finding]:
    """Without waiting for other systems, nor for ranges."""
    return list(check_autopilot(make.changed(_config(port, 1), perception__height="barometer"), 60.0))


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
        found = {finding.about: finding for finding in _examined(port)}
        assert (fake_autopilot.armed, fake_autopilot.mode) == (False, "LOITER")
        assert not fake_autopilot.setpoints
        assert fake_autopilot.refused_setpoints == 0
        assert fake_autopilot.parameters == {**fake_autopilot.parameters, **GOOD}
    assert set(fake_autopilot.asked) <= QUESTIONS, "it listens and asks, and commands nothing"
    assert found.keys() == {"heartbeat", "system id", "firmware", "arming", "clock", "range finder", *GOOD}
    del found["clock"]  # how even it is depends on how busy this computer is
    assert {about for about, finding in found.items() if finding.level is not Level.PASS} == {"firmware", "system id"}


def test_what_is_wrong_with_one_is_told_in_the_order_in_which_it_was_asked() -> None:
    """It cannot be armed, lacks a parameter, and then falls silent under examination."""
    port = free_port()
    with _Noting(port, heartbeat_s=HEARTBEAT_S) as fake_autopilot:
        fake_autopilot.parameters.update({**GOOD, "COM_OF_LOSS_T": 2.5})
        del fake_autopilot.parameters["GF_ACTION"]
        fake_autopilot.failing = {"check_gyro_not_calibrated"}
        found = {finding.about: finding for finding in _soon_examined(port)}
        assert {about for about, one in found.items() if one.level is Level.FAILURE} == {"GF_ACTION", "arming"}
        assert "calibrate" in found["arming"].fix
        assert found["COM_OF_LOSS_T"].fix == "set COM_OF_LOSS_T to 1 s"
        fake_autopilot.cut_at = "COM_OBL_RC_ACT"
        cut = _soon_examined(port)
    assert [finding.about for finding in cut] == [
        "heartbeat", "firmware", "COM_OF_LOSS_T", "COM_OBL_RC_ACT", "heartbeat"
    ]  # fmt: skip
    assert [finding.level for finding in cut[-2:]] == [Level.FAILURE, Level.FAILURE]


def test_two_autopilots_of_one_id_are_a_failure() -> None:
    port = free_port()
    with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S):
        time.sleep(0.3)
        with FakeAutopilot(port, heartbeat_s=HEARTBEAT_S):
            found = [finding for finding in _soon_examined(port) if finding.about == "system id"]
    assert [(finding.level, finding.measured) for finding in found] == [
        (Level.FAILURE, f"autopilot.system_id: two autopilots of system 1 are heard at udpin://127.0.0.1:{port}")
    ]


def test_two_autopilots_are_refused_and_so_is_none() -> None:
    port = free_port()
    with (
        FakeAutopilot(port, heartbeat_s=HEARTBEAT_S),
        FakeAutopilot(port, system_id=7),
        pytest.raises(UnavailableError, match=r"autopilot\.system_id: .* of systems 1, 7 .*; write the MAV_SYS_ID"),
    ):
        _examined(port)
    with pytest.raises(UnavailableError, match=r"no autopilot was heard at .*; check autopilot\.address"):
        list(check_autopilot(_config(free_port()), 0.3))
    (finding,) = check_autopilot(load_drone(data_path("config") / "simulator.yaml"))
    assert (finding.level, finding.about) == (Level.WARNING, "autopilot")


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


def test_a_fence_with_corners_reaches_as_far_as_the_farthest_inside_the_circle() -> None:
    free = make.changed(_config(14540), safety__gate__fence_radius_m=None)
    corners = make.changed(free, safety__gate__fence_corners_m=((30.0, 40.0), (0.0, 10.0), (-10.0, 0.0)))
    assert "50 m" in judge_parameter("GF_MAX_HOR_DIST", 49.0, corners).measured
    endless = judge_parameter("GF_MAX_HOR_DIST", 0.0, free)
    assert "set GF_MAX_HOR_DIST" in endless.fix


AT_30_HZ = tuple(k / 30.0 for k in range(46))
GOOD_RANGE = RangeReading(1.5, 0.12, min_m=0.15, max_m=20.0, quality=1.0)


def _ranges(reading: RangeReading | None, arrivals: tuple[float, ...] = (), height: HeightSource = "best") -> Finding:
    return judge_range_finder(reading, arrivals, make.changed(_config(14540), perception__height=height))


@pytest.mark.parametrize(
    ("judged", "level"),
    [
        (lambda: judge_clock(ClockEstimate(47_000.0, -46_765.25, 0.0004, 0.003, 0.003)), Level.PASS),
        (lambda: judge_clock(ClockEstimate(47_000.0, -46_765.25, 0.02, 0.003, 0.003)), Level.WARNING),
        (lambda: judge_clock(None), Level.WARNING),
        (lambda: judge_firmware(Firmware("PX4", "1.16.0")), Level.PASS),
        (lambda: judge_firmware(Firmware("PX4", "1.13.3")), Level.WARNING),
        (lambda: judge_firmware(Firmware("autopilot 3", "4.5.7")), Level.FAILURE),
        (lambda: _ranges(GOOD_RANGE, AT_30_HZ), Level.PASS),
        (lambda: _ranges(None, height="range_finder"), Level.FAILURE),  # nothing else gives the scale
        (lambda: _ranges(None), Level.WARNING),
        (lambda: _ranges(RangeReading(1.5, 1.0, min_m=0.15, max_m=8.0), AT_30_HZ), Level.WARNING),  # it may fly at 10 m
        (lambda: _ranges(RangeReading(1.5, 1.0, min_m=0.8, max_m=20.0), AT_30_HZ), Level.WARNING),
        (lambda: _ranges(GOOD_RANGE, (0.0, 0.2, 0.4)), Level.WARNING),  # five a second
    ],
)
def test_what_is_made_of_what_was_heard(judged: Callable[[], Finding], level: Level) -> None:
    finding = judged()
    assert finding.level is level
    assert bool(finding.fix) == (level is not Level.PASS)
