"""The link to the autopilot: the adapter of MAVSDK.

It uses MAVSDK's raw MAVLink path. MAVSDK's offboard plugin repeats the last setpoint for ever, even after the program
that gave it has ended; here a setpoint is sent once. `mavlink_messages` decodes received messages.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from enum import IntEnum
from functools import lru_cache
from itertools import cycle
from typing import Any, Self, TypeVar

from mavsdk.component_type import ComponentType
from mavsdk.connection_result import ConnectionResult
from mavsdk.logging import LogLevel, log_subscribe
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkDirectError, MavlinkDirectResult, MavlinkMessage
from mavsdk.plugins.param import Param, ParamError
from mavsdk.system import System

from flockd.core import services
from flockd.core.config.autopilot import AutopilotParameters
from flockd.core.messages import Setpoint, VehicleState
from flockd.onboard.autopilot.autopilot_status import (
    MODES,
    AutopilotError,
    AutopilotSettingError,
    AutopilotStatus,
    Firmware,
    FlightMode,
)
from flockd.onboard.autopilot.mavlink_messages import Fields, ReceivedMessages, result_text, text_chunks
from flockd.onboard.autopilot.refusal_reasons import REMEDIES_OF_RESULTS
from flockd.onboard.autopilot.refusals import Refusal
from flockd.onboard.autopilot.serial_port import SerialPort, discard
from flockd.onboard.autopilot.watches import GROUND_STATION_LOSS, KINDS

T = TypeVar("T")
Clock = Callable[[], float]

AUTOPILOT_COMPONENT = 1
SETPOINT_TYPE_MASK = 2503
"""SET_POSITION_TARGET_LOCAL_NED: velocity and yaw; the rest is ignored."""
MAV_FRAME_LOCAL_NED = 1
MAV_AUTOPILOT_PX4 = 12
COMMAND_SET_MODE = 176
COMMAND_SET_MESSAGE_INTERVAL = 511
FOR_ITS_VERSION = ("for its version", 512, 148)  # MAV_CMD_REQUEST_MESSAGE, AUTOPILOT_VERSION
COMMAND_RUN_CHECKS = 401
HEIGHT_GAIN_PER_S = 1.0
"""Climb rate of a setpoint for each metre of missing height."""
STREAMS_HZ = {
    "ATTITUDE_QUATERNION": (31, services.VEHICLE_STATE.rate_hz),
    "LOCAL_POSITION_NED": (32, 30.0),
    "EXTENDED_SYS_STATE": (245, 2.0),
    "SYS_STATUS": (1, 1.0),
    "GPS_RAW_INT": (24, 1.0),
    "ESTIMATOR_STATUS": (230, 2.0),
    "HOME_POSITION": (242, 1.0),
    "CURRENT_MODE": (436, 20.0),
    "DISTANCE_SENSOR": (132, services.GROUND_RANGE.rate_hz),
    "POSITION_TARGET_LOCAL_NED": (85, services.POSITION_TARGET.rate_hz),
}
"""What is asked for, by message number and rate. PX4 sends CURRENT_MODE at once when the mode changes, at this rate at
most; its heartbeat comes once a second whatever one asks."""
RECEIVED = (*STREAMS_HZ, "HEARTBEAT", "AUTOPILOT_VERSION", "STATUSTEXT", "EVENT", "CURRENT_EVENT_SEQUENCE")
TIME_SYNC = "TIMESYNC"
UNTARGETED = frozenset({"HEARTBEAT", "STATUSTEXT"})
"""Messages without a target: for all receivers."""
MOST_OPEN = 20
"""Time exchanges that may wait for a reply; older ones are lost."""
REASON_S = 0.5
"""Time for which a refusal waits for the autopilot's text, which follows it."""
ATTEND_S, ANNOUNCE_S = 0.25, 1.0
"""Time between two checks for missing data, and two readings of a parameter; time between two announcements."""
CHECKS_AGAIN_S, VERSION_AGAIN_S = 1.0, 10.0
"""Time between two requests for the list of failed checks after events were lost; and for the version, which has the
board's serial number: another autopilot of this id answers too."""
ANNOUNCEMENT = {
    "type": 6, "autopilot": 8, "base_mode": 0, "custom_mode": 0, "system_status": 4, "mavlink_version": 3
}  # fmt: skip
"""A HEARTBEAT of MAV_TYPE_GCS: PX4 sends its texts on no link on which it hears no ground station."""
MOST_REPORTS = 100
MAX_TEXTS = 100
"""Texts of MAVSDK that are remembered, so that each is logged once."""
GONE_S = 10.0
"""Longest absence of a serial port on the ground before the link is given up; an autopilot restarts in 5 s."""

