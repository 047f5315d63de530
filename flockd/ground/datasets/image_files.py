"""Reads image and depth files, and refuses incomplete ones, in which a decoder would fill in missing data."""

from __future__ import annotations

import os
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from decimal import Decimal
from pathlib import Path
from tempfile import TemporaryFile

import cv2
import numpy as np

from flockd.core.data import LFS_POINTER
from flockd.core.errors import FlockdError
from flockd.core.jpeg_header import MAX_IMAGE_PIXELS, cost_fault, jpeg_end
from flockd.core.messages import Float32Array, UInt8Array


class DatasetError(FlockdError):
    """A dataset, or a part of it, is missing, damaged or does not fit the other parts."""


def _suffixes(names: str) -> frozenset[str]:
    return frozenset(f".{name}" for name in names.split())


SUFFIXES = _suffixes("png jpg jpeg jfif jpe bmp pnm ppm pgm tif tiff webp avif")
UNREAD_SUFFIXES = _suffixes(
    "heic heif jxl mpo tga exr hdr svg pdf jp2 gif dng cr2 cr3 nef arw raf orf rw2 x3f gpr insp psd ico pbm pfm raw "
    "yuv nv12 3gp 3g2 mts m2ts ts wmv flv insv ogv mjpeg mjpg h264 264 h265 265 hevc y4m"
)
"""Kinds of pictures and videos that are not read; those of a folder are reported."""
_WITH_PAGES = re.compile(rb"II[*+]\0|MM\0[*+]|GIF8|RIFF....WEBP|....ftypavi", re.DOTALL)
"""First bytes of files that may hold several pages, whatever their name."""
_PAGES = "has {} pages, of which one would be read; save each as an image"
_PNG, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
_JPEG = b"\xff\xd8"
MAX_FILE_BYTES = 1 << 29
"""Largest file: an uncompressed image of the largest permitted size with 16 bits, and some reserve."""
_XMP = 1 << 17
"""Bytes in which a JPEG tells its projection (GPano, as of phones and 360 degree cameras)."""
_AVIF_HEAD = 4096
"""Bytes in which the properties of an AVIF's image are."""
_CHUNK_FRAME = 12
"""Bytes of a PNG chunk beside its data: length, name and checksum."""


def visible(folder: Path, pattern: str = "*") -> list[Path]:
    """What matches in a folder, without names that begin with a dot, and without what is below such a name: macOS lays
    a `._` file beside each on a foreign disk, and viewers keep thumbnails in hidden folders."""
    found = folder.glob(pattern)
    return [one for one in found if not any(part.startswith(".") for part in one.relative_to(folder).parts)]


def unread(files: Iterable[Path]) -> str | None:
    """A sentence about the pictures and videos among these that are not read, by kind; None: all are read."""
    files = list(files)
    counts = Counter(suffix for file in files if (suffix := file.suffix.lower()) in UNREAD_SUFFIXES)
    kinds = ", ".join(f"{count} {suffix}" for suffix, count in sorted(counts.items()))
    told = (
        [f"pictures or videos of kinds that are not read ({kinds}); convert them to JPEG, PNG or MP4"] if kinds else []
    )
    told += [
        f"{file.name}, which is a link to nothing, or not an ordinary file; restore or delete it"
        for file in files
        if file.suffix.lower() in SUFFIXES | VIDEO_SUFFIXES and not (file.is_file() or file.is_dir())
    ]
    return ", and ".join(told) or None


_FAR_ABOVE = 8
"""Least value, in ranges of the values, that is no sensor's black level or haze."""
_USED_PERCENT = (0.1, 99.9)
"""Of the values of an image with more than 8 bits; single hot and dead pixels do not count."""


def in_order(files: Iterable[Path]) -> list[Path]:
    """Sorts by name, with numbers as numbers: `frame2` comes before `frame10`."""

    def parts(file: Path) -> list[tuple[str, Decimal]]:
        found = re.findall(r"(\D*)(\d*(?:(?<=\d)\.\d+)?)", str(file.with_suffix("")))
        return [(text, Decimal(number or 0)) for text, number in found]

    return sorted(files, key=lambda file: (parts(file), file))


