"""A fake autopilot for tests, and for the simulator where there is no PX4. It is not PX4 and flies nothing real.

It speaks MAVLink over UDP and follows PX4's rules where flockd depends on them: when offboard may be entered, when it
is lost and which failsafe follows, that PX4 returns to offboard when setpoints come back, and that a heartbeat comes
once a second. It does not simulate what else PX4 does: climbing before a return, position control in Hold, estimators.
"""

from __future__ import annotations

import math
import os
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
from pymavlink.dialects.v20 import development as mavlink

from flockd.core.messages import FloatArray
from flockd.onboard.autopilot.refusal_reasons import CHECKS_FAIL, NO_SETPOINTS
from flockd.sim.autopilot.fake_checks import FakeChecks
from flockd.sim.autopilot.fake_range_finder import FakeRangeFinder
from flockd.sim.autopilot.fake_telemetry import (
    ON_GROUND_M,
    Mode,
    TelemetryStreams,
    custom_mode,
    mode_by_number,
)
from flockd.sim.autopilot.fake_vehicle import (
    Asked,
    Demand,
    Flown,
    Motion,
    MotionState,
    StickOverride,
    stick_curve,
)  # fmt: skip
from flockd.sim.scenario import SensorConfig
from flockd.sim.vehicles.vehicles import EstimateErrors

TICK_S = 0.02
MAX_STEP_S = 0.2
"""Over a longer pause of this computer the vehicle is taken to have stood still."""
TYPE_MASK = 2503
"""Type mask of the only setpoint that it accepts: velocity and yaw."""
DISARM_AFTER_LANDING_S = 2.0
ARRIVED_M = 0.3
STICKS_FRESH_S = 0.5
OFFBOARD_LOSS_MODES: dict[int, Mode] = {0: "RTL", 3: "RTL", 4: "LAND", 5: "LOITER"}
"""By COM_OBL_RC_ACT. 0, position mode, needs a remote control, which the fake has not."""
NOT_ARMED_IN: dict[Mode, str] = {"LAND": "check_modes_cannot_takeoff", "ACRO": "check_modes_manual_control"}
"""The checks that refuse to arm in a mode."""
HOME_DEG = (47.3977, 8.5456)
MAX_SETPOINTS_KEPT = 100_000
SO_TIMESTAMPNS = 35
"""Linux's socket option: the kernel says when each packet came, however long this thread waited for a turn."""


