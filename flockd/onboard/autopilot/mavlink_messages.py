"""Decodes the autopilot's MAVLink messages, without MAVSDK and without I/O.

The newest message of each kind is kept, so that no queue grows and the state is known at any time. Values of
enumerations are checked on arrival: one that is not known here counts as unknown.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from flockd.core import services
from flockd.core.messages import FloatArray, RangeReading, VehicleState
from flockd.flight.geometry import rotation_from_quaternion
from flockd.onboard.autopilot.autopilot_status import AutopilotStatus, FlightMode, LandedState, mode_of
from flockd.onboard.autopilot.clock_sync import ClockEstimate, ClockSync, StampMonitor
from flockd.onboard.autopilot.refusals import CheckEvents, Refusal, refusals
from flockd.onboard.autopilot.watches import MOST_SPEED, LocalFrame, SetpointWatch, WatchedParameters

Fields = Mapping[str, Any]

MAV_MODE_FLAG_SAFETY_ARMED = 128
MAV_STATE_CRITICAL = 5
GPS_FIX_3D = 3
ESTIMATOR_ATTITUDE, ESTIMATOR_VELOCITY_HORIZONTAL = 1, 2
ESTIMATOR_POSITION_RELATIVE, ESTIMATOR_POSITION_ABSOLUTE, ESTIMATOR_HEIGHT = 8, 16, 32

LANDED_STATES: tuple[LandedState, ...] = ("unknown", "ground", "air", "taking off", "landing")
"""By MAV_LANDED_STATE."""
RESULTS = (
    "accepted",
    "refused for now",
    "denied",
    "not supported",
    "failed",
    "still in progress",
    "cancelled",
    "refused as COMMAND_LONG",
    "refused as COMMAND_INT",
    "refused for its frame",
    "refused because another station has control",
)
"""By MAV_RESULT."""
VALUES: Mapping[str, tuple[str, range]] = {
    "EXTENDED_SYS_STATE": ("landed_state", range(len(LANDED_STATES))),
    "GPS_RAW_INT": ("fix_type", range(9)),  # GPS_FIX_TYPE
    "HEARTBEAT": ("system_status", range(9)),  # MAV_STATE
    "SYS_STATUS": ("battery_remaining", range(-1, 101)),  # -1 is MAVLink's own word for unknown
}
"""What a field of these messages may be: of the MAVLink dialect `common`."""
FACES_DOWN = 25
"""MAV_SENSOR_ROTATION_PITCH_270 of MAV_SENSOR_ORIENTATION: the sensor faces down."""
RANGES_KEPT = 200
"""Arrival times of its readings that are kept, for their rate."""
FULL_SIGNAL, NO_SIGNAL = 100, 1
"""Values of DISTANCE_SENSOR's `signal_quality`, in percent; 0 means that it is not known."""
QUATERNION_TOLERANCE = 0.1
"""Largest deviation of a quaternion's norm from 1; beyond it, the attitude is refused."""
HOME_TOLERANCE_M = 0.5
"""Shortest move of home in flight that is reported: estimators drift."""
DISTANCE_SENSOR = "DISTANCE_SENSOR"
STAMPED = frozenset({"ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", DISTANCE_SENSOR})
"""Messages whose `time_boot_ms` gives their time of validity."""
MOST_ERROR_S = 0.005
"""Largest error of a clock at which stamps are more precise than arrival times."""
LONGEST_DELAY_S = 1.0
"""Largest age of a stamp at arrival; older ones are not used."""
RESTARTED_MS = 1000
"""A stamp that goes back by this much comes from a restarted clock."""
OTHER_CLOCK_MS, CLOCK_STAMPS, CLOCK_RETURNS = 100, 50, 3
"""Two autopilots have one id if, of the last 50 stamps, 3 are 100 ms or more older than the stamp before: the stamps of
two clocks alternate. Stamps go back only once at a restart, and by less if packets of one autopilot overtake each
other. Packets that arrive over a second, slower way too have stamps that were received before."""
MAV_SEVERITY_WARNING = 4
TEXTS_KEPT = 20
TEXT_MEMORY_S = 10.0
"""Time for which a text counts as the reason of a refusal, and is not reported again."""
MAV_TYPE_ONBOARD_CONTROLLER = 18
CHUNKS_S = 0.2
"""Longest time between the first and the last chunk of a text."""
TEXT_CHUNK = 50
"""Characters of a full STATUSTEXT; a shorter one is the last of its text."""
LONGEST_TEXT = 125
"""Characters of a text that flockd sends."""


