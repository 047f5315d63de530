"""Where the page and the bridge to ROS 2 have the fleet from: live telemetry, or recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from flockd.fleet.drone_rows import Known, Row
from flockd.fleet.watcher import Watched
from flockd.onboard.telemetry.topics import AnswerMessage

Event = tuple[float, str, str]
"""When it was heard, of which drone by its key, and what it says."""


class FleetSource(Protocol):
    """A fleet at any time of its time line. Called on the event loop, except for what says that it waits."""

    @property
    def span_s(self) -> tuple[float, float] | None:
        """Begin and end of the recordings' time line; None: live."""

    def now_s(self) -> float:
        """Now on the time line of a live fleet; the end of a recorded one."""

    def wall_s(self, time_s: float) -> float:
        """Seconds since 1970 at a time of the time line, as far as it is known."""

    def drones(self, time_s: float) -> tuple[Watched, ...]:
        """The newest messages of each drone."""

    def known(self) -> Mapping[str, Known]:
        """What each drone flies with, by its key."""

    def rows(self, time_s: float) -> dict[str, Row]:
        """What is known of each drone, by its key, the worst first."""

    def events(self, time_s: float) -> list[Event]:
        """What happened up to a time, the newest last."""

    def history(self) -> Mapping[str, list[list[float | None]]]:
        """For each drone, by its key: rows of `HISTORY_COLUMNS` in order of time."""

    def notes(self) -> list[str]:
        """What is the matter beside the drones: with who else sends."""

    def ask(self, drone: str, command: str, order: Mapping[str, object] | None, operator: str) -> AnswerMessage:
        """A drone's answer to a command. Waits; called on a thread of its own."""

    def image(self, drone: str, camera: str, time_s: float) -> bytes | None:
        """A JPEG of what a camera sees. Waits; called on a thread of its own."""
