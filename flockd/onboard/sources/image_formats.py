"""Decodes the bytes that a camera sent to an RGB image, or gives the reason why it cannot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal, Protocol

import cv2
import numpy as np

from flockd.core.config.source import CameraDeviceParameters
from flockd.core.jpeg_header import cost_fault, jpeg_end, jpeg_size
from flockd.core.messages import UInt8Array

Decoder = Callable[[bytes], UInt8Array]
"""Bytes to (height, width, 3) RGB; raises CorruptImageError."""

PACKED: Mapping[str, tuple[int, int | None]] = {
    "RGB": (3, None),
    "BGR": (3, cv2.COLOR_BGR2RGB),
    "RGBx": (4, cv2.COLOR_RGBA2RGB),
    "RGBA": (4, cv2.COLOR_RGBA2RGB),
    "BGRx": (4, cv2.COLOR_BGRA2RGB),
    "BGRA": (4, cv2.COLOR_BGRA2RGB),
    "YUY2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "UYVY": (2, cv2.COLOR_YUV2RGB_UYVY),
    "GRAY8": (1, cv2.COLOR_GRAY2RGB),
}
"""Bytes per pixel, and OpenCV's conversion to RGB, by GStreamer's name."""
_TURNS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}
_REDUCING = {1: cv2.IMREAD_COLOR_RGB, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4}
_START, _END = b"\xff\xd8", b"\xff\xd9"
_SAMPLE_STRIDE = 8
_FLAT_DEVIATION = 1.0
"""Standard deviation in grey levels below which an image shows nothing: a sensor's noise alone exceeds it."""
_LOST_SHARE = 16
"""An image is cut off if its last 1/16 of rows has one value: decoders fill in missing data that way."""
_SATURATED = (8, 247)
"""Values beyond these may be of a scene that is too dark or too bright."""


class CorruptImageError(ValueError):
    """The bytes are not a complete image of the right size; the text says why."""


class ImageFormat(Protocol):
    """The format in which a camera sends its images."""

    def check(self, data: bytes) -> None:
        """Raises CorruptImageError for errors that show without decoding; takes microseconds."""

    def pixels(self, data: bytes) -> UInt8Array:
        """(height, width, 3) RGB, whatever it shows. Raises CorruptImageError."""


@dataclass(frozen=True)
class MjpegFormat:
    """One JPEG per image, with or without its Huffman tables, which many cameras leave out."""

    size: tuple[int, int]
    """Width, height."""
    reduce: Literal[1, 2, 4] = 1
    """Factor by which the decoded image is smaller, in each direction; the decoder leaves out high frequencies."""

    def check(self, data: bytes) -> None:
        """See ``ImageFormat``: checks begin, end and size."""
        if not data.startswith(_START):
            raise CorruptImageError("no JPEG begins here")
        if not data.rstrip(b"\0").endswith(_END) and jpeg_end(data) is None:  # some cameras append bytes, mostly zeros
            raise CorruptImageError("JPEG ends too early")
        found = jpeg_size(data)
        if found != self.size:
            shown = "no size" if found is None else f"{found[0]}x{found[1]}"
            raise CorruptImageError(f"JPEG has {shown} instead of {self.size[0]}x{self.size[1]}")
        if (fault := cost_fault(data)) is not None:
            raise CorruptImageError(f"JPEG {fault}")

    def pixels(self, data: bytes) -> UInt8Array:
        """See ``ImageFormat``."""
        self.check(data)
        flags = _REDUCING[self.reduce] | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error as error:
            raise CorruptImageError(f"JPEG cannot be decoded ({error})") from error
        if image is None:
            raise CorruptImageError("JPEG cannot be decoded")
        if self.reduce > 1:  # OpenCV reduces to BGR only
            image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return np.asarray(image, np.uint8)


