"""The mode that PX4 itself ends in after faults, beside what its parameters promise; `pytest -rP` prints it.

Each fault has a PX4 of its own, which hovers or flies in offboard at setpoints that flockd's autopilot link sends, from
a process of its own. What PX4 makes of a killed `flockd run` is what it makes of that process.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from flockd.core.errors import UnavailableError
from flockd.sim.sitl.autopilots import Ports, Px4s
from flockd.sim.sitl.processes import Program, Programs
from tests.sitl.companion import HEIGHT_M
from tests.sitl.sitl_run import PX4, Meddler, SitlRun, one_drone

SHELL_PORT = 14580
"""Port of this computer, where PX4's instance 0 listens to its companion computer."""
START_S = 120.0
"""Seconds for PX4 and for the link to come up."""
REQUEST_S, SETTLE_S, WATCH_S, STAY_S = 60.0, 5.0, 30.0, 3.0
"""Seconds: for each step of the take-off; of offboard flight before the fault; in which PX4 has to reach its
mode; and for which it has to stay in it."""
POLL_S = 0.05
STICK = 700
"""How far a pilot pushes the stick, of 1000, within 0.3 s."""


@dataclass(frozen=True)
class Fault:
    """One fault, and what PX4 has to make of it."""

    name: str
    promised: str
    """A mode by pymavlink's name; MAVLink shows PX4's Descend, a landing without a position, as LAND too."""
    because: str
    """The parameters that promise it, or PX4's rule."""
    inject: Callable[[Px4Flight], None]
    parameters: Mapping[str, str] = field(default_factory=dict)
    north_m_s: float = 0.0
    """The commanded velocity."""


def _shell(*command: str) -> Callable[[Px4Flight], None]:
    return lambda flight: flight.shell(*command)


FAULTS = (
    Fault(
        "gps_off", "LAND", "no position: neither Hold nor Return can run, so Descend",
        _shell("failure", "gps", "off"), {"SYS_FAILURE_EN": "1"},
    ),
    Fault(
        "estimator_lost", "LAND", "no position and no height: Descend, which needs neither",
        lambda flight: flight.lose_estimates(), {"SYS_FAILURE_EN": "1"},
    ),
    Fault(
        "battery_low", "RTL", "COM_LOW_BAT_ACT 3: Return when critical, Land when at its end",
        _shell("param", "set", "SIM_BAT_MIN_PCT", "6"), {"COM_LOW_BAT_ACT": "3", "SIM_BAT_DRAIN": "10"},
    ),
    Fault(
        "battery_low_warned", "OFFBOARD", "COM_LOW_BAT_ACT 0: a warning only",
        _shell("param", "set", "SIM_BAT_MIN_PCT", "6"), {"COM_LOW_BAT_ACT": "0", "SIM_BAT_DRAIN": "10"},
    ),
    Fault(
        "rc_override", "POSCTL", "MAN_OVERRIDE_SPD 1: sticks moved fast take over (before PX4 1.18 COM_RC_OVERRIDE 3)",
        lambda flight: flight.move_sticks(), {"MAN_OVERRIDE_SPD": "1", "COM_RC_IN_MODE": "1"},
    ),
    Fault(
        "geofence", "LOITER", "GF_ACTION 2: Hold outside GF_MAX_HOR_DIST",
        lambda flight: None, {"GF_ACTION": "2", "GF_MAX_HOR_DIST": "15"}, north_m_s=1.5,
    ),
    Fault(
        "geofence_return", "RTL", "GF_ACTION 3: Return outside GF_MAX_HOR_DIST",
        lambda flight: None, {"GF_ACTION": "3", "GF_MAX_HOR_DIST": "15"}, north_m_s=1.5,
    ),
    Fault("sender_killed", "LOITER", "COM_OBL_RC_ACT 5: Hold", lambda flight: flight.kill_companion()),
    Fault(
        "sender_killed_land", "LAND", "COM_OBL_RC_ACT 4: Land",
        lambda flight: flight.kill_companion(), {"COM_OBL_RC_ACT": "4"},
    ),
    Fault(
        "sender_killed_return", "RTL", "COM_OBL_RC_ACT 3: Return",
        lambda flight: flight.kill_companion(), {"COM_OBL_RC_ACT": "3"},
    ),
    Fault(
        "link_lost", "LOITER", "COM_OBL_RC_ACT 5: Hold",
        _shell("mavlink", "stop", "-u", str(SHELL_PORT)),
    ),
    Fault("wind", "OFFBOARD", "8 m/s are within what a multirotor holds", _shell("param", "set", "SIH_WIND_N", "8")),
)  # fmt: skip