class FakeAutopilot:
    """One vehicle that sends to `udpin://127.0.0.1:<port>`, on its own thread between `start` and `close`.

    It begins on the ground, or armed and in Hold at `height_m`. With a `motion` of the caller's, that decides where it
    begins. In flight its estimate drifts, and it follows setpoints by it. What a test or a pilot does to it
    (`pilot_selects`, the attributes) takes effect within a tick.
    """

    def __init__(
        self,
        port: int,
        *,
        system_id: int = 1,
        height_m: float = 0.0,
        yaw_rad: float = 0.0,
        motion: Motion | None = None,
        heartbeat_s: float = 1.0,
        home_deg: tuple[float, float] = HOME_DEG,
        truth_port: int | None = None,
        speed_factor: float = 1.0,
        range_finder: FakeRangeFinder | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Binds a socket; nothing is sent before `start`.

        Args:
            port: of this computer, where a companion computer listens.
            system_id: its MAV_SYS_ID.
            height_m: in Hold at this height; 0: on the ground.
            yaw_rad: heading, radians clockwise from north.
            motion: moves the vehicle, in metres from its home; None: a `Flown` that stays level.
            heartbeat_s: between two; a second is PX4's.
            home_deg: latitude and longitude of where it begins.
            truth_port: where a simulator listens: it gets the true pose, as PX4 in software
                sends it, and may send commands, as a ground station may.
            speed_factor: how fast its time passes.
            range_finder: its own, which faces down; None: it has none.
            clock: monotonic seconds, in the place of the computer's.
        """
        self._speed_factor, self._real = speed_factor, clock
        self.battery_share, self.estimate_ok = 1.0, True
        self.sends_motion = True
        """False: it no longer sends its position and velocity, but everything else."""
        self.frame_off, self.heading_off_rad = np.zeros(3), 0.0
        """How far its positions (3,) in NED and its heading deviate from the truth, in metres and clockwise."""
        self.drifts, self.drift = True, EstimateErrors(SensorConfig(), seed=system_id, drone=0)
        # Whether its estimate drifts in flight, and how far it deviates from the truth: at first not at all.
        self.drift.velocity, self.drift.position = np.zeros(3), np.zeros(2)
        self.failing: set[str] = set()
        """PX4's names of further checks that fail; each refuses to arm."""
        self.silent, self.board = False, list(os.urandom(18))
        """`silent`, True: as if the cable were cut, in both directions; `board`: the serial number of its processor."""
        self.parameters: dict[str, float | int] = {
            "COM_OF_LOSS_T": 1.0,
            "COM_OBL_RC_ACT": 5,
            "COM_LOW_BAT_ACT": 0,
            "NAV_DLL_ACT": 0,
            "GF_ACTION": 2,
            "GF_MAX_HOR_DIST": 0.0,
            "GF_MAX_VER_DIST": 0.0,
            "MIS_TAKEOFF_ALT": 2.5,
            "MPC_VEL_MANUAL": 10.0,
            "MAN_DEADZONE": 0.1,
            "MAN_OVERRIDE_SPD": 1.0,
            "CP_DIST": -1.0,
            "MPC_XY_VEL_MAX": 12.0,
        }
        """An int is an INT32 parameter, a float a REAL32 one."""
        self.setpoints: deque[tuple[float, Asked]] = deque(maxlen=MAX_SETPOINTS_KEPT)
        """When each came by the kernel's stamp, on ``clock`` times the speed factor, and what it said."""
        self.refused_setpoints = 0

        self._link = ("127.0.0.1", port)
        self._ground = None if truth_port is None else ("127.0.0.1", truth_port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._mav = mavlink.MAVLink(self, srcSystem=system_id, srcComponent=1)
        self._mav.robust_parsing = True
        self.checks = FakeChecks(self._mav)
        truth = mavlink.MAVLink(SimpleNamespace(write=self._tell_simulator), srcSystem=system_id, srcComponent=1)
        self._motion = motion or Flown(np.array([0.0, 0.0, -height_m]), yaw_rad)
        self.state: MotionState = self._motion(Demand(np.zeros(2), -height_m, yaw_rad), 0.0)
        """The truth."""
        self.armed = height_m > 0.0
        """Motors on."""
        self.intended_mode: Mode = "LOITER"
        """The one that it was asked for."""
        self.mode: Mode = "LOITER"
        """The mode it really flies, which is not the one it was asked for while its failsafe is active."""
        self._hold_down_m, self._hold_yaw_rad = -height_m, yaw_rad
        self._landed_s: float | None = None
        self._sticks = -math.inf, np.zeros(2)
        """When a person last moved them, and forward and right from -1 to 1."""
        self._override = StickOverride()
        self.clock_offset_s = -self._clock()
        """Its own clock, of its stamps and of TIMESYNC, less ``clock`` times the speed factor."""

        self._new_streams = partial(
            TelemetryStreams,
            self,
            self._mav,
            truth,
            heartbeat_s=heartbeat_s,
            home_deg=home_deg,
            range_finder=range_finder,
        )
        self.streams = self._new_streams(started_s=-self.clock_offset_s)
        self._heard_s = -math.inf
        """When the last waiting packet had been taken: a packet that is taken later came later, whatever the wall clock
        says."""
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fake autopilot", daemon=True)

    def start(self) -> Self:
        """Starts the thread."""
        self._thread.start()
        return self

    def close(self) -> None:
        """Ends the thread and closes the socket."""
        self._closing.set()
        self._thread.join()
        self._socket.close()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def failsafe(self) -> bool:
        """Whether its failsafe flies another mode than the one it was asked for."""
        return self.mode != self.intended_mode

    @property
    def has_ground_station(self) -> bool:
        """Whether it hears a ground station on its link; then it sends its texts there."""
        return self.checks.has_ground_station(self._clock())

    def pilot_arms(self) -> None:
        """Arms, as its pilot does with the sticks; without effect where a check fails."""
        with self._lock:
            self._arm()

    def pilot_selects(self, mode: Mode) -> None:
        """Changes the mode, as its pilot does with the switch."""
        with self._lock:
            self.intended_mode = mode
            self._update_mode()

    def restart(self) -> None:
        """Restarts it on the ground: its clock, its events and its streams begin anew."""
        with self._lock:
            self._disarm()
            self.clock_offset_s = -self._clock()
            self.checks = FakeChecks(self._mav)
            self.streams = self._new_streams(started_s=-self.clock_offset_s)

    def send_from_elsewhere(self, data: bytes) -> None:
        """Gives it a packet as if another program had sent it on another link."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(data, self._socket.getsockname())

    def write(self, data: bytes) -> None:
        """Sends a packet of pymavlink to the companion computer and the simulator."""
        if self.silent:
            return
        self._socket.sendto(data, self._link)
        self._tell_simulator(data)

    def _tell_simulator(self, data: bytes) -> None:
        if self._ground is not None:
            self._socket.sendto(data, self._ground)

    def _clock(self) -> float:
        return self._speed_factor * self._real()

    def _run(self) -> None:
        flown_s = self._clock()
        while not self._closing.is_set():
            self._receive_until(flown_s + TICK_S)
            with self._lock:
                now = self._clock()
                self._fly(min(now - flown_s, MAX_STEP_S))
                self.streams.send_due(now)
                self.checks.tell_changes(self._failing())
                self.checks.announce(now)
            flown_s = now

    def _receive_until(self, deadline: float) -> None:
        """Receives all that comes by then; if it is late already, all that waits."""
        while True:
            asked_s = self._clock()
            self._socket.settimeout(max(deadline - asked_s, 0.0) / self._speed_factor)
            try:
                data, ancillary, _, sender = self._socket.recvmsg(4096, 64)
            except (TimeoutError, BlockingIOError):
                self._heard_s = asked_s
                return
            if self.silent:
                continue
            arrived_s = max(self._clock() - self._speed_factor * _age(ancillary), self._heard_s)
            with self._lock:
                for message in self._mav.parse_buffer(data) or ():
                    self._handle(message, arrived_s, on_link=sender == self._link)

    # Rules

    def _signal(self) -> bool:
        """Whether setpoints are coming, by PX4's measure."""
        if not self.setpoints or not self.estimate_ok:
            return False
        return self._clock() - self.setpoints[-1][0] < self.parameters["COM_OF_LOSS_T"]

    def _update_mode(self) -> None:
        """The intended mode, or what PX4's failsafe puts in its place while offboard cannot run."""
        lost = self.armed and self.intended_mode == "OFFBOARD" and not self._signal()
        mode = OFFBOARD_LOSS_MODES[int(self.parameters["COM_OBL_RC_ACT"])] if lost else self.intended_mode
        if mode == self.mode:
            return
        if lost:
            self.checks.say("Failsafe activated", self._clock())
        self.mode = mode
        self._hold_down_m = float(self.state.position[2])
        R = self.state.R_ned_body
        self._hold_yaw_rad = math.atan2(R[1, 0], R[0, 0])

    def _select(self, mode: Mode, component: int) -> bool:
        """A mode requested over MAVLink: while armed, only one that can run. It tells ground stations alone of that."""
        if self.armed and (mode == "ACRO" or (mode == "OFFBOARD" and not self._signal())):
            if component == mavlink.MAV_COMP_ID_MISSIONPLANNER:
                self.checks.say(f"Switching to {mode.title()} is currently not available", self._clock())
                self.checks.deny("commander_modeswitch_not_avail", custom_mode(mode))
            return False
        self.pilot_selects(mode)
        return True

    def _arm(self) -> bool:
        if self.intended_mode == "OFFBOARD" and not self._signal():
            self.checks.say("Arming denied: no offboard signal", self._clock())
            return False
        if self._failing() - {NO_SETPOINTS}:
            self.checks.say("Arming denied: Resolve system health failures first", self._clock())
            self.checks.deny(CHECKS_FAIL)
            return False
        self.armed, self._landed_s = True, None
        return True

    def _failing(self) -> set[str]:
        """The checks that fail now."""
        missing = set() if self._signal() else {NO_SETPOINTS}
        if not self.armed:
            missing |= {NOT_ARMED_IN[self.intended_mode]} if self.intended_mode in NOT_ARMED_IN else set()
        return missing | self.failing | (set() if self.estimate_ok else {"check_estimator_hor_pos_not_stable"})

    def _disarm(self) -> None:
        self.armed = False
        self.intended_mode = self.mode = "LOITER"

    # Flight

    def _fly(self, interval_s: float) -> None:
        self._update_mode()
        if not self.armed:
            return
        if self.drifts:
            self.drift.advance(self._clock())
        demand = self._demand()
        self.state = self._motion(replace(demand, velocity=demand.velocity - self.drift.velocity[:2]), interval_s)
        height_m = -float(self.state.position[2])
        risen = height_m > self.parameters["MIS_TAKEOFF_ALT"] - 0.1
        if self.mode == "TAKEOFF" and risen:
            self.pilot_selects("LOITER")
        elif self.mode == "RTL" and float(np.linalg.norm(self.state.position[:2])) < ARRIVED_M:
            self.pilot_selects("LAND")
        elif self.mode == "LAND" and height_m < ON_GROUND_M:
            self._landed_s = self._landed_s or self._clock()
            if self._clock() - self._landed_s > DISARM_AFTER_LANDING_S:
                self._disarm()

    def _demand(self) -> Demand:
        match self.mode:
            case "OFFBOARD" if self.setpoints:
                return self.followed()
            case "POSCTL":
                return Demand(self._by_hand(), self._hold_down_m, self._hold_yaw_rad)
            case "TAKEOFF":
                return Demand(np.zeros(2), -self.parameters["MIS_TAKEOFF_ALT"], self._hold_yaw_rad)
            case "LAND":
                return Demand(np.zeros(2), 0.5, self._hold_yaw_rad)
            case "RTL":
                home = -self.state.position[:2]
                return Demand(
                    home * min(1.0, 3.0 / max(float(np.linalg.norm(home)), 1e-9)), self._hold_down_m, self._hold_yaw_rad
                )
            case _:
                return Demand(np.zeros(2), self._hold_down_m, self._hold_yaw_rad)

    def followed(self) -> Demand:
        """The demand of the newest setpoint, at MPC_XY_VEL_MAX at most."""
        asked = self.setpoints[-1][1]
        speed_m_s, most_m_s = float(np.linalg.norm(asked.velocity)), self.parameters["MPC_XY_VEL_MAX"]
        down_m = float(self.state.position[2]) + asked.sink_m_s  # the vehicle flies a metre that is missing at 1 m/s
        return Demand(asked.velocity * (most_m_s / max(speed_m_s, most_m_s)), down_m, asked.yaw_rad)

    def _by_hand(self) -> FloatArray:
        """(2,) m/s north and east that the sticks ask for; level, and at rest once they are not heard any more."""
        moved_s, sticks = self._sticks
        wanted = self.parameters["MPC_VEL_MANUAL"] * stick_curve(sticks, self.parameters["MAN_DEADZONE"])
        if self._clock() - moved_s > STICKS_FRESH_S:
            return np.zeros(2)
        ahead, right = wanted
        cos, sin = math.cos(self._hold_yaw_rad), math.sin(self._hold_yaw_rad)
        return np.array([cos * ahead - sin * right, sin * ahead + cos * right])

    def _feel(self, moved_s: float, sticks: FloatArray) -> None:
        """Sticks that move fast take over from every mode but Position, and not from a failsafe, for which PX4 needs
        more."""
        self._sticks = moved_s, sticks
        fast = self._override.moved(moved_s, sticks, self.parameters["MAN_OVERRIDE_SPD"])
        if fast and self.armed and not self.failsafe and self.mode not in {"POSCTL", "ACRO"}:
            self.checks.say("Pilot took over using sticks", self._clock())
            self.pilot_selects("POSCTL")

    # MAVLink, in

    def _handle(self, message: Any, arrived_s: float, *, on_link: bool) -> None:
        if getattr(message, "target_system", self._mav.srcSystem) != self._mav.srcSystem:
            return
        match message.get_type():
            case "SET_POSITION_TARGET_LOCAL_NED":
                self._take_setpoint(message, arrived_s)
            case "COMMAND_LONG":
                result = self._obey(int(message.command), message)
                self._mav.command_ack_send(
                    message.command,
                    result,
                    target_system=message.get_srcSystem(),
                    target_component=message.get_srcComponent(),
                )
            case "MANUAL_CONTROL" if message.target == self._mav.srcSystem:
                self._feel(arrived_s, np.clip([message.x, message.y], -1000, 1000) / 1000)
            case "STATUSTEXT":  # forwarded, as PX4's links in software do
                self._tell_simulator(bytes(message.get_msgbuf()))
            case "TIMESYNC" if message.tc1 == 0:
                own_ns = int(1e9 * (self._clock() + self.clock_offset_s))
                self._mav.timesync_send(own_ns, message.ts1)
            case "PARAM_REQUEST_READ":
                self._send_parameter(message.param_id)
            case "PARAM_SET":
                self._set_parameter(message.param_id, message.param_value)
            case "HEARTBEAT" if on_link and message.type == mavlink.MAV_TYPE_GCS:
                self.checks.hear_ground_station(self._clock())
            case _:
                pass

    def _take_setpoint(self, message: Any, arrived_s: float) -> None:
        numbers = (message.vx, message.vy, message.vz, message.yaw)
        if message.type_mask != TYPE_MASK or message.coordinate_frame != 1 or not np.isfinite(numbers).all():
            self.refused_setpoints += 1
            return
        asked = Asked(np.array([message.vx, message.vy]), message.vz, message.yaw - self.heading_off_rad)
        self.setpoints.append((arrived_s, asked))

    def _obey(self, command: int, message: Any) -> int:
        done: bool
        match command:
            case mavlink.MAV_CMD_DO_SET_MODE:
                mode = mode_by_number(int(message.param2), int(message.param3))
                if mode is None:
                    return int(mavlink.MAV_RESULT_UNSUPPORTED)
                done = self._select(mode, message.get_srcComponent())
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM if message.param1 == 1:
                done = self._arm()
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                done = int(message.param1) in self.streams.intervals_s
                if done:
                    self.streams.intervals_s[int(message.param1)] = message.param2 * 1e-6
            case mavlink.MAV_CMD_RUN_PREARM_CHECKS:
                self.checks.tell(self._failing())
                done = True
            case mavlink.MAV_CMD_REQUEST_MESSAGE if message.param1 == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
                self.streams.send_version(self.board)
                done = True
            case _:
                return int(mavlink.MAV_RESULT_UNSUPPORTED)
        return int(mavlink.MAV_RESULT_ACCEPTED if done else mavlink.MAV_RESULT_TEMPORARILY_REJECTED)

    def _set_parameter(self, name: str, wire: float) -> None:
        """Takes it from whoever sends it, and tells the new value."""
        value = self.parameters.get(name)
        if value is not None:
            self.parameters[name] = struct.unpack("<i", struct.pack("<f", wire))[0] if isinstance(value, int) else wire
            self._send_parameter(name)

    def _send_parameter(self, name: str) -> None:
        value = self.parameters.get(name)
        if value is None:
            return  # as PX4 does: the asker times out
        kind = mavlink.MAV_PARAM_TYPE_INT32 if isinstance(value, int) else mavlink.MAV_PARAM_TYPE_REAL32
        # PX4 puts an integer's bytes where MAVLink has a float.
        wire = struct.unpack("<f", struct.pack("<i", value))[0] if isinstance(value, int) else value
        index = list(self.parameters).index(name)
        self._mav.param_value_send(name.encode(), wire, kind, len(self.parameters), index)


def _age(ancillary: list[tuple[int, int, bytes]]) -> float:
    """How long ago a packet came by the kernel's stamp, in real seconds."""
    (stamp,) = (data for level, kind, data in ancillary if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS))
    seconds, nanoseconds = struct.unpack("@ll", stamp)
    return time.time() - float(seconds + nanoseconds * 1e-9)
