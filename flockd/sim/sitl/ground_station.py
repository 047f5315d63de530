"""A ground station for a fleet of simulated autopilots, which also receives their true poses.

Poses come over the MAVLink stream on which PX4 SITL sends its true state to a simulator; flockd's fake autopilot sends
the same.
"""

from __future__ import annotations

import math
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import development as mavlink

from flockd.core.errors import UnavailableError
from flockd.core.messages import FloatArray
from flockd.core.navigation import metres_a_degree
from flockd.flight.geometry import rotation_from_euler, rotation_from_quaternion
from flockd.onboard.autopilot.mavlink_messages import StatusText
from flockd.sim.autopilot.fake_telemetry import Mode
from flockd.sim.autopilot.fake_vehicle import stick_curve
from flockd.sim.vehicles.pose_trail import FlockPose
from flockd.sim.vehicles.vehicles import REFERENCE_DEG

SYSTEM_ID = 255
HEARTBEAT_S = 1.0
POLL_S = 0.05
MODE_HZ = 20.0
FULL_STICK_M_S = 3.0
"""MPC_VEL_MANUAL of vehicles that are flown by hand: what a stick at its end asks for."""
_STICK = 1000
_DEFLECTIONS = np.linspace(0.0, 1.0, _STICK + 1)
_NEUTRAL_THROTTLE = 500
MAX_FORWARD_S = 0.2
"""A pose is extrapolated by no more than this."""
FURTHER_MODES = {10 << 16: "TERMINATION"}
"""Those of PX4's modes, by number, that pymavlink has no name for."""
_RECEIVED = {
    name: int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))
    for name in ("HEARTBEAT", "HIL_STATE_QUATERNION", "CURRENT_MODE", "STATUSTEXT", "AUTOPILOT_VERSION")
}


@dataclass(frozen=True, eq=False)
class Poses(FlockPose):
    """Poses of n drones, NED metres from the world's origin, and their velocities."""

    velocity: FloatArray
    """(n, 3) m/s."""


@dataclass
class _Vehicle:
    """One autopilot, by its last messages."""

    number: int
    socket: socket.socket
    mav: Any = None
    address: tuple[str, int] | None = None
    pose: tuple[float, Any] | None = None
    """When the newest message with its pose came, and the message."""
    mode: int | None = None
    armed: bool = False
    version: str | None = None
    texts: list[str] = field(default_factory=list)
    chunks: StatusText = field(default_factory=StatusText)

    def write(self, data: bytes) -> None:
        if self.address is not None:
            self.socket.sendto(data, self.address)


class GroundStation:
    """Receives the true poses of all vehicles on ``ports`` and commands them, between ``__enter__`` and ``__exit__``.

    Times are on ``clock``. Vehicles are counted from 0, and vehicle i has the MAV_SYS_ID i + 1.
    """

    def __init__(self, ports: Sequence[int], clock: Callable[[], float]) -> None:
        """Raises UnavailableError for a port that is taken."""
        self._clock = clock
        self._vehicles = [_Vehicle(number, _bound(port)) for number, port in enumerate(ports)]
        for vehicle in self._vehicles:
            vehicle.mav = mavlink.MAVLink(vehicle, srcSystem=SYSTEM_ID, srcComponent=mavlink.MAV_COMP_ID_MISSIONPLANNER)
            vehicle.mav.robust_parsing = True
        self._closing = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="ground station", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()
        for vehicle in self._vehicles:
            vehicle.socket.close()

    def is_connected(self, number: int) -> bool:
        """Whether its pose and its mode have been received."""
        vehicle = self._vehicles[number]
        return vehicle.pose is not None and vehicle.mode is not None

    def request_messages(self) -> None:
        """Requests mode and version from all autopilots."""
        for vehicle in self._vehicles:
            self._command(vehicle, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, _RECEIVED["CURRENT_MODE"], 1e6 / MODE_HZ)
            self._command(vehicle, mavlink.MAV_CMD_REQUEST_MESSAGE, _RECEIVED["AUTOPILOT_VERSION"])

    def poses(self) -> Poses:
        """Poses of all vehicles at the present time, extrapolated from the last messages."""
        now = self._clock()
        with self._lock:
            poses = [vehicle.pose for vehicle in self._vehicles if vehicle.pose is not None]
        assert len(poses) == len(self._vehicles), "wait until all are connected"
        of_each = [_extrapolated(message, min(max(now - since_s, 0.0), MAX_FORWARD_S)) for since_s, message in poses]
        return Poses(now, *map(np.array, zip(*of_each, strict=True)))

    def mode_is(self, number: int, mode: Mode) -> bool:
        """Whether it flies in this mode."""
        _, main, sub = mavutil.px4_map[mode]
        return bool(self._vehicles[number].mode == main << 16 | sub << 24)

    def mode(self, number: int) -> str:
        """The mode it flies in, by pymavlink's name or PX4's number; empty while it is not known."""
        flown = self._vehicles[number].mode
        named: dict[int, str] = {main << 16 | sub << 24: name for name, (_, main, sub) in mavutil.px4_map.items()}
        return "" if flown is None else {**named, **FURTHER_MODES}.get(flown, str(flown))

    def is_armed(self, number: int) -> bool:
        """Whether its motors run."""
        return self._vehicles[number].armed

    def last_text(self, number: int) -> str:
        """Its last STATUSTEXT, whole; empty if there was none."""
        return next(reversed(self._vehicles[number].texts), "")

    def version(self, number: int) -> str | None:
        """Version of its firmware, such as `1.18.0`; None while it is not known."""
        return self._vehicles[number].version

    def arm(self, number: int) -> None:
        """Sends the request to arm; see `is_armed`."""
        self._command(self._vehicles[number], mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def select(self, number: int, mode: Mode) -> None:
        """Sends the request for a mode; see `mode_is`."""
        _, main, sub = mavutil.px4_map[mode]
        self._command(self._vehicles[number], mavlink.MAV_CMD_DO_SET_MODE, 1, main, sub)

    def steer(self, number: int, velocity: FloatArray) -> None:
        """Moves the sticks of a vehicle in Position mode, for a velocity (2,) m/s north and east at its height.

        It stops half a second after the last call.
        """
        vehicle = self._vehicles[number]
        R = np.eye(3) if vehicle.pose is None else _extrapolated(vehicle.pose[1], 0.0)[1]
        yaw_rad = math.atan2(R[1, 0], R[0, 0])
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        ahead = np.array([cos * velocity[0] + sin * velocity[1], -sin * velocity[0] + cos * velocity[1]])
        sticks = np.sign(ahead) * np.interp(np.abs(ahead) / FULL_STICK_M_S, stick_curve(_DEFLECTIONS), _DEFLECTIONS)
        x, y = (int(stick) for stick in np.round(sticks * _STICK))
        with self._lock:
            vehicle.mav.manual_control_send(number + 1, x, y, _NEUTRAL_THROTTLE, 0, 0)

    def _command(self, vehicle: _Vehicle, command: int, *numbers: float) -> None:
        values = (*numbers, *[0.0] * (7 - len(numbers)))
        with self._lock:
            vehicle.mav.command_long_send(vehicle.number + 1, 1, command, 0, *values)

    def _run(self) -> None:
        by_socket = {vehicle.socket: vehicle for vehicle in self._vehicles}
        due_s = time.monotonic()
        while not self._closing.is_set():
            for ready in select.select(list(by_socket), [], [], POLL_S)[0]:
                self._receive(by_socket[ready])
            if time.monotonic() >= due_s:
                due_s = time.monotonic() + HEARTBEAT_S
                self._send_heartbeats()

    def _send_heartbeats(self) -> None:
        with self._lock:
            for vehicle in self._vehicles:
                vehicle.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0)

    def _receive(self, vehicle: _Vehicle) -> None:
        data, vehicle.address = vehicle.socket.recvfrom(65536)
        now = self._clock()
        with self._lock:
            for packet in _packets(data):
                for message in vehicle.mav.parse_buffer(packet) or ():
                    if message.get_srcSystem() == vehicle.number + 1:
                        _update(vehicle, message, now)