class Px4Flight(SitlRun):
    """One PX4 in offboard flight."""

    def __init__(self, fault: Fault) -> None:
        super().__init__()
        self._fault, self._sticks = fault, False

    def _come_up(self) -> None:
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="px4-modes-")))
        px4s = Px4s(one_drone(HEIGHT_M), 1.0, os.environ, folder, self._fault.parameters)
        self._px4 = self._stack.enter_context(px4s)
        self._px4.start()
        port = self._px4.ports[0]
        self.station = self._stack.enter_context(Meddler([port.truth], time.monotonic))
        self._until(lambda: self.station.is_connected(0), START_S, "PX4 sends nothing")
        self.station.request_messages()
        self._companion = self._start_sender(port, folder)
        station = self.station
        self._request(lambda: station.is_armed(0), lambda: station.arm(0), "was not armed")
        self._request(self._is_up, self._climb, "did not climb")
        self._request(
            lambda: station.mode(0) == "OFFBOARD", lambda: station.select(0, "OFFBOARD"), "did not go into offboard"
        )

    def _start_sender(self, port: Ports, folder: Path) -> Program:
        """A process that sends setpoints."""
        companions = self._stack.enter_context(Programs())
        options = [*map(str, (port.offboard, self._fault.north_m_s))]
        log = folder / "companion.log"
        command = [sys.executable, "-m", "tests.sitl.companion", *options]
        companion = companions.start("companion", command, os.environ, Path(__file__).parents[2], log)
        self._until(lambda: "streaming" in log.read_text(), START_S, "no setpoints")
        return companion

    def trial(self) -> tuple[str, float]:
        """Injects the fault and watches what comes.

        Returns the last mode, and how far the true velocity was off the commanded one in the last seconds of offboard
        flight, mean, m/s. Prints all modes since the fault, and after how many seconds the last one came.
        """
        fault, began_s = self._fault, time.monotonic()
        if not fault.north_m_s:
            self.wait(SETTLE_S)
        injected_s = time.monotonic()
        modes, since_s, drifts = [self.mode], None, []
        fault.inject(self)
        while (now := time.monotonic()) < injected_s + WATCH_S:
            self.wait(POLL_S)
            if self.mode != modes[-1]:
                modes.append(self.mode)
                since_s = now
            if self.mode == "OFFBOARD":
                velocity = self.station.poses().velocity[0, :2] - (fault.north_m_s, 0.0)
                drifts.append((now, float(np.linalg.norm(velocity))))
            if since_s is not None and self.mode == fault.promised and now - since_s > STAY_S:
                break
        last = [drift for time_s, drift in drifts if time_s > drifts[-1][0] - SETTLE_S]
        after_s = 0.0 if since_s is None else since_s - (began_s if fault.north_m_s else injected_s)
        print(f"{fault.name}: {' > '.join(modes)} after {after_s:.2f} s; {fault.because}")  # noqa: T201
        return modes[-1], float(np.mean(last)) if last else 0.0

    @property
    def mode(self) -> str:
        """PX4's, now."""
        return self.station.mode(0)

    def lose_estimates(self) -> None:
        """The estimator has neither position nor height any more. Stopping EKF2 would stop PX4's simulated time."""
        for sensor in ("gps", "baro"):
            self.shell("failure", sensor, "off")

    def kill_companion(self) -> None:
        """The process that sends the setpoints is gone at once."""
        os.killpg(self._companion.process.pid, signal.SIGKILL)

    def move_sticks(self) -> None:
        """A pilot's joystick: in the middle for two seconds, then pushed forward and kept there from now on."""
        for forward in (*[0] * 40, *range(0, STICK, STICK // 10)):
            self.station.push_sticks(0, forward=forward)
            time.sleep(0.05 if forward == 0 else 0.03)
        self._sticks = True

    def wait(self, seconds: float) -> None:
        """Lets time pass."""
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            if self._sticks:
                self.station.push_sticks(0, forward=STICK)
            time.sleep(min(POLL_S, seconds))
        ended = [program for program in self._px4.programs() if program.ended is not None]
        if ended:
            raise UnavailableError(f"PX4 ended with exit code {ended[0].ended} ({ended[0].last_output()})")

    def _is_up(self) -> bool:
        poses = self.station.poses()
        level = abs(float(poses.velocity[0, 2])) < 0.1
        return level and -poses.position[0, 2] > 0.7 * HEIGHT_M and self.station.mode_is(0, "LOITER")

    def _climb(self) -> None:
        if -self.station.poses().position[0, 2] < 0.5:
            self.station.select(0, "TAKEOFF")

    def _request(self, done: Callable[[], bool], request: Callable[[], None], otherwise: str) -> None:
        def again() -> bool:
            if done():
                return True
            request()
            self.wait(1.0)
            return done()

        self._until(again, REQUEST_S, f"the drone {otherwise} ({self.station.last_text(0)})")

    def _until(self, done: Callable[[], bool], timeout_s: float, otherwise: str) -> None:
        until_s = time.monotonic() + timeout_s
        while not done():
            if time.monotonic() > until_s:
                raise UnavailableError(f"{otherwise} within {timeout_s:g} s")
            self.wait(POLL_S)


@pytest.mark.fault("link-lost")
@pytest.mark.fault("pilot-takes-over")
@pytest.mark.fault("battery-or-estimate")
@pytest.mark.fault("fence-left")
@pytest.mark.fault("out-of-memory")
@PX4
@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_px4_ends_in_the_mode_that_its_parameters_promise(fault: Fault) -> None:
    with Px4Flight(fault) as flight:
        ended_in, drift_m_s = flight.trial()
    assert ended_in == fault.promised
    if fault.name == "wind":
        assert drift_m_s < 0.5
