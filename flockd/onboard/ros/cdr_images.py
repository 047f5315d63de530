"""Reads ROS 2's Image, CompressedImage and CameraInfo from the bytes that travel (CDR), without ROS.

So rclpy need not turn megabytes into Python's numbers, and what reads a camera needs no ROS of its own.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

_NS = 1_000_000_000
_HEAD = 4
"""Bytes in front, which say in which order bytes stand; all else is aligned to what follows them."""


@dataclass(frozen=True, eq=False)
class RosImage:
    """An Image or CompressedImage."""

    stamp_ns: int
    encoding: str
    """Of an Image its `encoding`, of a CompressedImage its `format`."""
    data: bytes
    size: tuple[int, int] | None = None
    """Width, height; None of a CompressedImage."""
    bytes_per_line: int | None = None


@dataclass(frozen=True, eq=False)
class RosCameraInfo:
    """What of a CameraInfo is compared with a rig: pixel centres are at whole numbers in ROS."""

    size: tuple[int, int]
    model: str
    distortion: tuple[float, ...]
    fx: float
    """0 for a camera that is not calibrated; so the next three."""
    fy: float
    cx: float
    cy: float


def read_image(data: bytes) -> RosImage:
    """An Image. Raises ValueError for what is none."""
    cdr = _Cdr(data)
    stamp_ns = cdr.header()
    height, width = cdr.number("I"), cdr.number("I")
    encoding = cdr.text()
    cdr.number("B")  # is_bigendian: of numbers of more than a byte, which no image of a camera has
    step = cdr.number("I")
    return RosImage(stamp_ns, encoding, cdr.bytes(), (width, height), step)


def read_compressed_image(data: bytes) -> RosImage:
    """A CompressedImage. Raises ValueError for what is none."""
    cdr = _Cdr(data)
    return RosImage(cdr.header(), cdr.text(), cdr.bytes())


def read_camera_info(data: bytes) -> RosCameraInfo:
    """A CameraInfo. Raises ValueError for what is none."""
    cdr = _Cdr(data)
    cdr.header()
    height, width = cdr.number("I"), cdr.number("I")
    model = cdr.text()
    distortion = cdr.numbers("d", cdr.number("I"))
    fx, _, cx, _, fy, cy, *_ = cdr.numbers("d", 9)
    return RosCameraInfo((width, height), model, tuple(distortion), fx, fy, cx, cy)


class _Cdr:
    """Reads one value after the other. Raises ValueError where the bytes end too early."""

    def __init__(self, data: bytes) -> None:
        if len(data) < _HEAD or data[0] != 0 or data[1] not in {0, 1}:
            raise ValueError("it is no message of ROS 2")
        self._data, self._at, self._order = data, _HEAD, "<" if data[1] else ">"

    def header(self) -> int:
        """Nanoseconds of a Header."""
        seconds, nanoseconds = self.number("i"), self.number("I")
        self.text()
        return int(seconds) * _NS + int(nanoseconds)

    def number(self, code: str) -> Any:
        return self.numbers(code, 1)[0]

    def numbers(self, code: str, count: int) -> tuple[Any, ...]:
        size = struct.calcsize(code)
        if count:  # an empty list has no padding
            self._at += -(self._at - _HEAD) % size
        values = f"{self._order}{count}{code}"
        if self._at + count * size > len(self._data):
            raise ValueError("it ends too early")
        found = struct.unpack_from(values, self._data, self._at)
        self._at += count * size
        return found

    def text(self) -> str:
        return self.bytes().rstrip(b"\0").decode("utf-8", "replace")

    def bytes(self) -> bytes:
        length = self.number("I")
        if self._at + length > len(self._data):
            raise ValueError("it ends too early")
        self._at += length
        return self._data[self._at - length : self._at]