def read_image(path: Path, size: tuple[int, int] | None = None) -> UInt8Array:
    """(h, w, 3) RGB, turned as the file's orientation says; grey images have three equal channels. Of images with
    10, 12 or 16 bits the range that they use becomes 8 bits; it begins at 0, unless all values are far above, as of
    thermal cameras. Raises DatasetError, also for another ``size``.
    """
    # Not IMREAD_COLOR_RGB: OpenCV 5.0.0 garbles TIFF of 16 bits with it.
    decoded = _decoded(path, cv2.IMREAD_COLOR_BGR | cv2.IMREAD_ANYDEPTH)
    if decoded.dtype not in (np.uint8, np.uint16):
        raise DatasetError(f"{path}: has pixels of {decoded.dtype}; save it with 8 or 16 bits a channel")
    image = cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)
    if image.dtype == np.uint16:
        least, most = (int(value) for value in np.percentile(image, _USED_PERCENT))
        if least > _FAR_ABOVE * (most - least):
            image, most = np.maximum(image, least) - np.uint16(least), most - least
        image = np.minimum(np.right_shift(np.asarray(image, np.uint16), max(most.bit_length() - 8, 0)), 255)
    if size is not None:
        _check_size(path, image.shape[1::-1], size)
    return np.asarray(image, np.uint8)


def read_depth(path: Path, size: tuple[int, int], units_per_m: float) -> Float32Array:
    """(h, w) metres, NaN for 0 in the file. Raises DatasetError, also for a file of zeros only."""
    raw = _decoded(path, cv2.IMREAD_UNCHANGED)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise DatasetError(f"{path}: is not a depth map; it needs one channel of 16 bits")
    _check_size(path, raw.shape[1::-1], size)
    if not raw.any():
        raise DatasetError(f"{path}: its depth is 0 everywhere; restore it, or replay with --depth network")
    return np.where(raw > 0, raw.astype(np.float32) / np.float32(units_per_m), np.float32(np.nan))


def _decoded(path: Path, flags: int) -> cv2.typing.MatLike:
    logging = cv2.utils.logging
    before = logging.setLogLevel(logging.LOG_LEVEL_SILENT)  # the sentence below says it
    image, fault = None, None
    try:
        if path.exists() and not path.is_file():  # a pipe or a device may never end
            fault = "is not an ordinary file"
        elif path.exists() and path.stat().st_size > MAX_FILE_BYTES:
            fault = f"is larger than {MAX_FILE_BYTES >> 20} MiB"
        else:
            data = path.read_bytes()
            data = data[: jpeg_end(data)]  # what cameras and phones write behind it is not looked at
            fault = _fault(data) or _pages_fault(path, data) or _hole(data)
            if fault is None:
                with _stderr_of_libraries() as said:
                    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
                    damage = said()
                if image is not None and damage:
                    image, fault = None, f"is damaged inside ({damage})"
            others = (told for head, told in _OTHERS.items() if re.match(head, data, re.DOTALL))
            fault = fault or next(others, "is no image")
    except (OSError, ValueError) as error:  # ValueError: what a list names cannot be a path
        fault = f"cannot be read ({error.strerror if isinstance(error, OSError) else error})"
    except cv2.error:  # of a header that claims more pixels than OpenCV is to take, or of no bytes at all
        fault = "has more pixels than any camera, or none"
    finally:
        logging.setLogLevel(before)
    if image is None:
        remedy = "" if "; " in str(fault) else "; restore it, or leave its frame out"
        raise DatasetError(f"{path}: {fault}{remedy}")
    return image


_CONVERT = "is of a format that is not read; save it as JPEG or PNG"
_DAMAGED = "is damaged, or a kind of its format that is not read; restore it, or save it as PNG"
_OTHERS = {
    rb"GIF8|P[1-37]\s|Pf\s|\0\0\0\x0c(jP|JXL)|\xff\n|\xffO\xffQ|....ftyp(hei|hev|mif|msf|crx)": _CONVERT,
    rb"v/1\x01|#\?RADIANCE|8BPS|\0\0\x01\0": _CONVERT,
    rb"\xff\xd8|II[*+]|MM\0|RIFF....WEBP|....ftypavi": _DAMAGED,
    rb"....ftyp|\x1aE\xdf\xa3|RIFF....AVI ": "is a video by its contents; give its name that ending",
    rb"\x1f\x8b|PK\x03\x04|\x28\xb5\x2f\xfd": "is packed; unpack it",
    rb"%PDF|<svg|<\?xml|<!DOCTYPE|<html": "is a document; save its picture as PNG",
    re.escape(LFS_POINTER): "is a pointer of Git LFS; fetch the file with `git lfs pull`",
}
"""First bytes of files with an image's name that are no image."""


