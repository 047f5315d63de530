"""What an image would cost to decode, from its bytes, before memory or time is spent on its pixels."""

from __future__ import annotations

import re
from typing import Literal

MAX_IMAGE_PIXELS = 1 << 26
"""8192 x 8192: more than any camera of a drone has."""
MAX_SCANS = 100
"""Of a JPEG: encoders write 10 or so, and libjpeg-turbo's own tools call more than 500 an attack."""
MAX_SCANNED_PIXELS = 1 << 30
"""Pixels times scans: each scan of a progressive JPEG goes over all pixels, however few bytes it has. A second or
two."""
_STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_SCAN = 0xDA
_PNM = re.compile(rb"P[2356](?:\s+|#[^\n]*\n)+(\d{1,9})(?:\s+|#[^\n]*\n)+(\d{1,9})\s")
_BMP_SIZES = {12: 2, 40: 4, 52: 4, 56: 4, 64: 4, 108: 4, 124: 4}
"""Bytes of a width, by the length of the header that holds it."""
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_TIFF_TYPES = {3: 2, 4: 4}
"""Bytes of SHORT and LONG."""
_JPEG = b"\xff\xd8"
_PNG = b"\x89PNG\r\n\x1a\n"


def cost_fault(data: bytes) -> str | None:
    """Why an image is not to be decoded, as it would take too much memory or time; None: it may be.

    Says nothing of an image whose size `image_size` does not find.
    """
    width, height = image_size(data) or (0, 0)
    if width * height > MAX_IMAGE_PIXELS:
        return f"claims to be {width} x {height} pixels, more than any camera has"
    scans = data.count(b"\xff\xda") if data.startswith(_JPEG) else 0
    if scans > MAX_SCANS or scans * width * height > MAX_SCANNED_PIXELS:
        return f"has {scans} scans of {width} x {height} pixels, more than any camera writes"
    return None


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of a JPEG, PNG, BMP, PGM, PPM or TIFF; None for others and for a header that is cut off."""
    if data.startswith(_PNG) and len(data) >= 24:
        return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    if data.startswith(_JPEG):
        return jpeg_size(data)
    if data.startswith(b"BM"):
        return _bmp_size(data)
    if data.startswith((b"II*\0", b"MM\0*")):
        return _tiff_size(data)
    pnm = _PNM.match(data)
    return (int(pnm[1]), int(pnm[2])) if pnm else None


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of the frame header; None without one before the first scan."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF or marker in _STANDALONE:
            at += 1 if marker == 0xFF else 2
        elif marker in _FRAME_HEADERS:
            return int.from_bytes(data[at + 7 : at + 9]), int.from_bytes(data[at + 5 : at + 7])
        elif marker == _SCAN:
            return None
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4])
    return None


def _bmp_size(data: bytes) -> tuple[int, int] | None:
    width = _BMP_SIZES.get(int.from_bytes(data[14:18], "little"))
    if width is None or len(data) < 18 + 2 * width:
        return None
    across, up = (int.from_bytes(data[at : at + width], "little", signed=width == 4) for at in (18, 18 + width))
    return abs(across), abs(up)  # a negative height: the first row is on top


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of the first image."""
    order: Literal["little", "big"] = "little" if data.startswith(b"II") else "big"
    at = int.from_bytes(data[4:8], order)
    found = {}
    for entry in range(at + 2, at + 2 + 12 * int.from_bytes(data[at : at + 2], order), 12):
        tag, kind = (int.from_bytes(data[entry + i : entry + i + 2], order) for i in (0, 2))
        if tag in {_TIFF_WIDTH, _TIFF_HEIGHT} and kind in _TIFF_TYPES and entry + 12 <= len(data):
            found[tag] = int.from_bytes(data[entry + 8 : entry + 8 + _TIFF_TYPES[kind]], order)
    return (found[_TIFF_WIDTH], found[_TIFF_HEIGHT]) if len(found) == 2 else None
