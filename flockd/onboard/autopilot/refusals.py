"""Why the autopilot would refuse to arm or to fly offboard now, from its messages; without I/O.

PX4 sends failed checks as MAVLink events: a summary of the modes that can be armed and flown, one event for each check,
and a second summary at the end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from flockd.onboard.autopilot.autopilot_status import AutopilotStatus, mode_of
from flockd.onboard.autopilot.refusal_reasons import (
    CHECKS_FAIL,
    NAMES,
    NAVIGATION_STATES,
    NO_SETPOINTS,
    NOT_STREAMING,
    OF_STATE,
    RANK,
    REASONS,
    SEVERAL_SENDERS,
    UNKNOWN_CHECK,
    event_number,
)

BEGINS, ENDS = event_number("commander_arming_check_summary"), event_number("commander_health_summary")
DENIALS = frozenset(
    event_number(name)
    for name in (
        "commander_arm_denied_throttle_unsafe",
        "commander_arm_denied_calibrating",
        "commander_kill_sw_engaged",
        CHECKS_FAIL,
    )
)
MODE_DENIED = event_number("commander_modeswitch_not_avail")
ALL_MODES = 0xFFFFFFFF
ERROR, WARNING = 3, 4
"""PX4's log levels; smaller is worse."""
MOST_CHECKS = 300
"""The most failed checks that a report may contain; PX4 has fewer."""
NUMBERS = 1 << 16
MOST_LATE = 20
"""A number that goes back by more is not a late event: the autopilot has restarted its count."""
SEQUENCE_RESET = 1
"""MAV_EVENT_CURRENT_SEQUENCE_FLAGS."""
QUIET_ERRORS = frozenset({"check_system_safety_button", "check_modes_mission"})
"""PX4 sends them as information, but still refuses to arm."""
REMEMBERED_S = 15.0
"""Time for which a refused request is reported."""
MOST_TOLD = 5
"""Reasons that are reported at once; the others are counted."""
STICKS = "check_modes_manual_control"
MANUAL_MODES = frozenset({"manual", "stabilized", "acro", "altitude", "position"})


class Refusal(NamedTuple):
    """One reason, with the words of `REASONS`."""

    reason: str
    """Its name in the table."""
    refused: str
    """`to arm` or `offboard`; empty for both."""
    what: str
    remedy: str

    @property
    def sentence(self) -> str:
        """A sentence for people."""
        if not self.refused:
            return f"the autopilot: {self.what}; {self.remedy}"
        return f"the autopilot refuses {self.refused}: {self.what}; {self.remedy}"


class FailedCheck(NamedTuple):
    """A failed check of PX4."""

    number: int
    """The event's number."""
    modes: int
    """Bits of the modes that it concerns."""
    level: int


@dataclass(frozen=True)
class CheckReport:
    """All checks of PX4 at one time."""

    can_arm: int
    """Bits of the modes that can be armed; `can_run`: of those that can be flown."""
    can_run: int
    failed: tuple[FailedCheck, ...]


class CheckEvents:
    """Assembles reports from EVENT messages. If one is lost, the whole list is requested again."""

    def __init__(self) -> None:
        self.report: CheckReport | None = None
        """The newest complete report."""
        self.lost = False
        """Whether events were lost since."""
        self.denied: tuple[float, str] | None = None
        """Time and reason of the last refused request: for a switch to offboard, missing setpoints."""
        self._last: int | None = None
        """Number of the autopilot's newest event."""
        self._begun: tuple[int, int] | None = None
        self._failed: list[FailedCheck] = []

    def add(self, fields: Mapping[str, Any], time_s: float) -> None:
        """Takes an EVENT; invalid and repeated ones are ignored."""
        try:
            sequence, number = int(fields["sequence"]) % NUMBERS, int(fields["id"])
            arguments, level = bytes(fields["arguments"]), int(fields["log_levels"]) & 0xF
        except (KeyError, TypeError, ValueError, OverflowError):
            return
        ahead = self._ahead(sequence)
        if ahead > 0:
            self._last = sequence
            if ahead > 1:
                self._lose()
            self._take(number, arguments, level, time_s)

    def announce(self, fields: Mapping[str, Any]) -> None:
        """Takes a CURRENT_EVENT_SEQUENCE, the number of the newest event; invalid ones are ignored."""
        try:
            newest, reset = int(fields["sequence"]) % NUMBERS, bool(int(fields["flags"]) & SEQUENCE_RESET)
        except (KeyError, TypeError, ValueError, OverflowError):
            return
        known, ahead = self._last is not None, self._ahead(newest)
        if not known or ahead > 0 or ahead < (0 if reset else -MOST_LATE):
            self._last = newest
            if known:
                self._lose()

    def _ahead(self, number: int) -> int:
        """How far a number is ahead of the newest, modulo 65536; 1 for the first of all."""
        half = NUMBERS // 2
        return 1 if self._last is None else (number - self._last + half) % NUMBERS - half

    def _lose(self) -> None:
        self._begun, self.lost = None, True

    def _take(self, number: int, arguments: bytes, level: int, time_s: float) -> None:
        if number == BEGINS:
            self._begun, self._failed = (_word(arguments, 9), _word(arguments, 13)), []
        elif number == ENDS:
            if self._begun is not None:
                self.report, self.lost = CheckReport(*self._begun, tuple(self._failed)), False
            self._begun = None
        elif number in DENIALS:
            self.denied = time_s, NAMES[number]
        elif number == MODE_DENIED:
            if mode_of(_word(arguments, 0)) == "offboard":
                self.denied = time_s, NO_SETPOINTS
        elif self._begun is not None and len(self._failed) < MOST_CHECKS:
            self._failed.append(FailedCheck(number, _word(arguments, 0), level))


