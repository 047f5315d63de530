"""An autopilot stand-in for tests, and for the simulator where there is no PX4. It is not PX4 and flies nothing real.

It speaks real MAVLink over UDP and keeps PX4's rules where flockd depends on them: who may enter offboard, when it is
lost and what follows, that PX4 returns to offboard by itself when setpoints come back, that the heartbeat comes once a
second only. Where PX4 does more (climbing before a return, position control in Hold, estimators) it does not try.

    python -m flockd.autopilot.stand_in --port 14540 --height 2.5
"""

from __future__ import annotations

import argparse
import math
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import development as mavlink

from flockd.autopilot.earth import metres_a_degree
from flockd.messages import FloatArray, Setpoint

Mode = Literal["POSCTL", "LOITER", "TAKEOFF", "LAND", "RTL", "OFFBOARD"]
"""PX4's modes by the names pymavlink gives them; LOITER is Hold."""

TICK_S = 0.02
MAX_STEP_S = 0.2
"""After a longer pause of this computer the vehicle has stood still."""
DEFAULT_STREAMS_S = {31: 0.1, 32: 0.1, 245: 1.0, 1: 1.0, 24: 1.0, 230: 1.0, 242: 1.0, 436: 2.0}
"""Message number and seconds between two, until somebody asks for another rate."""
TYPE_MASK = 2531
"""The one kind of setpoint it takes: horizontal velocity, height and yaw."""
DISARM_AFTER_LANDING_S = 2.0
TRUTH_S = 0.04
ON_GROUND_M = 0.05
ARRIVED_M = 0.3
ALL_ESTIMATED = 1 | 2 | 4 | 8 | 16 | 32
OFFBOARD_LOSS_MODES: dict[int, Mode] = {0: "RTL", 3: "RTL", 4: "LAND", 5: "LOITER"}
"""By COM_OBL_RC_ACT, no others; 0 would be position mode, which needs a remote control: the stand-in has none."""
HOME_DEG = (47.3977, 8.5456)
MAX_SETPOINTS_KEPT = 100_000
SO_TIMESTAMPNS = 35
"""Of Linux: the kernel says when each packet came, however long this thread waited for a turn."""


@dataclass(frozen=True, eq=False)
class Demand:
    """What the flight mode asks of the vehicle."""

    velocity: FloatArray
    """(2,) m/s, north and east."""
    down_m: float
    """Height to go to and hold: down from the origin."""
    yaw_rad: float


@dataclass(frozen=True, eq=False)
class MotionState:
    """Where the vehicle is, in NED with the ground at 0."""

    position: FloatArray
    """(3,) metres."""
    velocity: FloatArray
    """(3,) m/s."""
    R_ned_body: FloatArray
    """(3, 3)"""


Motion = Callable[[Demand, float], MotionState]
"""Flies on by some seconds towards a demand."""


class PointMass:
    """Answers a demand as a first-order lag of limited acceleration, always level."""

    TIME_CONSTANT_S = 0.25
    MAX_ACCELERATION_M_S2 = 4.0
    MAX_CLIMB_M_S = 3.0

    def __init__(self, position: FloatArray, yaw_rad: float = 0.0) -> None:
        """At rest at `position`, (3,) metres NED."""
        self._position = position.astype(float)
        self._velocity = np.zeros(3)
        self._yaw_rad = yaw_rad

    def __call__(self, demand: Demand, interval_s: float) -> MotionState:
        """Flies on."""
        climb = np.clip(demand.down_m - self._position[2], -self.MAX_CLIMB_M_S, self.MAX_CLIMB_M_S)
        wanted = (np.array([*demand.velocity, climb]) - self._velocity) / self.TIME_CONSTANT_S
        acceleration = wanted * min(1.0, self.MAX_ACCELERATION_M_S2 / max(float(np.linalg.norm(wanted)), 1e-9))
        self._velocity = self._velocity + acceleration * interval_s
        self._position = self._position + self._velocity * interval_s
        if self._position[2] >= 0.0:
            self._position[2], self._velocity[2] = 0.0, min(0.0, self._velocity[2])
        turn = (demand.yaw_rad - self._yaw_rad + math.pi) % (2 * math.pi) - math.pi
        self._yaw_rad += turn * min(1.0, interval_s / self.TIME_CONSTANT_S)
        cos, sin = math.cos(self._yaw_rad), math.sin(self._yaw_rad)
        R_ned_body = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return MotionState(self._position, self._velocity, R_ned_body)


