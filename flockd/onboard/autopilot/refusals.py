"""Why the autopilot would refuse to arm or to fly offboard now, from its messages; without I/O.

PX4 sends the checks that fail as MAVLink events: a summary with the modes that can be armed and flown, one event for
each check, and a second summary at the end.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from flockd.onboard.autopilot.autopilot_status import AutopilotStatus, FlightMode, mode_of
from flockd.onboard.autopilot.refusal_reasons import (
    CHECKS_FAIL,
    NAMES,
    NAVIGATION_STATES,
    NO_SETPOINTS,
    NOT_STREAMING,
    NOT_TOLD,
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
"""PX4's log levels, which are worse the smaller."""
MOST_CHECKS = 300
"""That a report may name as failed: PX4 has fewer."""
SEQUENCE_RESET = 1
"""MAV_EVENT_CURRENT_SEQUENCE_FLAGS."""
PREARM_CHECK = 1 << 28
"""Bit of MAV_SYS_STATUS_SENSOR."""
QUIET_ERRORS = frozenset({"check_system_safety_button", "check_modes_mission"})
"""PX4 sends them as information, and refuses to arm all the same."""
REMEMBERED_S = 15.0
"""For how long a request that was refused is told."""
MOST_TOLD = 5
"""Reasons at once; further ones are counted."""
STICKS = "check_modes_manual_control"
MANUAL_MODES = frozenset({"manual", "stabilized", "acro", "altitude", "position"})


class Refusal(NamedTuple):
    """One reason, in the words of `REASONS`."""

    reason: str
    """Its name in the table."""
    refused: str
    """`to arm` or `offboard`; empty for what is the matter with both."""
    what: str
    remedy: str

    @property
    def sentence(self) -> str:
        """For people."""
        if not self.refused:
            return f"the autopilot: {self.what}; {self.remedy}"
        return f"the autopilot refuses {self.refused}: {self.what}; {self.remedy}"


class FailedCheck(NamedTuple):
    """A check of PX4 that fails."""

    number: int
    """The event's number."""
    modes: int
    """Bits of the modes that it concerns."""
    level: int


@dataclass(frozen=True)
class CheckReport:
    """All checks of PX4 as of one time."""

    can_arm: int
    """Bits of the modes; so `can_run`."""
    can_run: int
    failed: tuple[FailedCheck, ...]


class CheckEvents:
    """Puts reports together from EVENT messages."""

    def __init__(self) -> None:
        self.report: CheckReport | None = None
        """The newest whole one."""
        self.incomplete = True
        """There is none yet, or events were lost since."""
        self.denied: tuple[float, str] | None = None
        """When a request was last refused, and why: a switch to offboard, for want of setpoints."""
        self.denied_mode: tuple[float, FlightMode] | None = None
        """When a ground station was last refused another mode, and which; PX4 tells of no other request."""
        self._order = EventOrder()
        self._begun: tuple[int, int] | None = None
        self._failed: list[FailedCheck] = []

    def add(self, fields: Mapping[str, Any], time_s: float) -> None:
        """Takes an EVENT; one that is none is ignored."""
        gaps = self._order.gaps
        self._take_all(self._order.add(fields), gaps, time_s)

    def announce(self, fields: Mapping[str, Any]) -> None:
        """Takes a CURRENT_EVENT_SEQUENCE; one that is none is ignored."""
        with suppress(KeyError, TypeError, ValueError, OverflowError):
            self._order.announce(int(fields["sequence"]) & 0xFFFF, reset=bool(int(fields["flags"]) & SEQUENCE_RESET))

    def missing(self, now_s: float) -> tuple[int, int] | None:
        """First and last number of events to request now; None: none. After a second without them they are given up."""
        gaps = self._order.gaps
        self._take_all(self._order.give_up(), gaps, now_s)
        return self._order.missing(now_s)

    def _take_all(self, events: Sequence[Mapping[str, Any]], gaps: int, time_s: float) -> None:
        if self._order.gaps != gaps:
            self._begun, self.incomplete = None, True
        for event in events:
            self._take(event, time_s)

    def _take(self, fields: Mapping[str, Any], time_s: float) -> None:
        try:
            number = int(fields["id"])
            arguments, level = bytes(fields["arguments"]), int(fields["log_levels"]) & 0xF
        except (KeyError, TypeError, ValueError, OverflowError):
            return
        if number == BEGINS:
            self._begun, self._failed = (_word(arguments, 9), _word(arguments, 13)), []
        elif number == ENDS:
            if self._begun is not None:
                self.report = CheckReport(*self._begun, tuple(self._failed))
                self.incomplete = False
            self._begun = None
        elif number in DENIALS:
            self.denied = time_s, NAMES[number]
        elif number == MODE_DENIED:
            mode = mode_of(_word(arguments, 0))
            if mode == "offboard":
                self.denied = time_s, NO_SETPOINTS
            else:
                self.denied_mode = time_s, mode
        elif self._begun is not None and len(self._failed) < MOST_CHECKS:
            self._failed.append(FailedCheck(number, _word(arguments, 0), level))


