"""Writes small ULog files, byte for byte as PX4's file format has them."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

HEADER = bytes.fromhex("554c6f67011235") + b"\x01"
TYPES = {"uint8_t": "B", "bool": "?", "float": "f", "float[3]": "3f"}

Rows = Sequence[tuple[float, Sequence[object]]]
"""Seconds of the autopilot's clock, and the fields' values."""


def write_ulog(
    path: Path,
    topics: Mapping[str, tuple[Sequence[tuple[str, str]], Rows]],
    *,
    messages: Sequence[tuple[float, int, str]] = (),
    system_id: int = 1,
) -> Path:
    """``topics``: by name their fields as (type, name), and rows. ``messages``: seconds, syslog level, text."""
    start_us = 1_000_000
    data = bytearray(HEADER + struct.pack("<Q", start_us))
    data += _message("B", bytes(40))
    for name, (fields, _) in topics.items():
        declared = ";".join(["uint64_t timestamp", *(f"{kind} {field}" for kind, field in fields)])
        data += _message("F", f"{name}:{declared};".encode())
    key = b"int32_t MAV_SYS_ID"
    data += _message("P", bytes([len(key)]) + key + struct.pack("<i", system_id))
    for number, name in enumerate(topics):
        data += _message("A", struct.pack("<BH", 0, number) + name.encode())
    for number, (fields, rows) in enumerate(topics.values()):
        layout = "<Q" + "".join(TYPES[kind] for kind, _ in fields)
        for time_s, values in rows:
            flat = [one for value in values for one in (value if isinstance(value, tuple) else (value,))]
            data += _message("D", struct.pack("<H", number) + struct.pack(layout, round(1e6 * time_s), *flat))
    for time_s, level, text in messages:
        data += _message("L", struct.pack("<BQ", ord(str(level)), round(1e6 * time_s)) + text.encode())
    path.write_bytes(data)
    return path


def _message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<HB", len(payload), ord(kind)) + payload
