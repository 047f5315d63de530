"""What the fake autopilot sends over MAVLink, and when."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import development as mavlink

from flockd.core.earth import metres_a_degree
from flockd.core.messages import FloatArray
from flockd.flight.geometry import quaternion_from_rotation, rotation_from_vector, vector_from_rotation
from flockd.sim.autopilot.fake_range_finder import FakeRangeFinder
from flockd.sim.autopilot.fake_vehicle import MotionState

Mode = Literal["POSCTL", "LOITER", "TAKEOFF", "LAND", "RTL", "ACRO", "OFFBOARD"]
"""PX4's modes by the names pymavlink gives them; LOITER is Hold."""

DEFAULT_STREAMS_S = {
    31: 0.1,
    32: 0.1,
    245: 1.0,
    1: 1.0,
    24: 1.0,
    230: 1.0,
    242: 1.0,
    436: 2.0,
    132: 0.1,
    141: 0.1,
    85: 0.1,
}
"""Message number and seconds between two, until another rate is requested."""
TRUTH_S = 0.04
ON_GROUND_M = 0.05
UNKNOWN_COVARIANCE = 255
FULL_SIGNAL, NO_SIGNAL = 100, 1
"""Values of DISTANCE_SENSOR's `signal_quality`, whose 0 is for sensors that do not say."""
ALL_ESTIMATED = 1 | 2 | 4 | 8 | 16 | 32


class Outlet:
    """Where pymavlink writes the true pose, if a simulator listens."""

    def __init__(self, sender: socket.socket, address: tuple[str, int] | None) -> None:
        self._socket, self._address = sender, address

    def write(self, data: bytes) -> None:
        """Takes what pymavlink has packed."""
        if self._address is not None:
            self._socket.sendto(data, self._address)


@dataclass(frozen=True, eq=False)
class VehicleSnapshot:
    """All that the messages are made of, as of one tick."""

    motion: MotionState
    mode: Mode
    intended_mode: Mode
    """The mode it was asked for; not `mode` while its failsafe is active."""
    armed: bool
    estimate_ok: bool
    sends_motion: bool
    battery_share: float
    setpoint: FloatArray | None = None
    """(2,) m/s, north and east, that it follows in offboard."""
    frame_off: FloatArray = field(default_factory=lambda: np.zeros(3))
    """(3,) m by which its local positions are off the truth, in NED."""
    velocity_off: FloatArray = field(default_factory=lambda: np.zeros(2))
    """(2,) m/s likewise of its velocity, north and east."""
    heading_off_rad: float = 0.0
    """Likewise of its heading, clockwise."""

    @property
    def failsafe(self) -> bool:
        """It flies another mode than it was asked for."""
        return self.mode != self.intended_mode