def refusals(
    status: AutopilotStatus,
    events: CheckEvents,
    messages: Mapping[str, Mapping[str, Any]],
    other_computers: bool,
    *,
    streams: bool,
    settled: bool,
) -> tuple[Refusal, ...]:
    """Why it would refuse now, the cause first; empty in offboard flight and where nothing is known against it.

    Args:
        status: the newest.
        events: what the events say.
        messages: the newest fields of SYS_STATUS and HEARTBEAT, by name.
        other_computers: one more onboard computer is heard.
        streams: flockd sends setpoints.
        settled: an autopilot that tells its checks by events would have done so by now.
    """
    found = [_refusal(SEVERAL_SENDERS, "")] if other_computers else []
    if not (status.armed and status.flight_mode == "offboard"):
        state = OF_STATE.get(int(messages["HEARTBEAT"].get("system_status") or 0))
        found += [] if state is None else [_refusal(state, "to arm")]
        # Somebody has just tried to switch to offboard.
        denied = events.denied
        asked = denied is not None and denied[1] == NO_SETPOINTS and status.time_s - denied[0] < REMEMBERED_S
        report = events.report
        if report is not None:
            found += _of_report(report, status, streams=streams, asked=asked)
        elif not status.armed and settled and _checks_fail(messages["SYS_STATUS"]):
            found.append(_refusal(CHECKS_FAIL, "to arm"))
        found += _of_denial(events, status, found)
        found += _of_mode(events, status.time_s)
    return _few({refusal.reason: refusal for refusal in reversed(found)})


def _few(found: Mapping[str, Refusal]) -> tuple[Refusal, ...]:
    """Each reason once, the cause first; the last that is told says how many are not."""
    ordered = sorted(found.values(), key=lambda refusal: RANK[refusal.reason])
    rest = len(ordered) - MOST_TOLD
    if rest <= 0:
        return tuple(ordered)
    last = ordered[MOST_TOLD - 1]
    more = f"{rest} further reason" + ("s" if rest > 1 else "")
    return (*ordered[: MOST_TOLD - 1], last._replace(remedy=f"{last.remedy} ({more})"))


def _of_report(report: CheckReport, status: AutopilotStatus, *, streams: bool, asked: bool) -> Iterator[Refusal]:
    """What PX4's checks say: of arming while it is disarmed, and of offboard."""
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
    """The failed checks of a mode that keep it from being armed; PX4 does not say which do."""
    failed = [check for check in report.failed if check.modes >> state & 1]
    certain = [
        check
        for check in failed
        if check.level <= ERROR or check.modes != ALL_MODES or NAMES.get(check.number) in QUIET_ERRORS
    ]
    manual = status.flight_mode in MANUAL_MODES
    warned = [check for check in failed if check.level == WARNING and (manual or NAMES.get(check.number) != STICKS)]
    return certain or warned or [FailedCheck(event_number(CHECKS_FAIL), ALL_MODES, ERROR)]


def _checks_fail(system: Mapping[str, Any]) -> bool:
    """By SYS_STATUS, of a firmware that does not tell which."""
    enabled, healthy = (int(system.get(f"onboard_control_sensors_{what}") or 0) for what in ("enabled", "health"))
    return bool(enabled & ~healthy & PREARM_CHECK)


