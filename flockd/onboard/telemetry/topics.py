"""The one table of published streams, and the fields of each message.

A key is `flockd/v1/<fleet>/<drone>/<topic>`; a message is a JSON object in UTF-8. Every number is finite or null.
Vectors are lists: NED is north, east, down. Times are seconds on the drone's monotonic clock.

`state` to `mission` follow from each step of the pilot; the others come from the daemon, at all times. Beside
the topics, a drone's daemon has a liveliness token `.../alive/<identity>`, whose identity no other process has. It
replies to a query for `.../about` with an `AboutMessage`, for `.../time` with a `TimeMessage`, and for
`.../image/<camera>` with a small JPEG of what that camera sees. A query for `.../ask/hold`, `land`, `resume`, `goto` or
`velocity` carries an `AskMessage`; the reply is an `AnswerMessage`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TypedDict

from flockd.core import services

PREFIX = "flockd/v1"
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,200}")


def is_name(name: str) -> bool:
    """Whether it fits into a key."""
    return _NAME.fullmatch(name) is not None


def checked_name(name: str) -> str:
    """The name; raises ValueError for one that does not fit into a key."""
    if not is_name(name):
        raise ValueError(f"{name!r} does not fit into a key; use letters, digits, '_', '.' and '-'")
    return name


class StateMessage(TypedDict):
    """What the drone believes of itself."""

    time_s: float
    height_m: float
    """Above ground, up positive."""
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    """Clockwise from north, -180 to 180."""
    velocity_ned: list[float] | None
    """m/s, as the flock law used it; null before there is one."""
    position_ne: list[float] | None
    """Metres from home, as the autopilot has it; null where it has none. For people: the flock law does not use it."""
    home_deg: list[float] | None
    """Latitude and longitude of home; null where the autopilot does not know it."""


class NeighbourMessage(TypedDict):
    """One tracked drone, as its observer sees it."""

    track: int
    position_ned: list[float]
    """Metres from the observer."""
    velocity_ned: list[float]
    """m/s over ground."""
    position_sigma_m: float
    velocity_sigma_m_s: float
    age_s: float
    unseen_s: float
    confirmed: bool


class NeighboursMessage(TypedDict):
    """All drones that this one tracks."""

    time_s: float
    neighbours: list[NeighbourMessage]


class ObstaclesMessage(TypedDict):
    """The nearest obstacle in each of 72 directions, clockwise from north; not sent where none are looked for."""

    time_s: float
    range_m: list[float]
    """Level, from the drone's centre; null where nothing was seen."""
    seen_m: list[float]
    """How far each direction is known to be free or measured; 0 where it was not looked at."""


class CommandMessage(TypedDict):
    """What the flock law asks of the autopilot."""

    time_s: float
    velocity_ne: list[float]
    """m/s, north and east, after limits."""
    acceleration_ne: list[float]
    """m/s^2, north and east, after limits."""
    yaw_deg: float | None


class MissionMessage(TypedDict):
    """How far the drone is with its mission; not sent before its pilot's first good step."""

    time_s: float
    kind: str
    sentence: str
    """What it does now, for people."""
    goal_ne: list[float] | None
    """Metres from home; null where there is no goal."""
    goal_height_m: float | None
    """null: as high as when the flight began."""
    position_ne: list[float] | None
    """Metres from home, as the autopilot has it."""
    arrived: bool
    """At the last goal."""


class EventMessage(TypedDict):
    """Something that happened once."""

    time_s: float
    event: str


class ReasonMessage(TypedDict):
    """Something that is the matter."""

    event: str
    """For programs: a value of `flockd.flight.safety.Event`, or the name of an autopilot's reason to refuse, as in
    `flockd.onboard.autopilot.refusal_reasons`."""
    sentence: str
    """For people."""


class TakenOrderMessage(TypedDict):
    """The last order that one operator gave and the drone took."""

    operator: str
    command: str
    sequence: int
    age_s: float