class TelemetryStreams:
    """Sends each message at its interval, to the link and, of the true pose, to a simulator."""

    def __init__(
        self,
        link: mavlink.MAVLink,
        truth: mavlink.MAVLink,
        heartbeat_s: float,
        home_deg: tuple[float, float],
        started_s: float,
        range_finder: FakeRangeFinder | None = None,
    ) -> None:
        self._range_finder = range_finder
        self._clearance_m = math.nan
        self._mav, self._truth = link, truth
        self._heartbeat_s, self._home_deg, self._started_s = heartbeat_s, home_deg, started_s
        self.intervals_s = dict(DEFAULT_STREAMS_S)
        """Seconds between two messages, by message number."""
        self.heartbeats_to_lose = 0
        """So many of the next are lost on their way."""
        self._due_s: dict[int, float] = {}
        self._sent_modes: tuple[Mode, Mode] | None = None
        self._now_s = started_s
        self._attitude_before = started_s, np.eye(3)
        self._vehicle: VehicleSnapshot

    def send_due(self, now: float, vehicle: VehicleSnapshot) -> None:
        """Sends every stream that is due, about ``vehicle``."""
        self._vehicle, self._now_s = vehicle, now
        self._send_if_due(now, 0, self._heartbeat_s, self._send_heartbeat)
        senders: dict[int, Callable[[], None]] = {
            31: self._send_attitude,
            32: self._send_position,
            245: self._send_landed,
            1: self._send_system,
            24: self._send_gps,
            230: self._send_estimator,
            242: self._send_home,
            132: self._send_range,
            141: self._send_altitude,
            85: self._send_setpoint,
        }
        for number, sender in senders.items():
            self._send_if_due(now, number, self.intervals_s[number], sender)
        self._send_if_due(now, 115, TRUTH_S, self._send_truth)
        if (vehicle.mode, vehicle.intended_mode) != self._sent_modes:
            self._send_if_due(now, 436, self.intervals_s[436], self._send_mode)

    def _send_if_due(self, now: float, number: int, interval_s: float, sender: Callable[[], None]) -> None:
        if now >= self._due_s.get(number, 0.0):
            self._due_s[number] = max(self._due_s.get(number, now) + interval_s, now)
            sender()

    def _boot_ms(self) -> int:
        return int((self._now_s - self._started_s) * 1000)

    def _send_heartbeat(self) -> None:
        if self.heartbeats_to_lose > 0:
            self.heartbeats_to_lose -= 1
            return
        state = mavlink.MAV_STATE_STANDBY
        if self._vehicle.armed:
            state = mavlink.MAV_STATE_CRITICAL if self._vehicle.failsafe else mavlink.MAV_STATE_ACTIVE
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self._vehicle.armed else 0
        self._mav.heartbeat_send(
            mavlink.MAV_TYPE_QUADROTOR,
            mavlink.MAV_AUTOPILOT_PX4,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed,
            custom_mode(self._vehicle.mode),
            state,
        )

    def _send_mode(self) -> None:
        self._sent_modes = self._vehicle.mode, self._vehicle.intended_mode
        self._mav.current_mode_send(0, custom_mode(self._vehicle.mode), custom_mode(self._vehicle.intended_mode))

    def _send_setpoint(self) -> None:
        """Only in offboard: of its other modes' setpoints nothing is simulated."""
        if self._vehicle.setpoint is not None:
            nothing = [math.nan] * 3
            speeds = [*self._vehicle.setpoint, math.nan]
            self._mav.position_target_local_ned_send(self._boot_ms(), 1, 0, *nothing, *speeds, *nothing, math.nan, 0.0)

    def _send_attitude(self) -> None:
        R_ned_body, (before_s, before) = self._vehicle.motion.R_ned_body, self._attitude_before
        self._attitude_before = self._now_s, R_ned_body
        rate = vector_from_rotation(before.T @ R_ned_body) / max(self._now_s - before_s, 1e-3)
        shown = rotation_from_vector(np.array([0.0, 0.0, self._vehicle.heading_off_rad])) @ R_ned_body
        self._mav.attitude_quaternion_send(self._boot_ms(), *_wxyz(shown), *rate)

    def _send_position(self) -> None:
        motion = self._vehicle.motion
        if self._vehicle.estimate_ok and self._vehicle.sends_motion:
            self._mav.local_position_ned_send(
                self._boot_ms(),
                *(motion.position + self._vehicle.frame_off),
                *(motion.velocity[:2] + self._vehicle.velocity_off),
                motion.velocity[2],
            )

    def _send_landed(self) -> None:
        landed = mavlink.MAV_LANDED_STATE_IN_AIR
        if self._vehicle.motion.position[2] > -ON_GROUND_M:
            landed = mavlink.MAV_LANDED_STATE_ON_GROUND
        elif self._vehicle.mode == "TAKEOFF":
            landed = mavlink.MAV_LANDED_STATE_TAKEOFF
        elif self._vehicle.mode == "LAND":
            landed = mavlink.MAV_LANDED_STATE_LANDING
        self._mav.extended_sys_state_send(mavlink.MAV_VTOL_STATE_UNDEFINED, landed)

    def _send_system(self) -> None:
        share = self._vehicle.battery_share
        volts = 14.0 + 2.8 * share
        self._mav.sys_status_send(0, 0, 0, 0, int(1000 * volts), -1, round(100 * share), 0, 0, 0, 0, 0, 0)

    def _send_gps(self) -> None:
        lat, lon, alt = self._place(np.zeros(3))
        self._mav.gps_raw_int_send(self._boot_ms() * 1000, 3, lat, lon, alt, 100, 100, 0, 0, 12)

    def _send_estimator(self) -> None:
        flags = ALL_ESTIMATED if self._vehicle.estimate_ok else 1
        self._mav.estimator_status_send(self._boot_ms() * 1000, flags, 0, 0, 0, 0, 0, 0, 0.1, 0.1)

    def _send_home(self) -> None:
        lat, lon, alt = self._place(np.zeros(3))
        self._mav.home_position_send(lat, lon, alt, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)

    def _send_range(self) -> None:
        """Nothing in a dropout; of ground out of its limits a reading without a signal, as drivers do."""
        self._clearance_m = math.nan
        if self._range_finder is None:
            return
        motion = self._vehicle.motion
        reading = self._range_finder.read(self._now_s, motion.position, motion.velocity, motion.R_ned_body)
        if reading is None or reading.min_m is None or reading.max_m is None:
            return
        if reading.quality:
            self._clearance_m = reading.range_m * float(motion.R_ned_body[2, 2])
        self._mav.distance_sensor_send(
            self._boot_ms(),
            *(round(100.0 * metres) for metres in (reading.min_m, reading.max_m, reading.range_m)),
            mavlink.MAV_DISTANCE_SENSOR_LASER,
            0,
            mavlink.MAV_SENSOR_ROTATION_PITCH_270,
            UNKNOWN_COVARIANCE,
            signal_quality=FULL_SIGNAL if reading.quality else NO_SIGNAL,
        )

    def _send_altitude(self) -> None:
        """With the distance to bottom, which PX4 has as long as it has ranges."""
        height_m = -float(self._vehicle.motion.position[2])
        heights_m = [height_m] * 4
        self._mav.altitude_send(self._boot_ms() * 1000, *heights_m, math.nan, self._clearance_m)

    def _send_truth(self) -> None:
        attitude, place = (
            _wxyz(self._vehicle.motion.R_ned_body),
            self._place(self._vehicle.motion.position),
        )
        speeds = [round(100.0 * speed) for speed in self._vehicle.motion.velocity]
        self._truth.hil_state_quaternion_send(0, attitude, 0, 0, 0, *place, *speeds, 0, 0, 0, 0, 0)

    def _place(self, position: FloatArray) -> tuple[int, int, int]:
        """Latitude and longitude in 1e-7 degrees, and millimetres above the ground, of metres from home."""
        latitude_deg, longitude_deg = self._home_deg
        north_m, east_m = metres_a_degree(latitude_deg)
        latitude_deg += position[0] / north_m
        longitude_deg += position[1] / east_m
        return round(1e7 * latitude_deg), round(1e7 * longitude_deg), round(-1000.0 * position[2])

    def send_version(self) -> None:
        """Sends a version that no PX4 has, so that it cannot be mistaken for one."""
        capabilities = mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        nothing = [0] * 8
        self._mav.autopilot_version_send(capabilities, 0x00000100, 0, 0, 0, nothing, nothing, nothing, 0, 0, 0)


def _wxyz(R_ned_body: FloatArray) -> list[float]:
    """As a quaternion."""
    return list(np.roll(quaternion_from_rotation(R_ned_body), 1))


def custom_mode(mode: Mode) -> int:
    """As PX4 numbers it in MAVLink."""
    _, main, sub = mavutil.px4_map[mode]
    return int(main << 16 | sub << 24)


def mode_by_number(main: int, sub: int) -> Mode | None:
    """The mode of PX4's numbers; None for one that the fake does not fly."""
    modes: tuple[Mode, ...] = ("POSCTL", "LOITER", "TAKEOFF", "LAND", "RTL", "ACRO", "OFFBOARD")
    return next((mode for mode in modes if mavutil.px4_map[mode][1:] == (main, sub)), None)
