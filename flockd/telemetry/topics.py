"""The one table of published streams, and the fields of each message.

A key is `flockd/v1/<fleet>/<drone>/<topic>`; a message is a JSON object in UTF-8. Every number is finite or null.
Vectors are lists: NED is north, east, down. Times are seconds on the drone's monotonic clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict

PREFIX = "flockd/v1"


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


class CommandMessage(TypedDict):
    """What the flock law asks of the autopilot."""

    time_s: float
    velocity_ne: list[float]
    """m/s, north and east, after limits."""
    acceleration_ne: list[float]
    """m/s^2, north and east, after limits."""
    yaw_deg: float


class HealthMessage(TypedDict):
    """Whether the step found all it should."""

    time_s: float
    ok: bool
    reasons: list[str]
    """Why something is missing; empty when ok."""
    refused: dict[str, int]
    """Estimates refused in this step, by reason."""


class EventMessage(TypedDict):
    """Something that happened once."""

    time_s: float
    event: str


class TimingsMessage(TypedDict):
    """How long each stage of the step took."""

    time_s: float
    stages_ms: dict[str, float]


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


TOPICS = {
    topic.key: topic
    for topic in (
        Topic("state", StateMessage, rate_hz=2.0, stale_after_s=1.5, recorded=True),
        Topic("neighbours", NeighboursMessage, rate_hz=2.0, stale_after_s=1.5, recorded=True),
        Topic("command", CommandMessage, rate_hz=2.0, stale_after_s=1.5, recorded=True),
        Topic("health", HealthMessage, rate_hz=2.0, stale_after_s=1.5, recorded=True),
        Topic("events", EventMessage, rate_hz=None, stale_after_s=None, recorded=True),
        Topic("timings", TimingsMessage, rate_hz=2.0, stale_after_s=1.5, recorded=True),
    )
}
