"""Image and depth files, whole or not at all: a decoder would fill in what is missing."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from flockd.core.errors import FlockdError
from flockd.core.jpeg_header import MAX_IMAGE_PIXELS, cost_fault
from flockd.core.messages import Float32Array, UInt8Array


class DatasetError(FlockdError):
    """Something is no dataset, or a part of it is missing, damaged or does not fit the others."""


SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff"})
_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
_JPEG, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
MAX_FILE_BYTES = 1 << 29
"""Largest file: an image with the most pixels that are read and a depth of 16 bits, uncompressed, and some more."""
_CHUNK_FRAME = 12
"""Bytes of a PNG chunk beside its data: length, name and checksum."""


def read_image(path: Path, size: tuple[int, int] | None = None, *, upright: bool = False) -> UInt8Array:
    """(h, w, 3) RGB; grey images have three equal channels. Raises DatasetError, also for another ``size``.

    ``upright``: turned as the file's orientation says, as a phone writes it; else as the sensor gave it.
    """
    image = _decoded(path, cv2.IMREAD_COLOR_RGB | (0 if upright else cv2.IMREAD_IGNORE_ORIENTATION))
    if size is not None:
        _check_size(path, image.shape[1::-1], size)
    return np.asarray(image, np.uint8)


def read_depth(path: Path, size: tuple[int, int], units_per_m: float) -> Float32Array:
    """(h, w) metres, NaN where the file has 0. Raises DatasetError, also for a file that has 0 everywhere."""
    raw = _decoded(path, cv2.IMREAD_UNCHANGED)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise DatasetError(f"{path}: is no depth map; it needs one channel of 16 bits")
    _check_size(path, raw.shape[1::-1], size)
    if not raw.any():
        raise DatasetError(f"{path}: its depth is 0 everywhere; restore it, or replay with --depth network")
    return np.where(raw > 0, raw.astype(np.float32) / np.float32(units_per_m), np.float32(np.nan))


def _decoded(path: Path, flags: int) -> cv2.typing.MatLike:
    logging = cv2.utils.logging
    before = logging.setLogLevel(logging.LOG_LEVEL_SILENT)  # the sentence below says it
    image = None
    try:
        if path.exists() and not path.is_file():  # a pipe or a device may never end
            fault = "is not an ordinary file"
        elif path.exists() and path.stat().st_size > MAX_FILE_BYTES:
            fault = f"is larger than {MAX_FILE_BYTES >> 20} MiB"
        else:
            data = path.read_bytes()
            known = _fault(data)
            fault = known or "is no image"
            image = None if known else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (OSError, ValueError) as error:  # ValueError: what a list names cannot be a path
        fault = f"cannot be read ({error.strerror if isinstance(error, OSError) else error})"
    except cv2.error:  # of a header that claims more pixels than OpenCV is to take, or of no bytes at all
        fault = "has more pixels than any camera, or none"
    finally:
        logging.setLogLevel(before)
    if image is None:
        raise DatasetError(f"{path}: {fault}; restore it, or leave its frame out")
    return image


def _fault(data: bytes) -> str | None:
    """What is wrong with a file before it is decoded, and memory taken for what it claims to hold."""
    if not data:
        return "is empty"
    if (costs := cost_fault(data)) is not None:
        return costs
    if data.startswith(_PNG):
        return _png_fault(data)
    if data.startswith(_JPEG) and _JPEG_END not in data[-64:]:
        return "the JPEG ends too early"
    return None


def _png_fault(data: bytes) -> str | None:
    at = len(_PNG)
    while at + _CHUNK_FRAME <= len(data):
        end = at + _CHUNK_FRAME + int.from_bytes(data[at : at + 4])
        if end > len(data):
            break
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end]):
            return f"the PNG is damaged at byte {at}"
        if data[at + 4 : at + 8] == _PNG_END:
            return None
        at = end
    return "the PNG ends too early"


def _check_size(path: Path, found: tuple[int, ...], size: tuple[int, int]) -> None:
    if found != size:
        raise DatasetError(
            f"{path}: is {found[0]} x {found[1]} pixels, and the camera {size[0]} x {size[1]}; "
            "give it the dataset's size"
        )


VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".mpg", ".mpeg"})


@contextmanager
def opened_video(path: Path) -> Iterator[cv2.VideoCapture]:
    """A video for OpenCV, unrotated whatever orientation the file asks for; closed at the end."""
    # The decoder's own messages about a damaged file would go to stderr, beside our own sentence.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    logging = cv2.utils.logging
    before = logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    logging.setLogLevel(before)
    # As recorded: a phone's rotation metadata would turn the image away from its calibration.
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    try:
        yield video
    finally:
        video.release()


def images_of_video(path: Path, every: int = 1, *, upright: bool = False) -> Iterator[tuple[int, UInt8Array]]:
    """Number and image (h, w, 3), RGB, of every ``every``-th frame, as far as frames can be decoded.

    ``upright``: turned as the file's orientation says. Raises DatasetError for a video that claims to be huge.
    """
    with opened_video(path) as video:
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, int(upright))
        width, height = (int(video.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > MAX_IMAGE_PIXELS:
            raise DatasetError(f"{path}: says that it has {width} x {height} pixels; convert it to a smaller one")
        index = 0
        while video.grab():
            if index % every == 0:
                there, image = video.retrieve()
                if not there:
                    return
                yield index, np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
            index += 1
