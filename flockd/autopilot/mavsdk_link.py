"""The link to the autopilot: the one file that knows MAVSDK.

Everything goes through MAVSDK's raw MAVLink path. Its offboard plugin repeats the last setpoint for ever, also when
whoever gave it is long dead; here a setpoint is sent once. Messages are kept as they come, the newest of each kind, so
that no queue grows and no event loop is needed to know the state.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import socket
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import numpy as np
from mavsdk.component_type import ComponentType
from mavsdk.connection_result import ConnectionResult
from mavsdk.logging import LogLevel, log_subscribe
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkDirectError, MavlinkDirectResult, MavlinkMessage
from mavsdk.plugins.param import Param, ParamError
from mavsdk.system import System

from flockd.autopilot.status import AutopilotError, AutopilotStatus, Firmware, FlightMode, LandedState
from flockd.config.autopilot import AutopilotParameters
from flockd.messages import FloatArray, Setpoint, VehicleState

T = TypeVar("T")
Clock = Callable[[], float]
Fields = Mapping[str, Any]

AUTOPILOT_COMPONENT = 1
SETPOINT_TYPE_MASK = 2531
"""SET_POSITION_TARGET_LOCAL_NED: velocity in x and y, position in z, and yaw; the rest is ignored."""
MAV_FRAME_LOCAL_NED = 1
MAV_AUTOPILOT_PX4 = 12
MAV_MODE_FLAG_SAFETY_ARMED = 128
MAV_STATE_CRITICAL = 5
GPS_FIX_3D = 3
ESTIMATOR_ATTITUDE, ESTIMATOR_VELOCITY_HORIZONTAL = 1, 2
ESTIMATOR_POSITION_RELATIVE, ESTIMATOR_POSITION_ABSOLUTE, ESTIMATOR_HEIGHT = 8, 16, 32

COMMAND_ARM_DISARM = 400
COMMAND_SET_MODE = 176
COMMAND_SET_MESSAGE_INTERVAL = 511
COMMAND_REQUEST_MESSAGE = 512
MODES: Mapping[tuple[int, int], FlightMode] = {
    (1, 0): "manual",
    (2, 0): "altitude",
    (3, 0): "position",
    (4, 2): "take-off",
    (4, 3): "hold",
    (4, 4): "mission",
    (4, 5): "return",
    (4, 6): "land",
    (6, 0): "offboard",
    (7, 0): "manual",
}
"""PX4's main and sub mode."""
LANDED_STATES: tuple[LandedState, ...] = ("unknown", "ground", "air", "taking off", "landing")
"""By MAV_LANDED_STATE."""
RESULTS = ("accepted", "refused for now", "denied", "not supported", "failed", "still in progress", "cancelled")
"""By MAV_RESULT."""

STREAMS_HZ = {
    "ATTITUDE_QUATERNION": (31, 50.0),
    "LOCAL_POSITION_NED": (32, 30.0),
    "EXTENDED_SYS_STATE": (245, 2.0),
    "SYS_STATUS": (1, 1.0),
    "GPS_RAW_INT": (24, 1.0),
    "ESTIMATOR_STATUS": (230, 2.0),
    "HOME_POSITION": (242, 1.0),
    "CURRENT_MODE": (436, 20.0),
}
"""What is asked for, by message number and rate. PX4 sends CURRENT_MODE at once when the mode changes, at this rate at
most; its heartbeat comes once a second whatever one asks."""
HEARD = (*STREAMS_HZ, "HEARTBEAT", "AUTOPILOT_VERSION", "STATUSTEXT")
TEXT_MEMORY_S = 2.0

_log = logging.getLogger(__name__)
_LOG_LEVELS = {
    LogLevel.DEBUG: logging.DEBUG,
    LogLevel.INFO: logging.INFO,
    LogLevel.WARN: logging.WARNING,
    LogLevel.ERROR: logging.ERROR,
}


@dataclass(frozen=True)
class _Heard:
    """A message, and when it came."""

    time_s: float
    fields: Fields


