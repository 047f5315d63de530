"""The fake autopilot's MAVLink messages, and when it sends them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import development as mavlink

from flockd.core.messages import FloatArray
from flockd.core.navigation import metres_a_degree
from flockd.flight.geometry import quaternion_from_rotation, rotation_from_vector, vector_from_rotation
from flockd.sim.autopilot.fake_range_finder import FakeRangeFinder

if TYPE_CHECKING:
    from flockd.sim.autopilot.fake_autopilot import FakeAutopilot

Mode = Literal["POSCTL", "LOITER", "TAKEOFF", "LAND", "RTL", "ACRO", "OFFBOARD"]
"""PX4's modes by the names pymavlink gives them; LOITER is Hold."""

TRUTH_S = 0.04
_NEVER_ASKED = 0, 115
"""The heartbeat and the truth, whose rates are fixed."""
ON_GROUND_M = 0.05
UNKNOWN_COVARIANCE = 255
FULL_SIGNAL, NO_SIGNAL = 100, 1
"""Values of DISTANCE_SENSOR's `signal_quality`, whose 0 is for sensors that do not say."""
ALL_ESTIMATED = 1 | 2 | 4 | 8 | 16 | 32


class TelemetryStreams:
    """Sends each message at its interval: to the link, and the true pose to a simulator."""

    def __init__(
        self, vehicle: FakeAutopilot, link: mavlink.MAVLink, truth: mavlink.MAVLink, *, started_s: float,
        heartbeat_s: float, home_deg: tuple[float, float], range_finder: FakeRangeFinder | None,
    ) -> None:  # fmt: skip
        self._vehicle, self._mav, self._truth, self._range_finder = vehicle, link, truth, range_finder
        self._home_deg, self._started_s, self._now_s = home_deg, started_s, started_s
        self.heartbeats_to_lose = 0
        """So many of the next are lost on their way."""
        self._heartbeat_s = heartbeat_s
        self._due_s: dict[int, float] = {}
        self._sent_modes: tuple[Mode, Mode] | None = None
        self._attitude_before = started_s, np.eye(3)
        self.intervals_s = {n: interval_s for n, (interval_s, _) in self._streams().items() if n not in _NEVER_ASKED}
        """Seconds between two messages, by message number, of those that may be asked for at another rate."""

    def _streams(self) -> dict[int, tuple[float, Callable[[], None]]]:
        """By message number: seconds between two until another rate is asked for, and what sends one."""
        return {
            0: (self._heartbeat_s, self._send_heartbeat),
            31: (0.1, self._send_attitude),
            32: (0.1, self._send_position),
            245: (1.0, self._send_landed),
            1: (1.0, self._send_system),
            24: (1.0, self._send_gps),
            230: (1.0, self._send_estimator),
            242: (1.0, self._send_home),
            132: (0.1, self._send_range),
            85: (0.1, self._send_setpoint),
            115: (TRUTH_S, self._send_truth),
            436: (2.0, self._send_mode),
        }

    def send_due(self, now: float) -> None:
        """Sends every stream that is due."""
        self._now_s = now
        for number, (interval_s, sender) in self._streams().items():
            if number == 436 and (self._vehicle.mode, self._vehicle.intended_mode) == self._sent_modes:
                continue
            if now >= self._due_s.get(number, 0.0):
                self._due_s[number] = max(self._due_s.get(number, now) + self.intervals_s.get(number, interval_s), now)
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
        flags, mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed, custom_mode(self._vehicle.mode)
        self._mav.heartbeat_send(mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, flags, mode, state)

    def _send_mode(self) -> None:
        self._sent_modes = self._vehicle.mode, self._vehicle.intended_mode
        self._mav.current_mode_send(0, custom_mode(self._vehicle.mode), custom_mode(self._vehicle.intended_mode))

    def _send_setpoint(self) -> None:
        """Only in offboard: of its other modes' setpoints nothing is simulated."""
        if self._vehicle.mode == "OFFBOARD" and self._vehicle.setpoints:
            nothing, speeds = [math.nan] * 3, [*self._vehicle.followed().velocity, math.nan]
            self._mav.position_target_local_ned_send(self._boot_ms(), 1, 0, *nothing, *speeds, *nothing, math.nan, 0.0)

    def _send_attitude(self) -> None:
        R_ned_body, (before_s, before) = self._vehicle.state.R_ned_body, self._attitude_before
        self._attitude_before = self._now_s, R_ned_body
        rate = vector_from_rotation(before.T @ R_ned_body) / max(self._now_s - before_s, 1e-3)
        shown = rotation_from_vector(np.array([0.0, 0.0, self._vehicle.heading_off_rad])) @ R_ned_body
        self._mav.attitude_quaternion_send(self._boot_ms(), *_wxyz(shown), *rate)

    def _send_position(self) -> None:
        motion = self._vehicle.state
        if self._vehicle.estimate_ok and self._vehicle.sends_motion:
            self._mav.local_position_ned_send(
                self._boot_ms(),
                *(motion.position + self._vehicle.frame_off + np.append(self._vehicle.drift.position, 0.0)),
                *(motion.velocity[:2] + self._vehicle.drift.velocity[:2]),
                motion.velocity[2],
            )

    def _send_landed(self) -> None:
        landed = mavlink.MAV_LANDED_STATE_IN_AIR
        if self._vehicle.state.position[2] > -ON_GROUND_M:
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
        if self._range_finder is None:
            return
        motion = self._vehicle.state
        reading = self._range_finder.read(self._now_s, motion.position, motion.velocity, motion.R_ned_body)
        if reading is None or reading.min_m is None or reading.max_m is None:
            return
        self._mav.distance_sensor_send(
            self._boot_ms(),
            *(round(100.0 * metres) for metres in (reading.min_m, reading.max_m, reading.range_m)),
            mavlink.MAV_DISTANCE_SENSOR_LASER,
            0,
            mavlink.MAV_SENSOR_ROTATION_PITCH_270,
            UNKNOWN_COVARIANCE,
            signal_quality=FULL_SIGNAL if reading.quality else NO_SIGNAL,
        )

    def _send_truth(self) -> None:
        motion = self._vehicle.state
        speeds, place = [round(100.0 * speed) for speed in motion.velocity], self._place(motion.position)
        self._truth.hil_state_quaternion_send(0, _wxyz(motion.R_ned_body), 0, 0, 0, *place, *speeds, 0, 0, 0, 0, 0)

    def _place(self, position: FloatArray) -> tuple[int, int, int]:
        """Latitude and longitude in 1e-7 degrees, and millimetres above the ground, of metres from home."""
        latitude_deg, longitude_deg = self._home_deg
        north_m, east_m = metres_a_degree(latitude_deg)
        latitude_deg += position[0] / north_m
        longitude_deg += position[1] / east_m
        return round(1e7 * latitude_deg), round(1e7 * longitude_deg), round(-1000.0 * position[2])

    def send_version(self, board: Sequence[int]) -> None:
        """Sends a version that no PX4 has, so that it cannot be mistaken for one; ``board``: its 18 bytes."""
        capabilities = mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        nothing = [0] * 8
        self._mav.autopilot_version_send(capabilities, 0x00000100, 0, 0, 0, nothing, nothing, nothing, 0, 0, 0, board)


def _wxyz(R_ned_body: FloatArray) -> list[float]:
    """As a quaternion."""
    return list(np.roll(quaternion_from_rotation(R_ned_body), 1))


def custom_mode(mode: Mode) -> int:
    """PX4's number of a mode in MAVLink."""
    _, main, sub = mavutil.px4_map[mode]
    return int(main << 16 | sub << 24)


def mode_by_number(main: int, sub: int) -> Mode | None:
    """The mode of PX4's numbers; None for one that the fake does not fly."""
    return next((mode for mode in get_args(Mode) if mavutil.px4_map[mode][1:] == (main, sub)), None)