_JSON = json.JSONEncoder(allow_nan=False)
_log = logging.getLogger(__name__)
_LOG_LEVELS = {
    LogLevel.DEBUG: logging.DEBUG,
    LogLevel.INFO: logging.INFO,
    LogLevel.WARN: logging.WARNING,
    LogLevel.ERROR: logging.ERROR,
}


class Severity(IntEnum):
    """MAV_SEVERITY of a text; smaller is graver."""

    CRITICAL = 2
    WARNING = 4
    NOTICE = 5
    INFO = 6


class AutopilotLink:
    """One autopilot. All methods that are not coroutines may be called from any thread and return at once."""

    def __init__(
        self,
        mavsdk: Mavsdk,
        system: System,
        executor: ThreadPoolExecutor,
        clock: Clock,
        parameters: AutopilotParameters,
        port: SerialPort | None,
        reports: deque[str],
    ) -> None:
        """Use `connect`."""
        self._mavsdk = mavsdk
        self._executor = executor
        self._clock = clock
        self._parameters = parameters
        self._port = port
        self._reports = reports
        self._system_id = int(system.get_system_id())
        self._heard = {self._system_id}
        """System ids of the autopilots on the link."""
        self.received = ReceivedMessages(self._reports.append, parameters.max_gap_s)
        """The autopilot's messages; `synchronise` measures its clock, `attend` reads its parameters."""
        self._sent_s = -math.inf
        """When the last setpoint was sent."""
        self._param = Param(system)
        self._direct: MavlinkDirect | _Closed = MavlinkDirect(system)
        self._time_syncs: deque[int] = deque(maxlen=MOST_OPEN)
        """Start times of unanswered exchanges, in nanoseconds of this computer's clock."""
        self._text_ids = cycle(range(1, 0x10000))
        for name in (*RECEIVED, TIME_SYNC):
            self._direct.subscribe_message(name, self._receive)

    @classmethod
    async def connect(
        cls,
        parameters: AutopilotParameters,
        *,
        timeout_s: float = 10.0,
        clock: Clock = time.monotonic,
        create: Callable[[Configuration], Mavsdk] = Mavsdk,
    ) -> Self:
        """Opens the link, waits for an autopilot, and requests its messages."""
        _refuse_a_taken_port(parameters.address)
        log_subscribe(_to_logging)
        reports: deque[str] = deque(maxlen=MOST_REPORTS)
        port = _serial_port(parameters.address, reports.append)
        executor = ThreadPoolExecutor(1, thread_name_prefix="mavsdk")  # asyncio's own may be saturated
        configuration = _configuration(parameters.system_id)
        mavsdk = create(configuration)
        kept: list[object] = []
        try:
            deadline = clock() + timeout_s
            await _open(mavsdk, parameters.address, port, executor)
            system = await _find_system(mavsdk, parameters, deadline, timeout_s, clock)
            system_id = int(system.get_system_id())
            if configuration.system_id != system_id:  # again, with the autopilot's system id
                system.destroy()
                if port is not None:
                    port.hand_to(discard)
                await asyncio.get_running_loop().run_in_executor(executor, mavsdk.destroy)
                mavsdk = create(_configuration(system_id))
                await _open(mavsdk, parameters.address, port, executor)
                own = parameters.model_copy(update={"system_id": system_id})
                system = await _find_system(mavsdk, own, clock() + timeout_s, timeout_s, clock)
            kept.append(system)
            link = cls(mavsdk, system, executor, clock, parameters, port, reports)
            kept += [link, link._callbacks()]
            await link._wait_for("HEARTBEAT", clock() + timeout_s)
            await link._request_streams()
        except BaseException:
            if port is not None:
                port.close()
            executor.submit(_destroy, mavsdk, kept)  # after any call that still runs, which would crash
            executor.shutdown(wait=False)
            raise
        return link

    async def close(self) -> None:
        """Closes the link; it may not be used afterwards.

        If the caller does not wait, it is closed after the call that still runs.
        """
        if self._port is not None:
            self._port.close()
        ended = self._executor.submit(_destroy, self._mavsdk, (self, self._direct, self._callbacks()))
        self._direct = _Closed()
        self._executor.shutdown(wait=False)
        await asyncio.shield(asyncio.wrap_future(ended))

    def _callbacks(self) -> list[tuple[object, ...]]:
        """What MAVSDK 4.1 calls from its own thread. Its plugins release them before that thread has ended: a waiting
        message would then call freed memory (seen on a busy computer)."""
        held = [vars(plugin) for plugin in (self._direct, self._param)]
        return [(*one.get("_callbacks", ()), *one.get("_subscriptions", {}).values()) for one in held]

    @property
    def system_id(self) -> int:
        """The autopilot's MAV_SYS_ID."""
        return self._system_id

    def unusable(self) -> AutopilotError | None:
        """Why no drone should take off with this link; None: the link is usable."""
        if self._port is not None and self._port.gone_for_s() > GONE_S:
            return AutopilotError(
                f"autopilot.address: {self._parameters.address} has been gone for more than {GONE_S:g} s; "
                "check the cable and that the autopilot is on"
            )
        if len(self._heard) > 1:
            return _ambiguous(self._parameters.address, self._heard)
        if self.received.are_two:
            return AutopilotSettingError(
                f"autopilot.system_id: two autopilots of system {self._system_id} are heard at "
                f"{self._parameters.address}; disconnect the other one, or give it another MAV_SYS_ID"
            )
        return None

    def status(self) -> AutopilotStatus:
        """The autopilot's status by its newest messages."""
        return self.received.status(self._clock())

    def vehicle_state(self) -> VehicleState | None:
        """See `ReceivedMessages.vehicle_state`."""
        return self.received.vehicle_state()

    def refusals(self) -> tuple[Refusal, ...]:
        """Why it would refuse to arm or to fly offboard now, the cause first."""
        now = self._clock()
        return self.received.refusals(now, streams=now - self._sent_s < services.SETPOINT_STREAM.timeout)

    def knows_checks(self) -> bool:
        """Whether the autopilot's list of failed checks is known and complete."""
        events = self.received.check_events
        return events.report is not None and not events.lost

    async def ask_for_checks(self) -> None:
        """Requests its list of failed checks. Raises AutopilotError if the link cannot send."""
        await self._command("for its checks", COMMAND_RUN_CHECKS)

    async def synchronise(self) -> None:
        """Exchanges times with the autopilot until cancelled."""
        while True:
            sent_ns = int(1e9 * self._clock())
            self._time_syncs.append(sent_ns)
            with suppress(MavlinkDirectError):  # a link that cannot send says so where setpoints are sent
                self._direct.send_message(self._message(TIME_SYNC, {"tc1": 0, "ts1": sent_ns}))
            await asyncio.sleep(services.TIME_SYNC.period_s)

    async def attend(self) -> None:
        """Repeats requests for what the autopilot sends only on request, until cancelled.

        It announces flockd as a ground station, for the autopilot's texts; asks again for checks whose events were
        lost; requests all streams from an autopilot that has started or been plugged in; reads the parameters that
        flockd relies on; and listens for a second autopilot if `system_id` names none.
        """
        async with asyncio.TaskGroup() as group:
            group.create_task(self._announce())
            group.create_task(self._request_what_is_missing())
            group.create_task(self._read_parameters())
            if self._parameters.system_id is None:
                group.create_task(self._listen_for_others())

    async def _listen_for_others(self) -> None:
        while len(self._heard) == 1:
            await asyncio.sleep(ANNOUNCE_S)
            self._heard |= await self._call(_autopilots, self._mavsdk)
        self._reports.append(str(_ambiguous(self._parameters.address, self._heard)))

    async def _announce(self) -> None:
        while True:
            if self.announces():
                with suppress(MavlinkDirectError):
                    self._direct.send_message(self._message("HEARTBEAT", ANNOUNCEMENT))
            await asyncio.sleep(ANNOUNCE_S)

    def announces(self) -> bool:
        """Whether flockd may appear as a ground station: not if PX4 acts on the loss of one, which flockd would hide.

        PX4 does with NAV_DLL_ACT other than 0, and at the end of a mission.
        """
        acts = self.received.parameters.values.get(GROUND_STATION_LOSS)
        return acts == 0 and self.received.flight_mode() != "mission"

    async def _request_what_is_missing(self) -> None:
        beginnings, asked_s, version_s = self._beginnings(), -math.inf, -math.inf
        while True:
            if self.received.check_events.lost and self._clock() - asked_s >= CHECKS_AGAIN_S:
                asked_s = self._clock()
                with suppress(AutopilotError):
                    await self.ask_for_checks()
            if self._beginnings() != beginnings:
                beginnings = self._beginnings()
                await self._request_streams()
            elif self._clock() - version_s >= VERSION_AGAIN_S:
                version_s = self._clock()
                with suppress(AutopilotError):
                    await self._command(*FOR_ITS_VERSION)
            await asyncio.sleep(ATTEND_S)

    def _beginnings(self) -> int:
        """Counts the events after which the autopilot may send its default messages again."""
        return self.received.restarts + (0 if self._port is None else self._port.reopened)

    async def _read_parameters(self) -> None:
        while True:
            for name, kind in KINDS.items():
                with suppress(AutopilotError):  # an older firmware may lack one; a lost link is reported elsewhere
                    value = await self.parameter(name, kind)
                    self.received.parameters.take(name, float(value), armed=self.status().armed)
                await asyncio.sleep(ATTEND_S)

    def take_reports(self) -> list[str]:
        """Reports about the messages since the last call, one sentence each."""
        return [self._reports.popleft() for _ in range(len(self._reports))]

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """Sends a setpoint, once. Raises AutopilotError if it is not finite or MAVSDK cannot send it.

        The height is sent as a vertical velocity: PX4's frame may jump, and a height in the old frame would then make
        PX4 climb or sink by the jump. While the drone's own height is too old to fly by, it neither climbs nor sinks.
        """
        north, east = (float(v) for v in setpoint.velocity)
        position = self.received.newest("LOCAL_POSITION_NED")
        is_new = position is not None and self._clock() - position.time_s <= services.MOTION.timeout
        down = HEIGHT_GAIN_PER_S * is_new * (self.received.height_m - setpoint.height_m)
        if not all(math.isfinite(number) for number in (north, east, down, setpoint.yaw_rad)):
            raise AutopilotError("a setpoint that is not finite was not sent")
        fields = {
            "time_boot_ms": int(self._clock() * 1000) & 0xFFFFFFFF,
            "coordinate_frame": MAV_FRAME_LOCAL_NED,
            "type_mask": SETPOINT_TYPE_MASK,
            "vx": north,
            "vy": east,
            "vz": down,
            "yaw": setpoint.yaw_rad,
        }
        unused = dict.fromkeys(("x", "y", "z", "afx", "afy", "afz", "yaw_rate"), 0.0)
        try:
            self._direct.send_message(self._message("SET_POSITION_TARGET_LOCAL_NED", {**unused, **fields}))
        except MavlinkDirectError as error:
            raise AutopilotError(f"MAVSDK could not send a setpoint ({error.result.name.lower()})") from error
        self._sent_s = self._clock()
        self.received.setpoints.sent(self._sent_s, north, east)

    def send_text(self, text: str, severity: Severity) -> None:
        """Sends a text once, for PX4's log and for ground stations, to which PX4 forwards it; cut if too long."""
        for chunk in text_chunks(text, next(self._text_ids)):
            with suppress(MavlinkDirectError):  # a link that cannot send says so where setpoints are sent
                self._direct.send_message(self._message("STATUSTEXT", {"severity": int(severity), **chunk}))

    async def hold(self) -> None:
        """Requests Hold. Raises AutopilotError when refused."""
        await self._set_mode("hold")

    async def land(self) -> None:
        """Requests landing here. Raises AutopilotError when refused."""
        await self._leave_offboard()
        await self._set_mode("land")

    async def return_home(self) -> None:
        """Requests return home and landing. Raises AutopilotError when refused."""
        await self._leave_offboard()
        await self._set_mode("return")

    async def parameter(self, name: str, kind: type[T]) -> T:
        """A parameter of the autopilot, of `kind` int or float as in the firmware. Raises AutopilotError."""
        read = self._param.get_param_int if kind is int else self._param.get_param_float
        try:
            return kind(await self._call(read, name))  # type: ignore[call-arg]
        except ParamError as error:
            reason = error.result.name.lower().replace("_", " ")
            raise AutopilotError(f"the autopilot's parameter {name} could not be read ({reason})") from error

    async def firmware(self, timeout_s: float = 3.0) -> Firmware:
        """Its firmware. Raises AutopilotError without an answer within `timeout_s`."""
        await self._command(*FOR_ITS_VERSION)
        number = int((await self._wait_for("AUTOPILOT_VERSION", self._clock() + timeout_s))["flight_sw_version"])
        kind = (await self._wait_for("HEARTBEAT", math.inf))["autopilot"]
        return Firmware(
            autopilot="PX4" if kind == MAV_AUTOPILOT_PX4 else f"autopilot {kind}",
            version=".".join(str(number >> shift & 0xFF) for shift in (24, 16, 8)),
        )

    def _receive(self, message: MavlinkMessage, _: object) -> None:
        """Called on MAVSDK's thread, one message at a time."""
        now = self._clock()
        if message.system_id != self._system_id or message.component_id != AUTOPILOT_COMPONENT:
            if message.message_name == "HEARTBEAT":
                self.received.add_other_heartbeat(json.loads(message.fields_json), now)
        elif message.message_name == TIME_SYNC:
            self._take_time(json.loads(message.fields_json), now)
        else:
            self.received.add(message.message_name, json.loads(message.fields_json), now)

    def _take_time(self, fields: Fields, now: float) -> None:
        """Takes the reply to a time exchange; the autopilot's own requests use the same message and are ignored."""
        sent_ns = int(fields["ts1"])
        if fields["tc1"] and sent_ns in self._time_syncs:
            self._time_syncs.remove(sent_ns)
            self.received.clock.add(1e-9 * sent_ns, 1e-9 * int(fields["tc1"]), now)

    async def _set_mode(self, mode: FlightMode) -> None:
        main, sub = next(numbers for numbers, name in MODES.items() if name == mode)
        await self._command(f"for {mode}", COMMAND_SET_MODE, 1, main, sub, refused=mode)

    async def _leave_offboard(self) -> None:
        """After landing, PX4 returns to the last mode requested, and cannot be armed if that was offboard."""
        if self.received.flight_mode() == "offboard":
            await self.hold()

    async def _request_streams(self) -> None:
        for name, (number, rate_hz) in STREAMS_HZ.items():
            try:
                await self._command(f"for {name}", COMMAND_SET_MESSAGE_INTERVAL, number, 1e6 / rate_hz)
            except AutopilotError as error:  # an older firmware may lack one; what needs it reports that
                _log.warning("%s", error)

    async def _command(self, what: str, command: int, *values: float, refused: str | None = None) -> None:
        """Sends a command until it is acknowledged. Raises AutopilotError if it is refused or not answered.

        ``refused``: what its checks may refuse with it, as in `Refusal.refused`; None: nothing.
        """
        loop, asked_s = asyncio.get_running_loop(), self._clock()
        answer: asyncio.Future[tuple[MavlinkDirectResult, str]] = loop.create_future()

        def on_answer(result: MavlinkDirectResult, ack: MavlinkMessage, _: object) -> None:
            loop.call_soon_threadsafe(_settle, answer, (result, ack.fields_json))

        numbers = {f"param{i}": float(value) for i, value in enumerate((*values, *[0.0] * (7 - len(values))), start=1)}
        fields = {"command": command, "confirmation": 0, **numbers}
        try:
            self._direct.send_command_async(self._message("COMMAND_LONG", fields), on_answer)
        except MavlinkDirectError as error:
            raise AutopilotError(f"MAVSDK could not ask the autopilot {what} ({error.result.name.lower()})") from error
        result, ack = await answer
        if result != MavlinkDirectResult.SUCCESS:
            raise AutopilotError(f"the autopilot was asked {what} and did not respond ({result.name.lower()})")
        verdict = int(json.loads(ack)["result"])
        if verdict != 0:
            why = "" if refused is None else await self._why(verdict, refused, asked_s)
            raise AutopilotError(f"the autopilot was asked {what}, which was {result_text(verdict)}{why}")

    async def _why(self, verdict: int, refused: str, asked_s: float) -> str:
        """The reasons of a refusal with their remedies, after the autopilot had time to send them."""

        def said() -> list[str]:
            now = self._clock()
            return self.received.recent_texts(now, now - asked_s)

        deadline = self._clock() + REASON_S
        while not said() and self._clock() < deadline:
            await asyncio.sleep(0.02)
        checks = [refusal for refusal in self.refusals() if refusal.refused in {refused, ""}]
        known = [*said(), *(f"{refusal.what}; {refusal.remedy}" for refusal in checks)]
        if known:
            return f": {'; '.join(known)}"
        remedy = f"; {REMEDIES_OF_RESULTS[verdict]}" if verdict in REMEDIES_OF_RESULTS else ""
        return f" without a reason{remedy}"

    def _message(self, name: str, fields: Fields) -> MavlinkMessage:
        target = {"target_system": self._system_id, "target_component": AUTOPILOT_COMPONENT}
        text = _JSON.encode(fields if name in UNTARGETED else {**target, **fields})
        return MavlinkMessage(name, 0, 0, self._system_id, AUTOPILOT_COMPONENT, text)

    async def _wait_for(self, name: str, deadline: float) -> Fields:
        while (message := self.received.newest(name)) is None:
            if self._clock() > deadline:
                raise AutopilotError(f"the autopilot sends no {name}; check the link")
            await asyncio.sleep(0.02)
        return message.fields

    async def _call(self, function: Callable[..., Any], *arguments: object) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._executor, function, *arguments)