def _of_denial(events: CheckEvents, status: AutopilotStatus, found: Sequence[Refusal]) -> Iterator[Refusal]:
    """Arming that was refused a moment ago, unless the reasons are told already."""
    if status.armed or events.denied is None or status.time_s - events.denied[0] >= REMEMBERED_S:
        return
    name = events.denied[1]
    if name != NO_SETPOINTS and not (name == CHECKS_FAIL and (found or events.report is not None)):
        yield _refusal(name, "to arm")


def _of_mode(events: CheckEvents, now_s: float) -> list[Refusal]:
    """Why a ground station was refused a flight mode a moment ago."""
    if events.denied_mode is None or now_s - events.denied_mode[0] >= REMEMBERED_S:
        return []
    mode = events.denied_mode[1]
    state = NAVIGATION_STATES.get(mode)
    failed = () if events.report is None or state is None else events.report.failed
    told = [_named(c, mode, streams=True) for c in failed if c.modes >> (state or 0) & 1 and c.modes != ALL_MODES]
    return told or [_refusal(NOT_TOLD, mode)]


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


Fields = Mapping[str, Any]
NUMBERS = 1 << 16
MOST_MISSING = 20
"""PX4 keeps so many events."""
ASK_AGAIN_S, MOST_REQUESTS = 0.3, 3


class EventOrder:
    """Hands out events by their numbers; one that is missing holds the others up until it comes or is given up."""

    def __init__(self) -> None:
        self._next: int | None = None
        self._last = 0
        """The newest number that the autopilot has used."""
        self._waiting: dict[int, Fields] = {}
        self._asked_s, self._requests = -math.inf, 0
        self.gaps = 0
        """How often events were given up."""

    def add(self, fields: Fields) -> list[Fields]:
        """Takes an EVENT; those that follow without a gap now, in order. One without a number is ignored."""
        try:
            number = int(fields["sequence"]) % NUMBERS
        except (KeyError, TypeError, ValueError, OverflowError):
            return []
        if self._next is None:
            self._next = self._last = number
        if self._ahead(number) < 0:
            return []  # it came already
        self._waiting[number] = fields
        self._last = max(self._last, number, key=self._ahead)
        if self._ahead(number) > MOST_MISSING:
            self._skip()
        return self._follow()

    def announce(self, number: int, *, reset: bool) -> None:
        """The autopilot says that this is the number of its newest event; ``reset``: it counts anew."""
        if reset or self._next is None or abs(self._ahead(number)) > MOST_MISSING:
            self._next, self._last, self._waiting = (number + 1) % NUMBERS, number, {}
        self._last = max(self._last, number, key=self._ahead)

    def missing(self, now_s: float) -> tuple[int, int] | None:
        """The first and the last number to request now; None: none is missing, or it is too early to ask again."""
        if self._next is None or self._ahead(self._last) < 0 or now_s - self._asked_s < ASK_AGAIN_S:
            return None
        self._asked_s, self._requests = now_s, self._requests + 1
        first = last = self._next
        while last != self._last and (last + 1) % NUMBERS not in self._waiting:
            last = (last + 1) % NUMBERS
        return first, last

    def give_up(self) -> list[Fields]:
        """The events after those that were requested in vain."""
        if self._requests <= MOST_REQUESTS:
            return []
        self._skip()
        return self._follow()

    def _ahead(self, number: int) -> int:
        """Of the number that comes next; negative: before it. Numbers begin again after the last."""
        assert self._next is not None
        half = NUMBERS // 2
        return (number - self._next + half) % NUMBERS - half

    def _skip(self) -> None:
        self.gaps += 1
        self._next = min(self._waiting, key=self._ahead, default=(self._last + 1) % NUMBERS)
        self._requests = 0

    def _follow(self) -> list[Fields]:
        ready = []
        while self._next in self._waiting:
            ready.append(self._waiting.pop(self._next))
            self._next, self._requests = (self._next + 1) % NUMBERS, 0
        return ready