@dataclass(frozen=True)
class ReceivedMessage:
    """A message, and its arrival time on the link's clock."""

    time_s: float
    fields: Fields


class ReceivedMessages:
    """The newest message of each kind. Call `add` on one thread, everything else on any."""

    def __init__(self, report: Callable[[str], None], max_gap_s: float = services.SETPOINT.timeout) -> None:
        """``report`` is called by `add` with one sentence for the first of each unknown value, for a home that moves or
        a frame that jumps in flight, for a landing, a restart, a second autopilot of its id, lost heartbeats, a wrong
        clock, and for texts of the autopilot that are warnings or worse. ``max_gap_s``: longest gap between setpoints
        that flockd bridges."""
        self._report = report
        self._newest: dict[str, ReceivedMessage] = {}
        self._unknown_values: set[str] = set()
        self._home: FloatArray | None = None
        self._home_deg: FloatArray | None = None
        self._flies = False
        """In the air, or seen there and not disarmed since: a landed state alone does not end a flight."""
        self._home_moved = False
        self._landed = False
        self._text = StatusText()
        self._texts: deque[tuple[float, str]] = deque(maxlen=TEXTS_KEPT)
        """Texts that are warnings or worse, with their times."""
        self.ground_range: RangeReading | None = None
        """The newest reading of the range finder that faces down."""
        self.ranges_s: deque[float] = deque(maxlen=RANGES_KEPT)
        """Arrival times of its last readings."""
        self._other_computer_s = -math.inf
        self._heard_s = -math.inf
        """Arrival time of its newest message."""
        self._max_gap_s = max_gap_s
        self._boot_ms = self._stamp_ms = 0
        self._returns: deque[bool] = deque(maxlen=CLOCK_STAMPS)
        self._stamps_ms: deque[int] = deque(maxlen=CLOCK_STAMPS)
        self._board: list[int] | None = None
        """The serial number of its board's processor, of PX4's simulator its instance; None: not known."""
        self.are_two = False
        """Whether stamps of two clocks or numbers of two boards were received: another autopilot has the same id."""
        self.restarts = 0
        """Restarts of the autopilot since flockd listens."""
        self.heartbeats_lost = 0
        """Heartbeats that were missing while other messages came."""
        self._frame = LocalFrame()
        self.parameters = WatchedParameters(report)
        self.setpoints = SetpointWatch(report, self.parameters.values)
        self.check_events = CheckEvents()
        self.clock = ClockSync()
        self._stamps = StampMonitor()

    def add(self, name: str, fields: Fields, time_s: float) -> None:
        """Takes a message's name, fields as MAVSDK decodes them to JSON, with NaN as null, and arrival time."""
        self._heard_s = time_s
        begun = self._text.begun
        if begun is not None and name != "STATUSTEXT" and time_s - begun.time_s > CHUNKS_S:
            self.add("STATUSTEXT", {**begun.fields, "chunk_seq": 1, "text": ""}, time_s)  # it has no further chunk
        if name == "STATUSTEXT":
            whole = self._text.joined(fields, time_s)
            if whole is None:
                return
            fields = {**fields, "text": whole}
            self._take_text(whole.strip(), int(fields.get("severity") or 0), time_s)
        if name == "EVENT":
            self.check_events.add(fields, time_s)
        elif name == "CURRENT_EVENT_SEQUENCE":
            self.check_events.announce(fields)
        elif name == "HEARTBEAT":
            self._count_heartbeats(time_s)
        elif name == "ATTITUDE_QUATERNION":
            self._notice_restart(int(fields.get("time_boot_ms") or 0))
        elif name == "POSITION_TARGET_LOCAL_NED":
            followed = [math.nan if fields.get(key) is None else float(fields[key]) for key in ("vx", "vy")]
            self.setpoints.followed(time_s, *followed, offboard=self.flight_mode() == "offboard")
        fields = self._without_jumps(name, fields)
        if name in STAMPED:
            arrived_s, time_s = time_s, self._stamped_s(name, fields, time_s)
            if name == DISTANCE_SENSOR and fields.get("orientation") == FACES_DOWN:
                self.ranges_s.append(arrived_s)
                self.ground_range = _range_reading(fields, time_s)
        self._newest[name] = ReceivedMessage(time_s, self._checked(name, fields))
        self._follow(name, time_s)

    def _follow(self, name: str, time_s: float) -> None:
        """Updates the state after a message."""
        if name in ("HEARTBEAT", "EXTENDED_SYS_STATE"):
            status = self.status(time_s)
            self._flies = status.in_air or (self._flies and status.armed)
            self._home_moved = self._home_moved and self._flies
            if not self._flies:
                self._frame.restart()
                self._take_home()
            self._take_landing(status.landed_state)
        elif name == "HOME_POSITION":
            self._take_home()
        elif name == "AUTOPILOT_VERSION" and isinstance(board := self._fields(name).get("uid2"), list) and any(board):
            if self._board not in (None, board):
                self._tell_two()
            self._board = board
        if name in ("HEARTBEAT", "CURRENT_MODE") and self.flight_mode() != "offboard":
            self._frame.large = False  # the flight with it is over

    def add_other_heartbeat(self, fields: Fields, time_s: float) -> None:
        """Takes a HEARTBEAT of another component on the link."""
        if fields.get("type") == MAV_TYPE_ONBOARD_CONTROLLER:
            self._other_computer_s = time_s

    def recent_texts(self, now_s: float, memory_s: float) -> list[str]:
        """Warnings and graver texts of the autopilot in the last seconds, each once."""
        return list(dict.fromkeys(text for time_s, text in list(self._texts) if now_s - time_s < memory_s))

    def refusals(self, now_s: float, *, streams: bool) -> tuple[Refusal, ...]:
        """Why the autopilot would refuse to arm or to fly offboard; ``streams``: flockd sends setpoints."""
        return refusals(
            self.status(now_s),
            self.check_events,
            int(self._fields("HEARTBEAT").get("system_status") or 0),
            now_s - self._other_computer_s < services.OTHER_HEARTBEAT.timeout,
            streams=streams,
        )

    def _count_heartbeats(self, time_s: float) -> None:
        before = self._newest.get("HEARTBEAT")
        if before is None:
            return
        lost = round((time_s - before.time_s) * services.HEARTBEAT.rate_hz) - 1
        if lost > 0:
            if self.heartbeats_lost == 0:
                self._report(
                    f"the autopilot's heartbeat did not come for {time_s - before.time_s:.1f} s; further ones that are "
                    "lost are counted (`heartbeats_lost`)"
                )
            self.heartbeats_lost += lost

    def _notice_restart(self, boot_ms: int) -> None:
        """Resets what a restart invalidates: its clock, the numbers of its events, and its checks.

        An armed autopilot cannot restart: then a stamp from the past is wrong, or another sender's.
        """
        new = len(self._stamps_ms) == CLOCK_STAMPS and boot_ms not in self._stamps_ms
        self._returns.append(new and boot_ms < self._stamp_ms - OTHER_CLOCK_MS)
        self._stamps_ms.append(boot_ms)
        self._stamp_ms = boot_ms
        if sum(self._returns) >= CLOCK_RETURNS:
            self._tell_two()
        if self.are_two:
            return
        if boot_ms < self._boot_ms - RESTARTED_MS:
            if int(self._fields("HEARTBEAT").get("base_mode") or 0) & MAV_MODE_FLAG_SAFETY_ARMED:
                return
            self.restarts += 1
            self._board = None
            self.check_events, self.clock = CheckEvents(), ClockSync()
            self._report("the autopilot has started anew")
        self._boot_ms = boot_ms

    def _tell_two(self) -> None:
        if not self.are_two:
            self._report("two autopilots with the same system id are heard; their messages cannot be told apart")
        self.are_two = True

    def _take_text(self, text: str, severity: int, time_s: float) -> None:
        if severity > MAV_SEVERITY_WARNING:
            return
        if text not in self.recent_texts(time_s, TEXT_MEMORY_S):
            self._report(f"the autopilot says: {text}")
        self._texts.append((time_s, text))

    def trusted_clock(self) -> ClockEstimate | None:
        """The autopilot's clock; None while it is not known, or contradicts the stamps of its messages."""
        return None if self._stamps.lies else self.clock.estimate

    def _stamped_s(self, name: str, fields: Fields, arrived_s: float) -> float:
        """Time of validity on this computer's clock, by the autopilot's stamp; else the time of arrival."""
        clock, boot_ms = self.clock.estimate, fields.get("time_boot_ms")
        if boot_ms is None:
            return arrived_s
        stamp_s, lied = 1e-3 * (boot_ms + 0.5), self._stamps.lies  # the stamp is truncated to a millisecond
        if name == DISTANCE_SENSOR:  # its age is its sensor's delay, not the clock's
            believed = not lied
        else:
            believed = self._stamps.believes(clock, stamp_s, arrived_s)
            self._report_clock(lied)
        if clock is None or not believed or clock.error_s > MOST_ERROR_S:
            return arrived_s
        time_s = min(clock.local_s(stamp_s), arrived_s)
        return time_s if arrived_s - time_s <= LONGEST_DELAY_S else arrived_s

    def _report_clock(self, lied: bool) -> None:
        if self._stamps.lies and not lied:
            self._report(
                f"the autopilot's clock, by TIMESYNC, is {abs(self._stamps.delay_s):.2f} s off the stamps of its "
                "messages; they count from when they arrive"
            )
        elif lied and not self._stamps.lies:
            self._report("the autopilot's clock agrees with its messages again; their stamps are used")

    @property
    def home_down_m(self) -> float | None:
        """Home below the estimator's origin; None: not known yet."""
        return None if self._home is None else float(self._home[2])

    @property
    def height_m(self) -> float:
        """Height above home of the newest position; NaN before the first."""
        place = _numbers(self._fields("LOCAL_POSITION_NED"), "x", "y", "z")
        return math.nan if place is None else float((self.home_down_m or 0.0) - place[2])

    def _without_jumps(self, name: str, fields: Fields) -> Fields:
        """The fields with the position in a frame that does not jump in flight."""
        jump: str | None = None
        stamp_s = 1e-3 * float(fields.get("time_boot_ms") or 0)
        if name == "LOCAL_POSITION_NED":
            place, velocity = _numbers(fields, "x", "y", "z"), _numbers(fields, "vx", "vy", "vz")
            if place is None or velocity is None:
                return fields
            jump = self._frame.move(stamp_s, place, velocity)
            if self._flies:
                fields = {**fields, **dict(zip("xyz", (place + self._frame.offset).tolist(), strict=True))}
        elif name == "ATTITUDE_QUATERNION":
            attitude, rate = _attitude(fields), _numbers(fields, "rollspeed", "pitchspeed", "yawspeed")
            if attitude is not None and rate is not None:
                jump = self._frame.turn(stamp_s, attitude, rate)
        if jump is not None and self._flies:
            self._report(jump)
        elif jump is not None:
            self._frame.restart()  # on the ground no goal or height depends on it yet
        return fields

    def _take_home(self) -> None:
        """Takes home once a flight: if it moved in flight, the height band and the fence would move too."""
        fields = self._fields("HOME_POSITION")
        sent, home_e7 = _vector(fields, "x", "y", "z"), _vector(fields, "latitude", "longitude")
        if sent is None:
            return
        home = sent + self._frame.offset
        if self._home is None or not self._flies:
            self._home = home
            self._home_deg = None if home_e7 is None else home_e7 * 1e-7
            return
        # PX4 may still send it in the frame before a jump.
        moved_m = min(np.linalg.norm(one - self._home) for one in (sent, home))
        if not self._home_moved and moved_m > HOME_TOLERANCE_M:
            self._home_moved = True
            self._report(
                f"the autopilot's home moved by {moved_m:.1f} m in flight; "
                "height band and fence stay where they were until it is disarmed"
            )

    def _take_landing(self, landed_state: LandedState) -> None:
        landed = self._flies and (self._landed or landed_state == "ground")
        if landed and not self._landed:
            self._report("the autopilot reports that the drone is on the ground, still armed")
        self._landed = landed

    def newest(self, name: str) -> ReceivedMessage | None:
        """The newest message of a kind; None before the first."""
        return self._newest.get(name)

    def status(self, now_s: float) -> AutopilotStatus:
        """The autopilot's status by these messages."""
        heartbeat = self._newest.get("HEARTBEAT", ReceivedMessage(-math.inf, {}))
        percent = self._fields("SYS_STATUS").get("battery_remaining")
        landed_state = self._fields("EXTENDED_SYS_STATE").get("landed_state")
        fix_type = self._fields("GPS_RAW_INT").get("fix_type")
        return AutopilotStatus(
            time_s=now_s,
            heartbeat_age_s=now_s - heartbeat.time_s,
            message_age_s=now_s - self._heard_s,
            flight_mode=self.flight_mode(),
            armed=bool(heartbeat.fields.get("base_mode", 0) & MAV_MODE_FLAG_SAFETY_ARMED),
            failsafe=heartbeat.fields.get("system_status") == MAV_STATE_CRITICAL or self._would_return(),
            landed_state="unknown" if landed_state is None else LANDED_STATES[landed_state],
            battery_share=None if percent in {None, -1} else 0.01 * percent,
            estimate_ok=_estimate_ok(self._newest.get("ESTIMATOR_STATUS")),
            gps_ok=None if fix_type is None else fix_type >= GPS_FIX_3D,
            position_ned=_vector(self._fields("LOCAL_POSITION_NED"), "x", "y", "z"),
            home_ned=self._home,
            foreign_setpoints=self.setpoints.seen,
            fastest_m_s=self.parameters.values.get(MOST_SPEED, math.inf),
            parameter_fault=self.parameters.fault(self._max_gap_s),
            frame_jumped=self._frame.large,
        )

    def vehicle_state(self) -> VehicleState | None:
        """Attitude, height above home and velocity, with the age of the older; None before they are known.

        Before home is known, the height is above the estimator's origin.
        """
        attitude, position = self._newest.get("ATTITUDE_QUATERNION"), self._newest.get("LOCAL_POSITION_NED")
        if attitude is None or position is None:
            return None
        place = _vector(position.fields, "x", "y", "z")
        velocity = _vector(position.fields, "vx", "vy", "vz")
        quaternion = _attitude(attitude.fields)
        if place is None or velocity is None or quaternion is None:
            return None
        return VehicleState(
            time_s=min(attitude.time_s, position.time_s),
            R_ned_body=rotation_from_quaternion(np.array([*quaternion[1:], quaternion[0]])),
            height_m=float((self.home_down_m or 0.0) - place[2]),
            velocity_ned=velocity,
            position=None if self._home is None else (place - self._home)[:2],
            home_deg=self._home_deg,
            ground_range=self.ground_range,
        )

    def flight_mode(self) -> FlightMode:
        """By the newer of heartbeat and CURRENT_MODE; `other` for a mode that is not in `MODES`."""
        reports = [self._newest[name] for name in ("HEARTBEAT", "CURRENT_MODE") if name in self._newest]
        if not reports:
            return "unknown"
        return mode_of(max(reports, key=lambda message: message.time_s).fields["custom_mode"])

    def _would_return(self) -> bool:
        """Whether it was asked for offboard and flies another mode: the next setpoint would return it to offboard."""
        asked = self._fields("CURRENT_MODE").get("intended_custom_mode") or 0
        return mode_of(asked) == "offboard" and self.flight_mode() != "offboard"

    def _fields(self, name: str) -> Fields:
        message = self._newest.get(name)
        return {} if message is None else message.fields

    def _checked(self, name: str, fields: Fields) -> Fields:
        """The fields with None for each value that is not in `VALUES`."""
        field, known = VALUES.get(name, ("", range(0)))
        if fields.get(field) is None or fields[field] in known:
            return fields
        value = f"{name}.{field} = {fields[field]}"
        if value not in self._unknown_values:
            self._report(f"the autopilot sends {value}, which flockd does not know; it counts as unknown")
        self._unknown_values.add(value)
        return {**fields, field: None}