def _configuration(system_id: int | None) -> Configuration:
    """An onboard computer of the same system: PX4 then knows it is no ground station."""
    configuration = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
    if system_id is not None:
        configuration.system_id = system_id
    return configuration


def _refuse_a_taken_port(address: str) -> None:
    """Raises AutopilotError for a UDP port in use: two programs can share it, and both would command the drone."""
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


def _serial_port(address: str, report: Callable[[str], None]) -> SerialPort | None:
    """None for a network address."""
    kind, _, rest = address.partition("://")
    device, _, baud = rest.rpartition(":")
    return SerialPort(device, int(baud), report) if kind == "serial" else None


async def _open(mavsdk: Mavsdk, address: str, port: SerialPort | None, executor: ThreadPoolExecutor) -> None:
    if port is not None:
        mavsdk.subscribe_raw_bytes_to_be_sent(port.send)
    opened = address if port is None else "raw://"
    result = await asyncio.get_running_loop().run_in_executor(executor, mavsdk.add_any_connection, opened)
    if port is not None:
        port.hand_to(mavsdk.pass_received_raw_bytes)
    if result != ConnectionResult.SUCCESS:
        reason = ConnectionResult(result).name.lower().replace("_", " ")
        raise AutopilotError(
            f"autopilot.address: {address} cannot be opened ({reason}); check the address and the cable"
        )


