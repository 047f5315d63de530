"""The fake autopilot's checks before a flight, sent as PX4 does: as MAVLink events, at each change and on request."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable

from pymavlink.dialects.v20 import development as mavlink

from flockd.onboard.autopilot.refusal_reasons import NO_SETPOINTS, event_number
from flockd.onboard.autopilot.refusals import ALL_MODES, BEGINS, ENDS, ERROR

OFFBOARD_BIT = 1 << 14
PROTOCOL = 8
"""PX4's log level of summaries."""
TEXT_CHUNK = 50
"""Characters of a STATUSTEXT."""
GROUND_STATION_S = 2.5
"""PX4 sends texts for so long after a ground station's heartbeat."""
SEQUENCE_S = 1.0
"""Between two messages that name the newest event."""
BOOT_MS = 0
"""Events of the fake carry no time."""


class FakeChecks:
    """Sends the results of PX4's checks, by their names, and the requests that were refused."""

    def __init__(self, link: mavlink.MAVLink) -> None:
        self._mav = link
        self._sequence = self._texts = 0
        self._ground_station_s = -math.inf
        self._announced_s = -math.inf
        self.events_to_lose = 0
        """So many of the next are lost on their way."""
        self._told: frozenset[str] | None = None

    def hear_ground_station(self, now_s: float) -> None:
        """Takes a ground station's heartbeat; without one no text is sent."""
        self._ground_station_s = now_s

    def has_ground_station(self, now_s: float) -> bool:
        """Whether a ground station was heard in the last seconds."""
        return now_s - self._ground_station_s <= GROUND_STATION_S

    def announce(self, now_s: float) -> None:
        """Sends the newest event's number, once a second."""
        if now_s - self._announced_s >= SEQUENCE_S:
            self._announced_s = now_s
            data = struct.pack("<HB", self._sequence, int(self._told is None))
            self._mav.send(_Raw(411, "CURRENT_EVENT_SEQUENCE", 106, data))

    def tell_changes(self, failing: Iterable[str]) -> None:
        """Sends the list if it is not the one sent last."""
        if frozenset(failing) != self._told:
            self.tell(failing)

    def tell(self, failing: Iterable[str]) -> None:
        """Sends the failing checks: missing setpoints fail offboard alone, all others every mode."""
        self._told = frozenset(failing)
        others = self._told - {NO_SETPOINTS}
        may_fly = 0 if others else ALL_MODES & ~(OFFBOARD_BIT if self._told else 0)
        self._send(BEGINS, PROTOCOL, struct.pack("<BIIII", 0, 0, 0, may_fly, may_fly))
        for name in sorted(self._told):
            modes = OFFBOARD_BIT if name == NO_SETPOINTS else ALL_MODES
            self._send(event_number(name), ERROR, struct.pack("<IB", modes, 0))
        self._send(ENDS, PROTOCOL, struct.pack("<BIII", 0, 0, 0, 0))

    def deny(self, what: str, *arguments: int) -> None:
        """Sends the event of a refused request, by its name."""
        self._send(event_number(what), ERROR, struct.pack(f"<{len(arguments)}I", *arguments))

    def say(self, text: str, now_s: float) -> None:
        """Sends a critical STATUSTEXT, in chunks, where a ground station listens."""
        if not self.has_ground_station(now_s):
            return
        for chunk, start in enumerate(range(0, len(text), TEXT_CHUNK)):
            part = text[start : start + TEXT_CHUNK].encode()
            self._mav.statustext_send(mavlink.MAV_SEVERITY_CRITICAL, part, self._texts, chunk)
        self._texts += 1  # the first has the id 0, as PX4's

    def _send(self, number: int, level: int, arguments: bytes) -> None:
        self._sequence = (self._sequence + 1) & 0xFFFF
        levels = level << 4 | level
        data = struct.pack("<IIHBBB40s", number, BOOT_MS, self._sequence, 0, 0, levels, arguments)
        if self.events_to_lose > 0:
            self.events_to_lose -= 1
        else:
            self._mav.send(_Raw(410, "EVENT", 160, data))


class _Raw:
    """A MAVLink message that pymavlink does not have."""

    def __init__(self, number: int, name: str, crc_extra: int, data: bytes) -> None:
        self._number, self._name, self._crc_extra, self._data = number, name, crc_extra, data

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """The bytes of the whole message."""
        message = mavlink.MAVLink_message(self._number, self._name)
        return bytes(message._pack(mav, self._crc_extra, self._data, force_mavlink1=force_mavlink1))