class StatusText:
    """Joins the chunks of a STATUSTEXT, which carry an id and a number from 0.

    An id of 0 is for texts of one chunk; but PX4's first text has it, so a full chunk of id 0 may have more.
    """

    def __init__(self) -> None:
        self._id, self._chunks = 0, [""]
        self.begun: ReceivedMessage | None = None
        """A text of id 0 that may have more chunks."""

    def joined(self, fields: Fields, time_s: float) -> str | None:
        """The whole text with its last chunk, None before; dots stand for a lost chunk."""
        text = str(fields.get("text") or "").partition("\0")[0]
        number, chunk = fields.get("id") or 0, fields.get("chunk_seq") or 0
        may_go_on = number == chunk == 0 and len(text) >= TEXT_CHUNK
        self.begun = ReceivedMessage(time_s, fields) if may_go_on else None
        if number == chunk == 0 and self.begun is None:
            return text
        if number != self._id or chunk == 0:
            self._id, self._chunks = number, []
        if chunk > len(self._chunks):
            self._chunks += ["..."] * (chunk - len(self._chunks))
        self._chunks.append(text)
        return "".join(self._chunks) if len(text) < TEXT_CHUNK else None


def text_chunks(text: str, number: int) -> Iterator[Fields]:
    """A text as STATUSTEXT messages, without their severity; ``number``, above 0, identifies one of several chunks.

    The last ends within its 50 bytes. PX4 would cut a single chunk of 50 bytes to 49, and logs at most 126.
    """
    sent = text if text.isascii() else text.encode("ascii", "replace").decode()
    sent = sent if len(sent) <= LONGEST_TEXT else f"{sent[: LONGEST_TEXT - 3]}..."
    if len(sent) < TEXT_CHUNK:
        yield {"id": 0, "chunk_seq": 0, "text": sent}
        return
    for chunk in range(len(sent) // TEXT_CHUNK + 1):
        yield {"id": number, "chunk_seq": chunk, "text": sent[TEXT_CHUNK * chunk :][:TEXT_CHUNK]}


def result_text(result: int) -> str:
    """The meaning of a MAV_RESULT, for people."""
    return RESULTS[result] if 0 <= result < len(RESULTS) else f"answered with the unknown result {result}"


def _range_reading(fields: Fields, time_s: float) -> RangeReading:
    """In metres; a missing field is not known."""
    centimetres = [fields.get(f"{name}_distance") for name in ("current", "min", "max")]
    current, least, most = (None if value is None else 0.01 * float(value) for value in centimetres)
    signal = int(fields.get("signal_quality") or 0)
    return RangeReading(
        time_s,
        math.nan if current is None else current,
        min_m=least,
        max_m=most or None,
        quality=None if signal == 0 else min((signal - NO_SIGNAL) / (FULL_SIGNAL - NO_SIGNAL), 1.0),
    )


def _numbers(fields: Fields, *names: str) -> list[float] | None:
    """The named numbers; None if one is missing, infinite, or null, which stands for NaN."""
    numbers: list[Any] = [fields.get(name) for name in names]
    return None if any(number is None or not math.isfinite(number) for number in numbers) else numbers


def _vector(fields: Fields, *names: str) -> FloatArray | None:
    """The same as an array."""
    numbers = _numbers(fields, *names)
    return None if numbers is None else np.array(numbers, dtype=float)


def _attitude(fields: Fields) -> list[float] | None:
    """Quaternion w x y z from the body to NED, of about unit length."""
    quaternion = _numbers(fields, "q1", "q2", "q3", "q4")
    known = quaternion is not None and abs(math.hypot(*quaternion) - 1.0) <= QUATERNION_TOLERANCE
    return quaternion if known else None


def _estimate_ok(message: ReceivedMessage | None) -> bool | None:
    if message is None:
        return None
    flags = int(message.fields["flags"])
    needed = ESTIMATOR_ATTITUDE | ESTIMATOR_VELOCITY_HORIZONTAL | ESTIMATOR_HEIGHT
    position = ESTIMATOR_POSITION_RELATIVE | ESTIMATOR_POSITION_ABSOLUTE
    return flags & needed == needed and bool(flags & position)