async def _find_system(
    mavsdk: Mavsdk, parameters: AutopilotParameters, deadline: float, timeout_s: float, clock: Clock
) -> System:
    """The autopilot; if any would do, after all had time for a heartbeat."""
    wanted = parameters.system_id
    first_heard_s = math.inf
    while True:
        systems = {int(system.get_system_id()): system for system in mavsdk.get_systems() if system.has_autopilot()}
        heard = sorted(systems)
        if heard:
            first_heard_s = min(first_heard_s, clock())
        known = wanted is not None or clock() - first_heard_s > services.HEARTBEAT.timeout
        chosen = next(iter(systems), None) if wanted is None else wanted
        found = systems.pop(chosen, None) if known and chosen is not None else None
        for system in systems.values():  # now: collected while MAVSDK is destroyed they would crash
            system.destroy()
        if wanted is None and len(heard) > 1:
            raise _ambiguous(parameters.address, heard)
        if found is not None:
            return found
        if clock() > deadline and (wanted is not None or not heard):
            others = f"; heard instead: {', '.join(map(str, heard))}" if heard else ""
            who = "no autopilot" if wanted is None else f"no autopilot with system id {wanted}"
            raise AutopilotError(
                f"{who} was heard at {parameters.address} within {timeout_s:g} s{others}; "
                "check autopilot.address, autopilot.system_id and that the autopilot is on"
            )
        await asyncio.sleep(0.05)