def _fault(data: bytes) -> str | None:
    """The fault of a file, found before it is decoded and memory is taken for its claimed size."""
    if not data:
        return "is empty"
    if (costs := cost_fault(data)) is not None:
        return costs
    if data.startswith(_PNG):
        return _png_fault(data)
    if data.startswith(_JPEG) and jpeg_end(data) is None:
        return "the JPEG ends too early"
    return None


_SECTOR = 512
_PACKED = re.compile(rb"RIFF....WEBP|....ftypavi", re.DOTALL)
_PLAIN = re.compile(rb"BM|P[4-6]\s|II[*+]\0|MM\0[*+]")
"""First bytes of formats with compressed data, and of others, whose decoders take zeros for data."""


def _hole(data: bytes) -> str | None:
    """Where a disk has lost data: compressed ones hold no long runs of zeros, others may, but not of whole sectors."""
    packed = _PACKED.match(data) is not None
    for run in re.finditer(rb"\0{512,}", data) if packed or _PLAIN.match(data) else ():
        if packed or (run.start() % _SECTOR == 0 and (run.end() % _SECTOR == 0 or run.end() == len(data))):
            return f"holds {run.end() - run.start()} bytes of zeros in place of data, from byte {run.start()} on"
    return None


def _pages_fault(path: Path, data: bytes) -> str | None:
    if b"GPano:ProjectionType" in data[:_XMP]:
        return "is a panorama, as no lens gives it; cut a part out with straight lines"
    pages = cv2.imcount(str(path)) if _WITH_PAGES.match(data) else 1
    if pages <= 1 and re.search(rb"\0\0\0\x09(irot[\1-\3]|imir)", data[:_AVIF_HEAD]) and data[4:8] == b"ftyp":
        return "is turned or mirrored by its header, which is not read; save it as JPEG"
    return _PAGES.format(pages) if pages > 1 else None


@contextmanager
def _stderr_of_libraries() -> Iterator[Callable[[], str]]:
    """Captures what decoders write to standard error: only there libjpeg reports that it has filled in damaged data."""
    with TemporaryFile() as said:
        before = os.dup(2)
        os.dup2(said.fileno(), 2)

        def read() -> str:
            said.seek(0)
            lines = said.read().decode("utf-8", "replace").splitlines()
            return next((line for line in lines if re.search("corrupt|premature", line, re.IGNORECASE)), "")

        try:
            yield read
        finally:
            os.dup2(before, 2)
            os.close(before)


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
        if data[at + 4 : at + 8] == b"acTL" and (pages := int.from_bytes(data[at + 8 : at + 12])) > 1:
            return _PAGES.format(pages)
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
    """A video for OpenCV, turned as the file's orientation says; closed at the end."""
    # The decoder's own messages about a damaged file would go to stderr, beside our own sentence.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    logging = cv2.utils.logging
    before = logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    logging.setLogLevel(before)
    try:
        yield video
    finally:
        video.release()


_MISSING = 0.02
"""Share of its frames that a video may lack: some containers count frames that are not shown."""


def images_of_video(path: Path, every: int = 1) -> Iterator[tuple[int, float, UInt8Array]]:
    """Number, time in seconds and image (h, w, 3), RGB, of every ``every``-th frame, as far as frames can be decoded.

    Raises DatasetError for a video that claims to be huge, and behind the frames of one that ends too early.
    """
    with opened_video(path) as video:
        width, height = (int(video.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > MAX_IMAGE_PIXELS:
            raise DatasetError(f"{path}: says that it has {width} x {height} pixels; convert it to a smaller one")
        count, rate_hz = video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)
        index, last_s = 0, 0.0
        while video.grab():
            if count < 0 and path.suffix.lower() in _COUNTED:
                raise DatasetError(f"{path}: lacks its beginning, or its list of frames; restore it")
            last_s = video.get(cv2.CAP_PROP_POS_MSEC) / 1e3
            if index % every == 0:
                there, image = video.retrieve()
                if not there:
                    break
                yield index, last_s, np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
            index += 1
        # By count and by time: of some containers the count is the duration times a rate that changed.
        short = index < (1 - _MISSING) * count - 1
        counted = path.suffix.lower() in _COUNTED or (rate_hz > 0 and last_s < (1 - _MISSING) * (count - 1) / rate_hz)
        if index and short and counted:
            raise DatasetError(f"{path}: is damaged: {index} of its {count:.0f} frames were read; restore it")


_COUNTED = frozenset({".mp4", ".mov", ".m4v", ".avi"})
"""Videos that hold the number of their frames."""