@dataclass(frozen=True)
class PackedFormat:
    """Packed pixels, row by row; YUV by BT.601, luma from 16 to 235."""

    name: str
    """A key of `PACKED`."""
    size: tuple[int, int]
    """Width, height."""
    bytes_per_line: int | None = None
    """None: rows are padded to a multiple of four bytes, as in GStreamer."""
    reduce: Literal[1, 2, 4] = 1
    """Factor by which the decoded image is smaller, in each direction; each pixel is a mean."""

    def check(self, data: bytes) -> None:
        """See ``ImageFormat``: checks size and length of rows."""
        depth, width = PACKED[self.name][0], self.size[0]
        row = depth * (up_to(2, width) if depth == 2 else width)
        if self._bytes_per_line() < row:
            raise CorruptImageError(f"rows of {self._bytes_per_line()} bytes, where {width} pixels take {row}")
        check_length(data, self._bytes_per_line() * self.size[1])

    def pixels(self, data: bytes) -> UInt8Array:
        """See ``ImageFormat``."""
        self.check(data)
        (width, height), (depth, conversion) = self.size, PACKED[self.name]
        across = up_to(2, width) if depth == 2 else width  # two pixels share their chroma
        rows = np.frombuffer(data, np.uint8).reshape(height, self._bytes_per_line())
        pixels = np.ascontiguousarray(rows[:, : depth * across]).reshape(height, across, depth)
        image = pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)
        whole = np.ascontiguousarray(image[:, :width])
        if self.reduce == 1:
            return whole
        size = width // self.reduce, height // self.reduce
        return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.uint8)

    def _bytes_per_line(self) -> int:
        return self.bytes_per_line or up_to(4, PACKED[self.name][0] * self.size[0])


@dataclass(frozen=True)
class RgbFormat:
    """Plain RGB of a simulator; any content is valid."""

    size: tuple[int, int]
    """Width, height."""

    def check(self, data: bytes) -> None:
        """See ``ImageFormat``: size."""
        check_length(data, self.size[0] * self.size[1] * 3)

    def pixels(self, data: bytes) -> UInt8Array:
        """See ``ImageFormat``; nothing is copied."""
        self.check(data)
        return np.frombuffer(data, np.uint8).reshape(self.size[1], self.size[0], 3)


class CapturedImage:
    """One image of one camera or several; decoded once, when the first part is needed."""

    def __init__(self, image_format: ImageFormat) -> None:
        self._format = image_format
        self._pixels: UInt8Array | None = None

    def decoder(self, camera: CameraDeviceParameters) -> Decoder:
        """The decoder of a camera's part, turned upright: a view of the whole image unless it is turned.

        It raises CorruptImageError for a part without content too: see `plausible`.
        """
        return partial(self._part, camera)

    def _part(self, camera: CameraDeviceParameters, data: bytes) -> UInt8Array:
        if self._pixels is None:
            self._pixels = self._format.pixels(data)
        part = self._pixels
        if camera.crop is not None:
            left, top, width, height = (length // camera.reduce for length in camera.crop)
            part = part[top : top + height, left : left + width]
        return turned(plausible(part), camera.turn_deg)


def turned(image: UInt8Array, clockwise_deg: Literal[0, 90, 180, 270]) -> UInt8Array:
    """The image turned clockwise."""
    return np.asarray(cv2.rotate(image, _TURNS[clockwise_deg]), np.uint8) if clockwise_deg else image


def check_length(data: bytes, length: int) -> None:
    """Raises CorruptImageError if the data have another length."""
    if len(data) != length:
        raise CorruptImageError(f"{len(data)} bytes instead of {length}")


def plausible(image: UInt8Array) -> UInt8Array:
    """The same image. Raises CorruptImageError if it is of one colour, or if its last rows are."""
    sample = image[::_SAMPLE_STRIDE, ::_SAMPLE_STRIDE]
    if float(sample.std(axis=(0, 1)).max()) < _FLAT_DEVIATION:
        raise CorruptImageError("image is all of one colour")
    strip = image[-max(image.shape[0] // _LOST_SHARE, 1) :, ::_SAMPLE_STRIDE]
    low, high = _SATURATED
    if np.all(strip == strip[0, 0]) and np.any((strip[0, 0] > low) & (strip[0, 0] < high)):
        raise CorruptImageError("the image's last rows are missing")
    return image


def up_to(multiple: int, number: int) -> int:
    """The smallest multiple that is at least ``number``."""
    return -(-number // multiple) * multiple