class AutopilotStandIn:
    """One vehicle that sends to `udpin://127.0.0.1:<port>`, on its own thread between `start` and `close`.

    It begins on the ground, or armed and in Hold at `height_m`. With a `motion` of the caller's, that one knows where
    it begins. What a test or a pilot does to it (`pilot_selects`, the attributes) takes effect within a tick.
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
    ) -> None:
        """Bind a socket; nothing is sent before `start`.

        Args:
            port: of this computer, where a companion computer listens.
            system_id: its MAV_SYS_ID.
            height_m: in Hold at this height; 0: on the ground.
            yaw_rad: which way it looks.
            motion: flies it instead of a `PointMass`, in metres from its home.
            heartbeat_s: between two; a second is PX4's.
            home_deg: latitude and longitude of where it begins.
            truth_port: where a simulator listens: it is told the true pose, as PX4 in software tells it, and may
                command, as a ground station may.
            speed_factor: how fast its time passes.
        """
        self._heartbeat_s = heartbeat_s
        self._home_deg = home_deg
        self._speed_factor = speed_factor
        self.battery_share = 1.0
        self.estimate_ok = True
        self.silent = False
        """True: as if the cable were cut, in both directions."""
        self.parameters: dict[str, float | int] = {
            "COM_OF_LOSS_T": 1.0,
            "COM_OBL_RC_ACT": 5,
            "COM_LOW_BAT_ACT": 0,
            "GF_ACTION": 2,
            "GF_MAX_HOR_DIST": 0.0,
            "GF_MAX_VER_DIST": 0.0,
            "MIS_TAKEOFF_ALT": 2.5,
        }
        """An int is an INT32 parameter, a float a REAL32 one."""
        self.setpoints: deque[tuple[float, Setpoint]] = deque(maxlen=MAX_SETPOINTS_KEPT)
        """When each came by the kernel's stamp, on the monotonic clock times the speed factor, and what it said."""
        self.refused_setpoints = 0

        self._link = ("127.0.0.1", port)
        self._ground = None if truth_port is None else ("127.0.0.1", truth_port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._mav = mavlink.MAVLink(self, srcSystem=system_id, srcComponent=1)
        self._mav.robust_parsing = True
        self._truth = mavlink.MAVLink(_Outlet(self._socket, self._ground), srcSystem=system_id, srcComponent=1)
        self._motion = motion or PointMass(np.array([0.0, 0.0, -height_m]), yaw_rad)
        self._state = self._motion(Demand(np.zeros(2), -height_m, yaw_rad), 0.0)
        self._armed = height_m > 0.0
        self._intended: Mode = "LOITER"
        self._mode: Mode = "LOITER"
        self._hold_down_m = -height_m
        self._hold_yaw_rad = yaw_rad
        self._landed_s: float | None = None
        self._streams_s = dict(DEFAULT_STREAMS_S)
        self._due_s: dict[int, float] = {}
        self._told_mode: Mode | None = None
        self._started_s = self._clock()
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="autopilot stand-in", daemon=True)

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def mode(self) -> Mode:
        """The mode it really flies, which is not the one it was asked for while its failsafe is active."""
        return self._mode

    @property
    def armed(self) -> bool:
        """Motors on."""
        return self._armed

    @property
    def failsafe(self) -> bool:
        """It would be in offboard if setpoints came."""
        return self._mode != self._intended

    @property
    def state(self) -> MotionState:
        """The truth."""
        return self._state

    def pilot_arms(self) -> None:
        """The pilot starts the motors."""
        with self._lock:
            self._arm()

    def pilot_selects(self, mode: Mode) -> None:
        """The pilot turns the switch."""
        with self._lock:
            self._intended = mode
            self._update_mode()

    def write(self, data: bytes) -> None:
        """Takes what pymavlink has packed."""
        if self.silent:
            return
        self._socket.sendto(data, self._link)
        if self._ground is not None:
            self._socket.sendto(data, self._ground)

    def _clock(self) -> float:
        return self._speed_factor * time.monotonic()

    def _run(self) -> None:
        flown_s = self._clock()
        while not self._closing.is_set():
            self._receive_until(flown_s + TICK_S)
            with self._lock:
                now = self._clock()
                self._fly(min(now - flown_s, MAX_STEP_S))
                self._send_streams(now)
            flown_s = now

    def _receive_until(self, deadline: float) -> None:
        """All that comes by then; when it is late already, all that waits."""
        while True:
            left_s = max(deadline - self._clock(), 0.0)
            self._socket.settimeout(left_s / self._speed_factor)
            try:
                data, ancillary, _, _ = self._socket.recvmsg(4096, 64)
            except (TimeoutError, BlockingIOError):
                return
            if self.silent:
                continue
            arrived_s = self._clock() - self._speed_factor * _age(ancillary)
            with self._lock:
                for message in self._mav.parse_buffer(data) or ():
                    self._handle(message, arrived_s)

    # Rules

    def _signal(self) -> bool:
        """Whether setpoints are coming, by PX4's measure."""
        if not self.setpoints or not self.estimate_ok:
            return False
        return self._clock() - self.setpoints[-1][0] < self.parameters["COM_OF_LOSS_T"]

    def _update_mode(self) -> None:
        """The intended mode, or what PX4's failsafe puts in its place while offboard cannot run."""
        lost = self._armed and self._intended == "OFFBOARD" and not self._signal()
        mode = OFFBOARD_LOSS_MODES[int(self.parameters["COM_OBL_RC_ACT"])] if lost else self._intended
        if mode == self._mode:
            return
        self._mode = mode
        self._hold_down_m = float(self._state.position[2])
        R = self._state.R_ned_body
        self._hold_yaw_rad = math.atan2(R[1, 0], R[0, 0])

    def _select(self, mode: Mode) -> bool:
        """Asked for by MAVLink: while armed, only what can run."""
        if mode == "OFFBOARD" and self._armed and not self._signal():
            self._say("Offboard not possible: no offboard signal")
            return False
        self.pilot_selects(mode)
        return True

    def _arm(self) -> bool:
        if self._intended == "OFFBOARD" and not self._signal():
            self._say("Arming denied: no offboard signal")
            return False
        if not self.estimate_ok:
            self._say("Arming denied: no valid position estimate")
            return False
        self._armed, self._landed_s = True, None
        return True

    def _disarm(self) -> None:
        self._armed = False
        self._intended = self._mode = "LOITER"

    # Flight

    def _fly(self, interval_s: float) -> None:
        self._update_mode()
        if not self._armed:
            return
        self._state = self._motion(self._demand(), interval_s)
        height_m = -float(self._state.position[2])
        if self._mode == "TAKEOFF" and height_m > self.parameters["MIS_TAKEOFF_ALT"] - 0.1:
            self.pilot_selects("LOITER")
        elif self._mode == "RTL" and float(np.linalg.norm(self._state.position[:2])) < ARRIVED_M:
            self.pilot_selects("LAND")
        elif self._mode == "LAND" and height_m < ON_GROUND_M:
            self._landed_s = self._landed_s or self._clock()
            if self._clock() - self._landed_s > DISARM_AFTER_LANDING_S:
                self._disarm()

    def _demand(self) -> Demand:
        match self._mode:
            case "OFFBOARD" if self.setpoints:
                setpoint = self.setpoints[-1][1]
                return Demand(setpoint.velocity, -setpoint.height_m, setpoint.yaw_rad)
            case "TAKEOFF":
                return Demand(np.zeros(2), -self.parameters["MIS_TAKEOFF_ALT"], self._hold_yaw_rad)
            case "LAND":
                return Demand(np.zeros(2), 0.5, self._hold_yaw_rad)
            case "RTL":
                home = -self._state.position[:2]
                return Demand(
                    home * min(1.0, 3.0 / max(float(np.linalg.norm(home)), 1e-9)), self._hold_down_m, self._hold_yaw_rad
                )
            case _:
                return Demand(np.zeros(2), self._hold_down_m, self._hold_yaw_rad)

    # MAVLink, in

    def _handle(self, message: Any, arrived_s: float) -> None:
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
            case "PARAM_REQUEST_READ":
                self._send_parameter(message.param_id)
            case _:
                pass

    def _take_setpoint(self, message: Any, arrived_s: float) -> None:
        numbers = (message.vx, message.vy, message.z, message.yaw)
        if message.type_mask != TYPE_MASK or message.coordinate_frame != 1 or not np.isfinite(numbers).all():
            self.refused_setpoints += 1
            return
        velocity = np.array([message.vx, message.vy])
        self.setpoints.append((arrived_s, Setpoint(arrived_s, velocity, height_m=-message.z, yaw_rad=message.yaw)))

    def _obey(self, command: int, message: Any) -> int:
        done: bool
        match command:
            case mavlink.MAV_CMD_DO_SET_MODE:
                mode = _mode_by_number(int(message.param2), int(message.param3))
                if mode is None:
                    return int(mavlink.MAV_RESULT_UNSUPPORTED)
                done = self._select(mode)
            case mavlink.MAV_CMD_COMPONENT_ARM_DISARM if message.param1 == 1:
                done = self._arm()
            case mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
                done = int(message.param1) in self._streams_s
                if done:
                    self._streams_s[int(message.param1)] = message.param2 * 1e-6
            case mavlink.MAV_CMD_REQUEST_MESSAGE if message.param1 == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
                self._send_version()
                done = True
            case _:
                return int(mavlink.MAV_RESULT_UNSUPPORTED)
        return int(mavlink.MAV_RESULT_ACCEPTED if done else mavlink.MAV_RESULT_TEMPORARILY_REJECTED)

    # MAVLink, out

    def _say(self, text: str) -> None:
        self._mav.statustext_send(mavlink.MAV_SEVERITY_CRITICAL, text[:50].encode())

    def _send_streams(self, now: float) -> None:
        self._send_if_due(now, 0, self._heartbeat_s, self._send_heartbeat)
        senders: dict[int, Callable[[], None]] = {
            31: self._send_attitude,
            32: self._send_position,
            245: self._send_landed,
            1: self._send_system,
            24: self._send_gps,
            230: self._send_estimator,
            242: self._send_home,
        }
        for number, sender in senders.items():
            self._send_if_due(now, number, self._streams_s[number], sender)
        self._send_if_due(now, 115, TRUTH_S, self._send_truth)
        if self._mode != self._told_mode:
            self._send_if_due(now, 436, self._streams_s[436], self._send_mode)

    def _send_if_due(self, now: float, number: int, interval_s: float, sender: Callable[[], None]) -> None:
        if now >= self._due_s.get(number, 0.0):
            self._due_s[number] = max(self._due_s.get(number, now) + interval_s, now)
            sender()

    def _boot_ms(self) -> int:
        return int((self._clock() - self._started_s) * 1000)

    def _custom_mode(self) -> int:
        _, main, sub = mavutil.px4_map[self._mode]
        return int(main << 16 | sub << 24)

    def _send_heartbeat(self) -> None:
        state = mavlink.MAV_STATE_STANDBY
        if self._armed:
            state = mavlink.MAV_STATE_CRITICAL if self.failsafe else mavlink.MAV_STATE_ACTIVE
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self._armed else 0
        self._mav.heartbeat_send(
            mavlink.MAV_TYPE_QUADROTOR,
            mavlink.MAV_AUTOPILOT_PX4,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed,
            self._custom_mode(),
            state,
        )

    def _send_mode(self) -> None:
        self._told_mode = self._mode
        _, main, sub = mavutil.px4_map[self._intended]
        self._mav.current_mode_send(0, self._custom_mode(), main << 16 | sub << 24)

    def _send_attitude(self) -> None:
        self._mav.attitude_quaternion_send(self._boot_ms(), *quaternion_from_rotation(self._state.R_ned_body), 0, 0, 0)

    def _send_position(self) -> None:
        if self.estimate_ok:
            self._mav.local_position_ned_send(self._boot_ms(), *self._state.position, *self._state.velocity)

    def _send_landed(self) -> None:
        landed = mavlink.MAV_LANDED_STATE_IN_AIR
        if self._state.position[2] > -ON_GROUND_M:
            landed = mavlink.MAV_LANDED_STATE_ON_GROUND
        elif self._mode == "TAKEOFF":
            landed = mavlink.MAV_LANDED_STATE_TAKEOFF
        elif self._mode == "LAND":
            landed = mavlink.MAV_LANDED_STATE_LANDING
        self._mav.extended_sys_state_send(mavlink.MAV_VTOL_STATE_UNDEFINED, landed)

    def _send_system(self) -> None:
        volts = 14.0 + 2.8 * self.battery_share
        self._mav.sys_status_send(0, 0, 0, 0, int(1000 * volts), -1, round(100 * self.battery_share), 0, 0, 0, 0, 0, 0)

    def _send_gps(self) -> None:
        lat, lon, alt = self._place(np.zeros(3))
        self._mav.gps_raw_int_send(self._boot_ms() * 1000, 3, lat, lon, alt, 100, 100, 0, 0, 12)

    def _send_estimator(self) -> None:
        flags = ALL_ESTIMATED if self.estimate_ok else 1
        self._mav.estimator_status_send(self._boot_ms() * 1000, flags, 0, 0, 0, 0, 0, 0, 0.1, 0.1)

    def _send_home(self) -> None:
        lat, lon, alt = self._place(np.zeros(3))
        self._mav.home_position_send(lat, lon, alt, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)

    def _send_truth(self) -> None:
        attitude, place = quaternion_from_rotation(self._state.R_ned_body), self._place(self._state.position)
        speeds = [round(100.0 * speed) for speed in self._state.velocity]
        self._truth.hil_state_quaternion_send(0, attitude, 0, 0, 0, *place, *speeds, 0, 0, 0, 0, 0)

    def _place(self, position: FloatArray) -> tuple[int, int, int]:
        """Latitude and longitude in 1e-7 degrees, and millimetres above the ground, of metres from home."""
        latitude_deg, longitude_deg = self._home_deg
        north_m, east_m = metres_a_degree(latitude_deg)
        latitude_deg += position[0] / north_m
        longitude_deg += position[1] / east_m
        return round(1e7 * latitude_deg), round(1e7 * longitude_deg), round(-1000.0 * position[2])

    def _send_version(self) -> None:
        """A version that no PX4 has, so that nobody takes it for one."""
        capabilities = mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        nothing = [0] * 8
        self._mav.autopilot_version_send(capabilities, 0x00000100, 0, 0, 0, nothing, nothing, nothing, 0, 0, 0)

    def _send_parameter(self, name: str) -> None:
        value = self.parameters.get(name)
        if value is None:
            return  # as PX4 does: the asker times out
        kind = mavlink.MAV_PARAM_TYPE_INT32 if isinstance(value, int) else mavlink.MAV_PARAM_TYPE_REAL32
        # PX4 puts an integer's bytes where MAVLink has a float.
        wire = struct.unpack("<f", struct.pack("<i", value))[0] if isinstance(value, int) else value
        index = list(self.parameters).index(name)
        self._mav.param_value_send(name.encode(), wire, kind, len(self.parameters), index)