def home_deg(position: FloatArray) -> tuple[float, float]:
    """Latitude and longitude, degrees, of a place (3,) m NED from the world's origin."""
    north_m, east_m = metres_a_degree(REFERENCE_DEG[0])
    return REFERENCE_DEG[0] + float(position[0]) / north_m, REFERENCE_DEG[1] + float(position[1]) / east_m


def _update(vehicle: _Vehicle, message: Any, now: float) -> None:
    match message.get_type():
        case "HIL_STATE_QUATERNION":
            vehicle.pose = now, message
        case "HEARTBEAT":
            vehicle.mode = int(message.custom_mode)
            vehicle.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        case "CURRENT_MODE":
            vehicle.mode = int(message.custom_mode)
        case "STATUSTEXT":
            text = vehicle.chunks.joined(message.to_dict(), now)
            if text is not None:
                vehicle.texts.append(text.strip())
        case "AUTOPILOT_VERSION":
            vehicle.version = ".".join(str(message.flight_sw_version >> shift & 0xFF) for shift in (24, 16, 8))
        case _:
            pass


def _extrapolated(message: Any, age_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position (3,), R_ned_body and velocity (3,) after `age_s`, as if neither velocity nor turn had changed."""
    north_m, east_m = metres_a_degree(REFERENCE_DEG[0])
    north = (message.lat * 1e-7 - REFERENCE_DEG[0]) * north_m
    east = (message.lon * 1e-7 - REFERENCE_DEG[1]) * east_m
    velocity = np.array([message.vx, message.vy, message.vz]) * 1e-2
    R_ned_body = rotation_from_quaternion(np.roll(message.attitude_quaternion, -1))
    turned = rotation_from_euler(age_s * message.rollspeed, age_s * message.pitchspeed, age_s * message.yawspeed)
    return np.array([north, east, -message.alt * 1e-3]) + age_s * velocity, R_ned_body @ turned, velocity


def _packets(data: bytes) -> Iterator[bytes]:
    """The MAVLink 2 packets of a datagram with messages that are used; the others cost too much to decode."""
    begin = 0
    while begin + 12 <= len(data) and data[begin] == mavlink.PROTOCOL_MARKER_V2:
        end = begin + 12 + data[begin + 1] + (13 if data[begin + 2] & 1 else 0)
        if int.from_bytes(data[begin + 7 : begin + 10], "little") in _RECEIVED.values():
            yield data[begin:end]
        begin = end


def _bound(port: int) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind(("127.0.0.1", port))
    except OSError as error:
        bound.close()
        found = f"`ss -lunp sport = :{port}` names it"
        raise UnavailableError(
            f"UDP port {port} cannot be used ({error.strerror}); end the other program that uses it: {found}"
        ) from error
    return bound
