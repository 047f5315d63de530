"""Decodes messages that come ten times a second or more, directly from the bytes of a serial port.

MAVSDK wakes three threads and writes JSON for each message: at a hundred a second that is most of the link's CPU time.
Layouts and checksum: MAVLink 2, https://mavlink.io/en/guide/serialization.html, and its dialect `common`.
"""

from __future__ import annotations

import math
import struct
from binascii import crc_hqx
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple


class _Layout(NamedTuple):
    """A message's payload: its fields in the order on the wire, without unused extensions."""

    name: str
    seed: int
    """CRC_EXTRA: a checksum of the message's fields, on which both sides have to agree."""
    values: struct.Struct
    fields: tuple[str, ...]


def _layout(name: str, seed: int, values: str, fields: str) -> _Layout:
    return _Layout(name, seed, struct.Struct(f"<{values}"), tuple(fields.split()))


LAYOUTS: Mapping[int, _Layout] = {
    31: _layout("ATTITUDE_QUATERNION", 246, "I7f", "time_boot_ms q1 q2 q3 q4 rollspeed pitchspeed yawspeed"),
    32: _layout("LOCAL_POSITION_NED", 185, "I6f", "time_boot_ms x y z vx vy vz"),
    85: _layout("POSITION_TARGET_LOCAL_NED", 140, "I12x2f", "time_boot_ms vx vy"),
    132: _layout(
        "DISTANCE_SENSOR", 85, "I3HxxB25xB",
        "time_boot_ms min_distance max_distance current_distance orientation signal_quality",
    ),
}  # fmt: skip
"""By message number; of each the fields that `ReceivedMessages` reads."""
BEGINS, HEADER, CHECKSUM, SIGNATURE, SIGNED = 0xFD, 10, 2, 13, 1
"""First byte of a MAVLink 2 frame, and the lengths of its parts; the signature is present only with the flag SIGNED."""
_MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Bytes with their bits reversed: MAVLink's checksum is `crc_hqx` with reversed bits."""


class FrequentMessages:
    """Splits the bytes that a port receives; for one thread."""

    def __init__(self, system: int, component: int, take: Callable[[str, dict[str, Any]], object]) -> None:
        """``take``: called with name and fields of each message of that component, NaN and infinity as None."""
        self._sender, self._take = bytes([system, component]), take
        self._begun = b""

    def without(self, data: bytes) -> bytes:
        """The other bytes. An incomplete frame waits for the next call."""
        data, rest, at = self._begun + data, [], 0
        while (start := data.find(BEGINS, at)) >= 0:
            rest.append(data[at:start])
            at = start
            header = data[start : start + HEADER]
            if len(header) < HEADER:
                break
            end = start + HEADER + header[1] + CHECKSUM + (SIGNATURE if header[2] & SIGNED else 0)
            if end > len(data):
                break
            layout = LAYOUTS.get(int.from_bytes(header[7:10], "little")) if header[5:7] == self._sender else None
            if layout is None or not self._is_taken(layout, data[start:end]):
                rest.append(data[start:end])
            at = end
        else:
            start = len(data)
            rest.append(data[at:])
        self._begun = data[start:]
        return b"".join(rest)

    def _is_taken(self, layout: _Layout, frame: bytes) -> bool:
        payload_end = HEADER + frame[1]
        checked = (frame[1:payload_end] + bytes([layout.seed])).translate(_MIRRORED)
        checksum = crc_hqx(checked, 0xFFFF).to_bytes(2, "big").translate(_MIRRORED)
        if frame[payload_end : payload_end + CHECKSUM] != checksum:
            return False
        values = layout.values.unpack_from(frame[HEADER:payload_end].ljust(layout.values.size, b"\0"))
        finite = (value if math.isfinite(value) else None for value in values)
        self._take(layout.name, dict(zip(layout.fields, finite, strict=True)))
        return True