def refusals(
    status: AutopilotStatus,
    events: CheckEvents,
    system_status: int,
    other_computers: bool,
    *,
    streams: bool,
) -> tuple[Refusal, ...]:
    """Why it would refuse now, the cause first; empty in offboard flight and if no reason is known.

    Args:
        status: the newest one.
        events: the reports of PX4's checks.
        system_status: MAV_STATE of the newest heartbeat.
        other_computers: whether another onboard computer is heard.
        streams: whether flockd sends setpoints.
    """
    found = [_refusal(SEVERAL_SENDERS, "")] if other_computers else []
    if not (status.armed and status.flight_mode == "offboard"):
        state = OF_STATE.get(system_status)
        found += [] if state is None else [_refusal(state, "to arm")]
        # A switch to offboard was just attempted.
        denied = events.denied
        asked = denied is not None and denied[1] == NO_SETPOINTS and status.time_s - denied[0] < REMEMBERED_S
        report = events.report
        if report is not None:
            found += _of_report(report, status, streams=streams, asked=asked)
        found += _of_denial(events, status, found)
    return _few({refusal.reason: refusal for refusal in reversed(found)})


def _few(found: Mapping[str, Refusal]) -> tuple[Refusal, ...]:
    """Each reason once, the cause first; the last one counts those left out."""
    ordered = sorted(found.values(), key=lambda refusal: RANK[refusal.reason])
    rest = len(ordered) - MOST_TOLD
    if rest <= 0:
        return tuple(ordered)
    last = ordered[MOST_TOLD - 1]
    more = f"{rest} further reason" + ("s" if rest > 1 else "")
    return (*ordered[: MOST_TOLD - 1], last._replace(remedy=f"{last.remedy} ({more})"))


def _of_report(report: CheckReport, status: AutopilotStatus, *, streams: bool, asked: bool) -> Iterator[Refusal]:
    """The refusals by PX4's checks: of arming while the drone is disarmed, and of offboard."""
    state = NAVIGATION_STATES.get(status.flight_mode)
    if not status.armed and state is not None and not report.can_arm >> state & 1:
        for check in _blocking(report, state, status):
            yield _named(check, "to arm", streams=streams)
    state = NAVIGATION_STATES["offboard"]
    if not report.can_run >> state & 1:
        for check in report.failed:
            silent = NAMES.get(check.number) == NO_SETPOINTS and not streams
            if check.modes >> state & 1 and check.modes != ALL_MODES and (status.armed or asked or not silent):
                yield _named(check, "offboard", streams=streams)


def _blocking(report: CheckReport, state: int, status: AutopilotStatus) -> list[FailedCheck]:
    """The failed checks of a mode that may keep it from being armed; PX4 does not report which do."""
    failed = [check for check in report.failed if check.modes >> state & 1]
    certain = [
        check
        for check in failed
        if check.level <= ERROR or check.modes != ALL_MODES or NAMES.get(check.number) in QUIET_ERRORS
    ]
    manual = status.flight_mode in MANUAL_MODES
    warned = [check for check in failed if check.level == WARNING and (manual or NAMES.get(check.number) != STICKS)]
    return certain or warned or [FailedCheck(event_number(CHECKS_FAIL), ALL_MODES, ERROR)]


def _of_denial(events: CheckEvents, status: AutopilotStatus, found: Sequence[Refusal]) -> Iterator[Refusal]:
    """The last refusal to arm, unless its reasons are already among ``found``."""
    if status.armed or events.denied is None or status.time_s - events.denied[0] >= REMEMBERED_S:
        return
    name = events.denied[1]
    if name != NO_SETPOINTS and not (name == CHECKS_FAIL and (found or events.report is not None)):
        yield _refusal(name, "to arm")


def _named(check: FailedCheck, refused: str, *, streams: bool) -> Refusal:
    name = NAMES.get(check.number)
    if name is None:
        refusal = _refusal(UNKNOWN_CHECK, refused)
        return refusal._replace(what=f"{refusal.what} (event {check.number})")
    return _refusal(NOT_STREAMING if name == NO_SETPOINTS and not streams else name, refused)


def _refusal(name: str, refused: str) -> Refusal:
    return Refusal(name, refused, *REASONS[name])


def _word(data: bytes, offset: int) -> int:
    return int.from_bytes(data[offset : offset + 4], "little")
