"""The table of published streams, and the fields of each message.

A key is `flockd/v1/<fleet>/<drone>/<topic>`; a message is a JSON object in UTF-8. Every number is finite or null.
Vectors are lists: NED is north, east, down. Times are seconds on the drone's monotonic clock.

`state` to `mission` follow from each step of the pilot; the daemon sends the others at all times. Besides the topics, a
drone's daemon has a liveliness token `.../alive/<identity>`, whose identity no other process has. It replies to a query
for `.../about` with an `AboutMessage`, for `.../time` with a `TimeMessage`, and for `.../image/<camera>` with a small
JPEG of that camera's image. A query for `.../ask/hold`, `land`, `resume`, `goto` or `velocity` carries an `AskMessage`;
the reply is an `AnswerMessage`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TypedDict

from flockd.core import services

PREFIX = "flockd/v1"
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,200}")


def is_name(name: str) -> bool:
    """Whether a name fits into a key."""
    return _NAME.fullmatch(name) is not None


def checked_name(name: str) -> str:
    """The name; raises ValueError if it does not fit into a key."""
    if not is_name(name):
        raise ValueError(f"{name!r} does not fit into a key; use letters, digits, '_', '.' and '-'")
    return name


class StateMessage(TypedDict):
    """The drone's own state."""

    time_s: float
    height_m: float
    """Above ground, up positive."""
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    """Clockwise from north, -180 to 180."""
    velocity_ned: list[float] | None
    """m/s, as the flocking law used it; null: not known yet."""
    position_ne: list[float] | None
    """Metres from home by the autopilot; null: not known. For people: the flocking law does not use it."""
    home_deg: list[float] | None
    """Latitude and longitude of home; null: the autopilot does not know it."""


class NeighbourMessage(TypedDict):
    """One tracked drone, relative to its observer."""

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
    """The nearest obstacle in each of 72 directions, clockwise from north; not sent without obstacle detection."""

    time_s: float
    range_m: list[float]
    """Horizontal, from the drone's centre; null: no obstacle seen."""
    seen_m: list[float]
    """Distance up to which each direction is known to be free or measured; 0: not observed."""


class CommandMessage(TypedDict):
    """The flocking law's command to the autopilot."""

    time_s: float
    velocity_ne: list[float]
    """m/s, north and east, after limits."""
    acceleration_ne: list[float]
    """m/s^2, north and east, after limits."""
    yaw_deg: float | None


class MissionMessage(TypedDict):
    """Progress of the mission; not sent before the pilot's first valid step."""

    time_s: float
    kind: str
    sentence: str
    """What the mission does now, for people."""
    goal_ne: list[float] | None
    """Metres from home; null: no goal."""
    goal_height_m: float | None
    """null: the height at the start of the flight."""
    position_ne: list[float] | None
    """Metres from home, by the autopilot."""
    arrived: bool
    """Whether the drone is at the last goal."""


class EventMessage(TypedDict):
    """An event, sent once."""

    time_s: float
    event: str


class ReasonMessage(TypedDict):
    """A present fault or other reason."""

    event: str
    """For programs: a value of `flockd.flight.safety.Event`, or the name of an autopilot's reason to refuse, as in
    `flockd.onboard.autopilot.refusal_reasons`."""
    sentence: str
    """For people."""


class TakenOrderMessage(TypedDict):
    """The last order of one operator that the drone accepted."""

    operator: str
    command: str
    sequence: int
    age_s: float


class FlightMessage(TypedDict):
    """Which program or person flies the drone, and why."""

    time_s: float
    state: str
    """`idle`, `ready`, `normal`, `degraded`, `hover`, `asking` (for Hold or worse) or `silent` (handed over)."""
    reasons: list[ReasonMessage]
    """The present events, the worst first; then why the autopilot would refuse to arm or to fly offboard."""
    flight_mode: str
    """The autopilot's flight mode."""
    armed: bool | None
    in_air: bool | None
    heartbeat_age_s: float | None
    """Age of the autopilot's newest heartbeat; null before the first."""
    heartbeats_lost: int
    """Heartbeats of the autopilot that were missing since the start, while its other messages came."""
    battery_share: float | None
    """0 to 1."""
    height_m: float | None
    """Above home, up positive."""
    velocity_trim: list[float]
    """m/s north and east, added to the pilot's commands: the autopilot's velocity minus the cameras'."""
    velocity_error_m_s: float
    """Root mean square of the velocity's deviation from its setpoints in the last ten seconds."""
    silence: str | None
    """Why no setpoints are sent to the autopilot; null: they are."""
    setpoints_sent: int
    setpoints_missed: int
    """Deadlines that this computer missed."""
    orders: list[TakenOrderMessage] | None
    """Accepted orders of the last minute, one of each operator, the newest first."""
    orders_refused: int | None
    """Orders refused since the start."""


class CameraMessage(TypedDict):
    """State of one camera."""

    age_s: float | None
    """Age of its newest usable frame; null before the first."""
    fault: str | None
    counts: dict[str, int]
    """Frames since the start, by their fate."""


class ComputerMessage(TypedDict):
    """Load and faults of the computer. Counts are since the start."""

    time_s: float
    cameras: dict[str, CameraMessage]
    load: float
    """95th percentile of the steps' durations over the permitted one."""
    steps: int
    steps_failed: int
    network_faults: int
    """Outputs that are NaN, infinite or out of range."""
    networks_stuck: int
    """Calls that were ended after their deadline."""
    loop_lag_s: float
    """Largest lag of the event loop in the last second."""
    temperature_c: float | None
    messages_lost: int
    recording: str | None
    """The file, or why the recording ended; null: not recording."""


class AboutMessage(TypedDict):
    """The drone's configuration."""

    version: str
    configuration: dict[str, object]
    """Every key of the drone's configuration, defaults filled in."""
    commands: list[str]
    """Commands that operators may send."""


class TimeMessage(TypedDict):
    """The drone's clocks at its reply: watchers also learn the link's delay from it."""

    time_s: float
    """Monotonic."""
    wall_s: float
    """Seconds since 1970, UTC."""
    identity: str | None
    """As in the liveliness token."""


class OrderMessage(TypedDict, total=False):
    """A `goto` or `velocity`: a goal in metres or degrees, or a velocity; missing keys leave values unchanged."""

    north_m: float
    """From the mission's origin; `east_m` likewise."""
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
    """An operator's command. A drone accepts each once, in order and while it is new."""

    identity: str
    """The drone's, from its liveliness token: another drone of the same name refuses it."""
    operator: str
    """The operator's name, for people; the network's access rules decide who may send commands."""
    session: str
    """Identifies one run of the sending program."""
    sequence: int
    """Increases within the session."""
    time_s: float
    """When the operator gave it, on the drone's own clock, by its reply to `time` just before."""
    order: dict[str, object] | None
    """An `OrderMessage` for `goto` and `velocity`; else null."""


class AnswerMessage(TypedDict):
    """The reply to an operator's command."""

    accepted: bool
    """Whether the drone will try; `flight` reports the result."""
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
    """Age from which a message is outdated; None: it stays valid."""
    recorded: bool
    """Whether it is recorded by itself; what follows from a step is recorded as that step's input and output."""


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
