"""The fake autopilot's checks before a flight, told as PX4 does: by MAVLink events, at each change and when asked."""

from __future__ import annotations

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
BOOT_MS = 0
"""Events of the fake carry no time."""


class FakeChecks:
    """What the fake tells of PX4's checks, by their names, and of requests that it refuses."""

    def __init__(self, link: mavlink.MAVLink) -> None:
        self._mav = link
        self._sequence = self._texts = 0
        self._told: frozenset[str] | None = None

    def tell_changes(self, failing: Iterable[str]) -> None:
        """Sends the list if it is not the one sent last."""
        if frozenset(failing) != self._told:
            self.tell(failing)

    def tell(self, failing: Iterable[str]) -> None:
        """Sends the list: of missing setpoints for offboard alone, of all else for every mode."""
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

    def say(self, text: str) -> None:
        """Sends a critical STATUSTEXT, in chunks."""
        self._texts += 1
        for chunk, start in enumerate(range(0, len(text) + 1, TEXT_CHUNK)):
            part = text[start : start + TEXT_CHUNK].encode()
            self._mav.statustext_send(mavlink.MAV_SEVERITY_CRITICAL, part, self._texts, chunk)

    def _send(self, number: int, level: int, arguments: bytes) -> None:
        self._sequence = (self._sequence + 1) & 0xFFFF
        self._mav.send(_Event(number, self._sequence, level << 4 | level, arguments))


class _Event:
    """MAVLink's EVENT, which pymavlink does not have."""

    ID, CRC_EXTRA = 410, 160
    LAYOUT = struct.Struct("<IIHBBB40s")

    def __init__(self, number: int, sequence: int, log_levels: int, arguments: bytes) -> None:
        self._data = self.LAYOUT.pack(number, BOOT_MS, sequence, 0, 0, log_levels, arguments)

    def pack(self, mav: mavlink.MAVLink, force_mavlink1: bool = False) -> bytes:
        """The whole message as it goes over the link."""
        message = mavlink.MAVLink_message(self.ID, "EVENT")
        return bytes(message._pack(mav, self.CRC_EXTRA, self._data, force_mavlink1=force_mavlink1))