class FlightMessage(TypedDict):
    """Who flies the drone, and why."""

    time_s: float
    state: str
    """`idle`, `ready`, `normal`, `degraded`, `hover`, `asking` (for Hold or worse) or `silent` (handed over)."""
    reasons: list[ReasonMessage]
    """What is the matter, the worst first; then why the autopilot would refuse to arm or to fly offboard."""
    flight_mode: str
    """The autopilot's."""
    armed: bool | None
    in_air: bool | None
    heartbeat_age_s: float | None
    """Age of the autopilot's newest heartbeat; null before the first."""
    heartbeats_lost: int
    """Of the autopilot's, since the start, while its other messages came."""
    battery_share: float | None
    """0 to 1."""
    height_m: float | None
    """Above home, up positive."""
    velocity_trim: list[float]
    """m/s north and east, added to the pilot's commands: the autopilot's velocity less the cameras'."""
    velocity_error_m_s: float
    """By how much the velocity was off its setpoints in the last ten seconds, root mean square."""
    silence: str | None
    """Why no setpoint goes to the autopilot; null while they do."""
    setpoints_sent: int
    setpoints_missed: int
    """Deadlines that this computer was too busy to keep."""
    orders: list[TakenOrderMessage] | None
    """Of the last minute, one of each operator, the newest first."""
    orders_refused: int | None
    """Since the start."""


class CameraMessage(TypedDict):
    """How one camera is doing."""

    age_s: float | None
    """Since its newest usable frame; null before the first."""
    fault: str | None
    counts: dict[str, int]
    """Frames since the start, by what became of them."""


class ComputerMessage(TypedDict):
    """How the computer keeps up. Counts are since the start."""

    time_s: float
    cameras: dict[str, CameraMessage]
    load: float
    """How long the steps take (95th percentile) over how long they may."""
    steps: int
    steps_failed: int
    network_faults: int
    """Outputs that are NaN, infinite or out of range."""
    networks_stuck: int
    """Calls that were ended because they passed their deadline."""
    loop_lag_s: float
    """How late the event loop was, at worst, in the last second."""
    temperature_c: float | None
    messages_lost: int
    recording: str | None
    """The file, or why the recording ended; null where nothing is recorded."""


class AboutMessage(TypedDict):
    """What a drone flies with."""

    version: str
    configuration: dict[str, object]
    """Every key of the drone's configuration, defaults filled in."""
    commands: list[str]
    """What operators may ask of it."""


class TimeMessage(TypedDict):
    """The drone's clocks as it replies: for its watchers, who learn from it the delay of the link too."""

    time_s: float
    """Monotonic."""
    wall_s: float
    """Seconds since 1970, UTC."""
    identity: str | None
    """As in the liveliness token."""


class OrderMessage(TypedDict, total=False):
    """What `goto` and `velocity` ask: a goal in metres or degrees, or a velocity; what is left out stays as it is."""

    north_m: float
    """From the mission's origin; so `east_m`."""
    east_m: float
    latitude_deg: float
    longitude_deg: float
    velocity_ne: list[float]
    """m/s, north and east."""
    height_m: float
    """Above the ground at home."""
    speed_m_s: float
    """On the way to a goal."""


class AskMessage(TypedDict):
    """An operator's command. A drone takes each once, in order and while it is new."""

    identity: str
    """The drone's, of its liveliness token: another drone of the same name refuses it."""
    operator: str
    """Who asks, for people; who may ask is decided by the access rules of the network."""
    session: str
    """Of the program that asks, from its start to its end."""
    sequence: int
    """Counts up within the session."""
    time_s: float
    """The drone's own clock, as its reply to `time` had it just before."""
    order: dict[str, object] | None
    """An `OrderMessage` for `goto` and `velocity`; else null."""


class AnswerMessage(TypedDict):
    """What became of an operator's command."""

    accepted: bool
    """The drone will try; `flight` reports the result."""
    sentence: str


@dataclass(frozen=True)
class Topic:
    """One published stream of each drone."""

    key: str
    type: type
    """The TypedDict that documents its messages."""
    rate_hz: float | None
    """Expected rate at the paper's step of 0.5 s; None: only when something happens."""
    stale_after_s: float | None
    """Older than this, a message says nothing of now; None: it keeps its meaning."""
    recorded: bool
    """By itself; what follows from a step is recorded as that step's input and output."""


_STEP = services.STEP_TOPIC.rate_hz, services.STEP_TOPIC.timeout
_COMPUTER = services.COMPUTER_TOPIC.rate_hz, services.COMPUTER_TOPIC.timeout

TOPICS = {
    topic.key: topic
    for topic in (
        Topic("state", StateMessage, *_STEP, recorded=False),
        Topic("neighbours", NeighboursMessage, *_STEP, recorded=False),
        Topic("obstacles", ObstaclesMessage, *_STEP, recorded=False),
        Topic("command", CommandMessage, *_STEP, recorded=False),
        Topic("mission", MissionMessage, *_STEP, recorded=False),
        Topic("events", EventMessage, rate_hz=None, stale_after_s=None, recorded=True),
        Topic("flight", FlightMessage, *_STEP, recorded=True),
        Topic("computer", ComputerMessage, *_COMPUTER, recorded=True),
    )
}