class _Outlet:
    """Where pymavlink writes what only the ground is told, if there is one."""

    def __init__(self, sender: socket.socket, address: tuple[str, int] | None) -> None:
        self._socket, self._address = sender, address

    def write(self, data: bytes) -> None:
        if self._address is not None:
            self._socket.sendto(data, self._address)


def quaternion_from_rotation(rotation: FloatArray) -> tuple[float, float, float, float]:
    """W x y z of a rotation (3, 3) by less than half a turn about any level axis, which is how a multirotor flies."""
    R = rotation
    yaw = math.atan2(R[1, 0], R[0, 0])
    pitch = math.asin(max(-1.0, min(1.0, -R[2, 0])))
    roll = math.atan2(R[2, 1], R[2, 2])
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _age(ancillary: list[tuple[int, int, bytes]]) -> float:
    """How long ago a packet came by the kernel's stamp, in real seconds."""
    (stamp,) = (data for level, kind, data in ancillary if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS))
    seconds, nanoseconds = struct.unpack("@ll", stamp)
    return time.time() - float(seconds + nanoseconds * 1e-9)


def _mode_by_number(main: int, sub: int) -> Mode | None:
    modes: tuple[Mode, ...] = ("POSCTL", "LOITER", "TAKEOFF", "LAND", "RTL", "OFFBOARD")
    return next((mode for mode in modes if mavutil.px4_map[mode][1:] == (main, sub)), None)


def main() -> None:
    """Runs until it is interrupted."""
    parser = argparse.ArgumentParser(description="An autopilot stand-in that speaks MAVLink over UDP. It is not PX4.")
    parser.add_argument("--port", type=int, required=True, help="the UDP port on this computer to send to")
    parser.add_argument("--system-id", type=int, default=1, help="its MAV_SYS_ID (1)")
    parser.add_argument("--height", type=float, default=0.0, help="begin in the air, armed and in Hold, metres (0)")
    options = parser.parse_args()
    with AutopilotStandIn(options.port, system_id=options.system_id, height_m=options.height):
        threading.Event().wait()


if __name__ == "__main__":
    main()
