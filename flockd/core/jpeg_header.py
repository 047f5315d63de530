"""Checks a JPEG's header before decoding: whether its pixels would take too much memory or time."""

from __future__ import annotations

import re
from collections.abc import Iterator

MAX_IMAGE_PIXELS = 1 << 26
"""8192 x 8192: more than any drone's camera has. The command line also sets it as OpenCV's limit."""
MAX_SCANS = 100
"""Scans of a JPEG: encoders write about 10, and libjpeg-turbo's tools treat more than 500 as an attack."""
MAX_SCANNED_PIXELS = 1 << 30
"""Pixels times scans, a second or two: each scan of a progressive JPEG visits all pixels, however few bytes it has."""
_STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_SCAN, _END = 0xDA, 0xD9
_JPEG = b"\xff\xd8"


def cost_fault(data: bytes) -> str | None:
    """Why decoding a JPEG would take too much memory or time; None: it would not, or the data are no JPEG."""
    width, height = jpeg_size(data) or (0, 0)
    if width * height > MAX_IMAGE_PIXELS:
        return f"claims to be {width} x {height} pixels, more than any camera has"
    scans = data.count(b"\xff\xda") if data.startswith(_JPEG) else 0
    if scans > MAX_SCANS or scans * width * height > MAX_SCANNED_PIXELS:
        return f"has {scans} scans of {width} x {height} pixels, more than any camera writes"
    return None


_AFTER_SCAN = re.compile(rb"\xff+[^\x00\xd0-\xd7\xff]")
"""A marker that ends a scan's data; in the data, a zero follows each byte 0xff."""


def jpeg_end(data: bytes) -> int | None:
    """Index behind the end marker of the JPEG at the beginning; None: it has no end marker, or the data are no JPEG.

    Markers inside thumbnails, or behind the JPEG, do not count.
    """
    return next((at for marker, at in _segments(data) if marker == _END), None)


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the frame header; None: the data are no JPEG, or have no header before the first scan."""
    for marker, at in _segments(data):
        if marker in _FRAME_HEADERS and at + 7 <= len(data):
            return int.from_bytes(data[at + 5 : at + 7]), int.from_bytes(data[at + 3 : at + 5])
        if marker == _SCAN:
            break
    return None


def _segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Each marker of the JPEG at the beginning, and the index behind it."""
    at = 2 if data.startswith(_JPEG) else len(data)
    while at + 2 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        at += 2
        yield marker, at
        if marker not in _STANDALONE:
            at += int.from_bytes(data[at : at + 2])
        if marker == _SCAN:
            found = _AFTER_SCAN.search(data, at)
            at = len(data) if found is None else found.end() - 2