class AutopilotLink:
    """One autopilot. Everything that is not a coroutine may be called from any thread and returns at once."""

    def __init__(self, mavsdk: Mavsdk, system: System, executor: ThreadPoolExecutor, clock: Clock) -> None:
        """Use `connect`."""
        self._mavsdk = mavsdk
        self._executor = executor
        self._clock = clock
        self._system_id = int(system.get_system_id())
        self._heard: dict[str, _Heard] = {}
        self._home_down_m: float | None = None
        self._param = Param(system)
        self._direct = MavlinkDirect(system)
        for name in HEARD:
            self._direct.subscribe_message(name, self._receive)

    @classmethod
    async def connect(
        cls, parameters: AutopilotParameters, *, timeout_s: float = 10.0, clock: Clock = time.monotonic
    ) -> Self:
        """The link, once an autopilot has been heard and told what to send.

        Raises AutopilotError when the address cannot be used or nobody answers within `timeout_s`.
        """
        _refuse_a_taken_port(parameters.address)
        log_subscribe(_to_logging)
        executor = ThreadPoolExecutor(1, thread_name_prefix="mavsdk")  # never asyncio's own: it may be saturated
        mavsdk = Mavsdk(_configuration(parameters.system_id))
        try:
            deadline = clock() + timeout_s
            await _open(mavsdk, parameters.address, executor)
            system = await _find_system(mavsdk, parameters, deadline, timeout_s, clock)
            link = cls(mavsdk, system, executor, clock)
            await link._wait_for("HEARTBEAT", deadline)
            for name, (number, rate_hz) in STREAMS_HZ.items():
                await link._request_stream(name, number, rate_hz)
        except BaseException:
            mavsdk.destroy()
            executor.shutdown(wait=False)
            raise
        return link

    async def close(self) -> None:
        """Ends the link; nothing of it may be used afterwards."""
        await self._call(self._mavsdk.destroy)
        self._executor.shutdown(wait=False)

    @property
    def system_id(self) -> int:
        """The autopilot's MAV_SYS_ID."""
        return self._system_id

    def status(self) -> AutopilotStatus:
        """The newest of everything the autopilot has said."""
        now = self._clock()
        heartbeat = self._heard.get("HEARTBEAT", _Heard(-math.inf, {}))
        system = self._fields("SYS_STATUS")
        return AutopilotStatus(
            time_s=now,
            heartbeat_age_s=now - heartbeat.time_s,
            flight_mode=self._flight_mode(),
            armed=bool(heartbeat.fields.get("base_mode", 0) & MAV_MODE_FLAG_SAFETY_ARMED),
            failsafe=heartbeat.fields.get("system_status") == MAV_STATE_CRITICAL,
            landed_state=LANDED_STATES[self._fields("EXTENDED_SYS_STATE").get("landed_state", 0)],
            battery_share=_known(system.get("battery_remaining", -1), scale=0.01),
            battery_v=_known(system.get("voltage_battery", 0), scale=0.001, unknown=(0, 65535)),
            estimate_ok=_estimate_ok(self._heard.get("ESTIMATOR_STATUS")),
            gps_ok=None if (gps := self._heard.get("GPS_RAW_INT")) is None else gps.fields["fix_type"] >= GPS_FIX_3D,
            position_ned=_vector(self._fields("LOCAL_POSITION_NED"), "x", "y", "z"),
            home_ned=_vector(self._fields("HOME_POSITION"), "x", "y", "z"),
        )

    def vehicle_state(self) -> VehicleState | None:
        """Attitude, height above home and velocity, as old as the older of them; None before they are known.

        Before home is known the height is above the place where the estimator began.
        """
        attitude, position = self._heard.get("ATTITUDE_QUATERNION"), self._heard.get("LOCAL_POSITION_NED")
        if attitude is None or position is None:
            return None
        place = _vector(position.fields, "x", "y", "z")
        velocity = _vector(position.fields, "vx", "vy", "vz")
        quaternion = _vector(attitude.fields, "q1", "q2", "q3", "q4")
        if place is None or velocity is None or quaternion is None:
            return None
        return VehicleState(
            time_s=min(attitude.time_s, position.time_s),
            R_ned_body=rotation_from_quaternion(quaternion),
            height_m=float((self._home_down_m or 0.0) - place[2]),
            velocity_ned=velocity,
        )

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """Sends it, once. Raises AutopilotError when it is not finite or MAVSDK cannot send it."""
        north, east = (float(v) for v in setpoint.velocity)
        down = (self._home_down_m or 0.0) - setpoint.height_m
        if not all(math.isfinite(number) for number in (north, east, down, setpoint.yaw_rad)):
            raise AutopilotError("a setpoint that is not finite was not sent")
        fields = {
            "time_boot_ms": int(self._clock() * 1000) & 0xFFFFFFFF,
            "coordinate_frame": MAV_FRAME_LOCAL_NED,
            "type_mask": SETPOINT_TYPE_MASK,
            "vx": north,
            "vy": east,
            "z": down,
            "yaw": setpoint.yaw_rad,
        }
        unused = dict.fromkeys(("x", "y", "vz", "afx", "afy", "afz", "yaw_rate"), 0.0)
        try:
            self._direct.send_message(self._message("SET_POSITION_TARGET_LOCAL_NED", {**unused, **fields}))
        except MavlinkDirectError as error:
            raise AutopilotError(f"MAVSDK could not send a setpoint ({error.result.name.lower()})") from error

    async def request_offboard(self) -> None:
        """Asks for offboard flight; setpoints must be streaming by then. Raises AutopilotError when refused."""
        await self._set_mode("offboard")

    async def hold(self) -> None:
        """Asks it to stop and stay. Raises AutopilotError when refused."""
        await self._set_mode("hold")

    async def land(self) -> None:
        """Asks it to land here. Raises AutopilotError when refused."""
        await self._leave_offboard()
        await self._set_mode("land")

    async def return_home(self) -> None:
        """Asks it to fly home and land. Raises AutopilotError when refused."""
        await self._leave_offboard()
        await self._set_mode("return")

    async def arm(self) -> None:
        """Starts the motors. Raises AutopilotError when refused."""
        await self._command("to arm", COMMAND_ARM_DISARM, 1)

    async def take_off(self) -> None:
        """Climbs to its own take-off height (MIS_TAKEOFF_ALT), once armed. Raises AutopilotError when refused."""
        await self._set_mode("take-off")

    async def parameter(self, name: str, kind: type[T]) -> T:
        """One of its parameters, of `kind` int or float as the firmware has it. Raises AutopilotError."""
        read = self._param.get_param_int if kind is int else self._param.get_param_float
        try:
            return kind(await self._call(read, name))  # type: ignore[call-arg]
        except ParamError as error:
            reason = error.result.name.lower().replace("_", " ")
            raise AutopilotError(f"the autopilot's parameter {name} could not be read ({reason})") from error

    async def firmware(self, timeout_s: float = 3.0) -> Firmware:
        """What runs on it. Raises AutopilotError when it does not say within `timeout_s`."""
        await self._command("for its version", COMMAND_REQUEST_MESSAGE, 148)
        number = int((await self._wait_for("AUTOPILOT_VERSION", self._clock() + timeout_s))["flight_sw_version"])
        kind = self._fields("HEARTBEAT")["autopilot"]
        return Firmware(
            autopilot="PX4" if kind == MAV_AUTOPILOT_PX4 else f"autopilot {kind}",
            version=".".join(str(number >> shift & 0xFF) for shift in (24, 16, 8)),
        )

    def _receive(self, message: MavlinkMessage, _: object) -> None:
        """Called on MAVSDK's thread, one message after the other."""
        if message.system_id != self._system_id or message.component_id != AUTOPILOT_COMPONENT:
            return
        fields = json.loads(message.fields_json)
        self._heard[message.message_name] = _Heard(self._clock(), fields)
        home = _vector(fields, "x", "y", "z") if message.message_name == "HOME_POSITION" else None
        # A home that moves in flight must not move the height that is being held.
        if home is not None and (self._home_down_m is None or not self.status().in_air):
            self._home_down_m = float(home[2])

    def _fields(self, name: str) -> Fields:
        heard = self._heard.get(name)
        return {} if heard is None else heard.fields

    def _flight_mode(self) -> FlightMode:
        reports = [self._heard[name] for name in ("HEARTBEAT", "CURRENT_MODE") if name in self._heard]
        if not reports:
            return "unknown"
        mode = int(max(reports, key=lambda heard: heard.time_s).fields["custom_mode"])
        return MODES.get((mode >> 16 & 0xFF, mode >> 24 & 0xFF), "other")

    async def _set_mode(self, mode: FlightMode) -> None:
        main, sub = next(numbers for numbers, name in MODES.items() if name == mode)
        await self._command(f"for {mode}", COMMAND_SET_MODE, 1, main, sub)

    async def _leave_offboard(self) -> None:
        """PX4 goes back to the last mode it was asked for after landing, and cannot be armed if that was offboard."""
        if self._flight_mode() == "offboard":
            await self.hold()

    async def _request_stream(self, name: str, number: int, rate_hz: float) -> None:
        try:
            await self._command(f"for {name}", COMMAND_SET_MESSAGE_INTERVAL, number, 1e6 / rate_hz)
        except AutopilotError as error:  # an older firmware may lack one; whatever needs it then says so
            _log.warning("%s", error)

    async def _command(self, what: str, command: int, *values: float) -> None:
        """Sends a command until it is acknowledged. Raises AutopilotError when refused or never answered."""
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[tuple[MavlinkDirectResult, str]] = loop.create_future()

        def on_answer(result: MavlinkDirectResult, ack: MavlinkMessage, _: object) -> None:
            loop.call_soon_threadsafe(_settle, answer, (result, ack.fields_json))

        numbers = {f"param{i}": float(value) for i, value in enumerate((*values, *[0.0] * (7 - len(values))), start=1)}
        fields = {"command": command, "confirmation": 0, **numbers}
        self._direct.send_command_async(self._message("COMMAND_LONG", fields), on_answer)
        result, ack = await answer
        if result != MavlinkDirectResult.SUCCESS:
            raise AutopilotError(f"the autopilot was asked {what} and did not answer ({result.name.lower()})")
        verdict = int(json.loads(ack)["result"])
        if verdict != 0:
            said = self._heard.get("STATUSTEXT", _Heard(-math.inf, {}))
            why = f": {said.fields['text'].strip()}" if self._clock() - said.time_s < TEXT_MEMORY_S else ""
            raise AutopilotError(f"the autopilot was asked {what}, which was {RESULTS[verdict]}{why}")

    def _message(self, name: str, fields: Fields) -> MavlinkMessage:
        target = {"target_system": self._system_id, "target_component": AUTOPILOT_COMPONENT}
        text = json.dumps({**target, **fields}, allow_nan=False)
        return MavlinkMessage(name, 0, 0, self._system_id, AUTOPILOT_COMPONENT, text)

    async def _wait_for(self, name: str, deadline: float) -> Fields:
        while name not in self._heard:
            if self._clock() > deadline:
                raise AutopilotError(f"the autopilot sends no {name}; check the link")
            await asyncio.sleep(0.02)
        return self._fields(name)

    async def _call(self, function: Callable[..., Any], *arguments: object) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._executor, function, *arguments)