def _ambiguous(address: str, heard: Iterable[int]) -> AutopilotSettingError:
    return AutopilotSettingError(
        f"autopilot.system_id: is missing, and the autopilots of systems {', '.join(map(str, sorted(heard)))} are "
        f"heard at {address}; write the MAV_SYS_ID of this drone's own"
    )


def _autopilots(mavsdk: Mavsdk) -> set[int]:
    """System ids of the autopilots on the link."""
    found = set()
    for system in mavsdk.get_systems():
        if system.has_autopilot():
            found.add(int(system.get_system_id()))
        system.destroy()
    return found


class _Closed:
    """Replaces the plugin once the link is closed: running code must not call freed memory.

    A cancelled task runs once more if its time had come already.
    """

    def send_message(self, _message: object) -> None:
        """Refuses."""
        raise MavlinkDirectError(MavlinkDirectResult.CONNECTION_ERROR, "send_message()")

    def send_command_async(self, _message: object, _on_answer: object) -> None:
        """Refuses."""
        raise MavlinkDirectError(MavlinkDirectResult.CONNECTION_ERROR, "send_command_async()")


def _destroy(mavsdk: Mavsdk, _kept: Sequence[object]) -> None:
    """Destroys MAVSDK. The kept objects are released afterwards: earlier would crash."""
    mavsdk.destroy()


def _settle(answer: asyncio.Future[T], value: T) -> None:
    if not answer.done():
        answer.set_result(value)


def _to_logging(level: LogLevel, message: str, *_: object) -> bool:
    """Redirects MAVSDK's prints to the log; True tells MAVSDK that they are handled."""
    expected = message.startswith("No raw connection available. Subscription")  # `_open` subscribes before it connects
    _tell_once(logging.DEBUG if expected else _LOG_LEVELS[level], message)
    return True


@lru_cache(MAX_TEXTS)
def _tell_once(level: int, message: str) -> None:
    """Logs each text once: MAVSDK repeats its complaint about an absent autopilot every second."""
    _log.log(level, "%s", message)