def rotation_from_quaternion(quaternion: FloatArray) -> FloatArray:
    """(3, 3) from (4,) w x y z; turns body into NED coordinates as MAVLink's attitude does."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _configuration(system_id: int | None) -> Configuration:
    """An onboard computer of the same system: PX4 then knows it is no ground station."""
    configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
    if system_id is not None:
        configuration.system_id = system_id
    return configuration


def _refuse_a_taken_port(address: str) -> None:
    """Two programs can share a UDP port without an error, and then both command the drone."""
    kind, _, rest = address.partition("://")
    if kind != "udpin":
        return
    host, _, port = rest.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((host, int(port)))
        except OSError as error:
            raise AutopilotError(
                f"autopilot.address: {address} cannot be used ({error.strerror}); is another program on it?"
            ) from error


async def _open(mavsdk: Mavsdk, address: str, executor: ThreadPoolExecutor) -> None:
    result = await asyncio.get_running_loop().run_in_executor(executor, mavsdk.add_any_connection, address)
    if result != ConnectionResult.SUCCESS:
        reason = ConnectionResult(result).name.lower().replace("_", " ")
        raise AutopilotError(
            f"autopilot.address: {address} cannot be opened ({reason}); check the address and the cable"
        )


async def _find_system(
    mavsdk: Mavsdk, parameters: AutopilotParameters, deadline: float, timeout_s: float, clock: Clock
) -> System:
    wanted = parameters.system_id
    while True:
        systems = {int(system.get_system_id()): system for system in mavsdk.get_systems() if system.has_autopilot()}
        if wanted is None and systems:
            return next(iter(systems.values()))
        if wanted in systems:
            return systems[wanted]
        if clock() > deadline:
            others = f"; heard instead: {', '.join(map(str, sorted(systems)))}" if systems else ""
            who = "no autopilot" if wanted is None else f"no autopilot with system id {wanted}"
            raise AutopilotError(
                f"{who} was heard at {parameters.address} within {timeout_s:g} s{others}; "
                "check autopilot.address, autopilot.system_id and that the autopilot is on"
            )
        await asyncio.sleep(0.05)


def _settle(answer: asyncio.Future[T], value: T) -> None:
    if not answer.done():
        answer.set_result(value)


def _vector(fields: Fields, *names: str) -> FloatArray | None:
    """The named numbers, or None where one is missing or null, which is how NaN comes."""
    numbers = [fields.get(name) for name in names]
    return None if any(number is None for number in numbers) else np.array(numbers, dtype=float)


def _known(value: float, *, scale: float, unknown: tuple[float, ...] = (-1,)) -> float | None:
    return None if value in unknown else value * scale


def _estimate_ok(heard: _Heard | None) -> bool | None:
    if heard is None:
        return None
    flags = int(heard.fields["flags"])
    needed = ESTIMATOR_ATTITUDE | ESTIMATOR_VELOCITY_HORIZONTAL | ESTIMATOR_HEIGHT
    somewhere = ESTIMATOR_POSITION_RELATIVE | ESTIMATOR_POSITION_ABSOLUTE
    return flags & needed == needed and bool(flags & somewhere)


def _to_logging(level: LogLevel, message: str, *_: object) -> bool:
    """MAVSDK would print; this says that it is taken care of."""
    _log.log(_LOG_LEVELS[level], "%s", message)
    return True
