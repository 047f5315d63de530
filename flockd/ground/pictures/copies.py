"""Copies of pictures and videos with the detections drawn into them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from flockd.core.data import written_whole
from flockd.core.errors import UsageError
from flockd.core.messages import UInt8Array
from flockd.ground.datasets.image_files import SUFFIXES, VIDEO_SUFFIXES
from flockd.ground.pictures.picture_files import PictureFile
from flockd.ground.pictures.single_frame import DetectedDrone, PictureResult
from flockd.onboard.telemetry.preview import colour_of, draw_box, write_at

_JPEG = {".jpg", ".jpeg"}
VIDEO = ".mp4"
_CODEC = cv2.VideoWriter.fourcc(*"vp09")
"""VP9, which OpenCV's wheels encode, and browsers and players show."""


class Copies:
    """A folder of copies with the structure of the given folder: JPEG stays JPEG, videos become MP4, others PNG. Or the
    file name of the copy of a single video."""

    def __init__(self, out: Path, pictures: Sequence[PictureFile], *, overwrite: bool) -> None:
        """Raises UsageError, before any work, if a copy would overwrite a file."""
        self._targets: dict[PictureFile, Path] = {}
        self.written = 0
        sources = {picture.path.resolve() for picture in pictures}
        names_video = out.suffix.lower() == VIDEO and not out.is_dir()
        if names_video and not (len(pictures) == 1 and pictures[0].is_video):
            raise UsageError(f"{out}: is the name of one video, and there are other pictures; name a folder with --out")
        if not out.is_dir() and not names_video and (out.exists() or out.suffix.lower() in SUFFIXES | VIDEO_SUFFIXES):
            raise UsageError(f"{out}: is not a folder; name one with --out, or a video ending in .mp4")
        taken: dict[Path, Path] = {}
        for picture in pictures:
            kept = picture.path.suffix if picture.path.suffix.lower() in _JPEG else ".png"
            suffix = VIDEO if picture.is_video else kept
            target = out if names_video else out / picture.relative.with_suffix(suffix)
            if target.resolve() in sources:
                raise UsageError(f"{target}: is one of the pictures themselves; name another folder with --out")
            if target in taken:
                both = f"{taken[target]} and {picture.path}"
                raise UsageError(f"{both}: both copies would be {target}; draw them with a command each")
            if target.exists() and not overwrite:
                raise UsageError(f"{target}: exists; name another with --out, or overwrite it with --force")
            self._targets[picture], taken[target] = target, picture.path

    @contextmanager
    def of(self, picture: PictureFile, every: int) -> Iterator[Callable[[UInt8Array], None]]:
        """Writes the copy of an image, or of a video's ``every``-th frames, (h, w, 3), RGB, one after the other.

        An interrupted one leaves what was there. Raises OSError, and UsageError for a video that cannot be written.
        """
        target = self._targets[picture]
        target.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(target) as draft:
            if picture.is_video:
                with video_file(draft, target, picture.rate_hz(every)) as write:
                    yield write
            else:
                yield lambda image: _write_image(draft, image)
            self.written += draft.exists()


@contextmanager
def video_file(draft: Path, target: Path, rate_hz: float) -> Iterator[Callable[[UInt8Array], None]]:
    """Writes images (h, w, 3), RGB, all of one size, to the draft of a video. Raises UsageError if that cannot be.

    OpenCV does not report a full disk: the index at the end of the file is then missing.
    """
    video, written = cv2.VideoWriter(), False

    def write(image: UInt8Array) -> None:
        nonlocal written
        size = (image.shape[1], image.shape[0])
        if not video.isOpened() and not video.open(str(draft), _CODEC, rate_hz, size):
            raise UsageError(f"{target}: cannot be written; name another place for it")
        video.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        written = True

    try:
        yield write
    finally:
        video.release()
    if written and not cv2.VideoCapture(str(draft)).isOpened():
        raise UsageError(f"{target}: cannot be written whole, as on a full disk; make room, or name another place")


def _write_image(file: Path, image: UInt8Array) -> None:
    file.write_bytes(cv2.imencode(file.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes())


_MASK_WEIGHT = 0.4
_REFERENCE_PX = 900.0
"""Longer side of a picture for lines of one pixel."""


def annotated(image: UInt8Array, result: PictureResult) -> UInt8Array:
    """A copy of an image (h, w, 3), RGB, with each detection's box, mask, range and probability."""
    height, width = image.shape[:2]
    mask = cv2.resize(result.mask, (width, height), interpolation=cv2.INTER_NEAREST)
    drawn = image.copy()
    thick = max(round(max(width, height) / _REFERENCE_PX), 1)
    numbers = [number if one.track is None else one.track - 1 for number, one in enumerate(result.detections)]
    colours = [colour_of(number) for number in numbers]
    for one, colour in zip(result.detections, colours, strict=True):
        mine = (mask == one.label) & (one.label > 0)
        tint = (1 - _MASK_WEIGHT) * drawn[mine] + _MASK_WEIGHT * np.array(colour)
        drawn[mine] = np.round(tint).astype(np.uint8)
        draw_box(drawn, one.box, colour, thick)
    for one, colour in zip(result.detections, colours, strict=True):
        write_at(drawn, one.box, _described(one), colour, thick)
    return drawn


def range_text(range_m: float, sigma_m: float, *, known: bool) -> str:
    """A range with its standard deviation; for an unknown kind the interval that holds it in two of three cases."""
    if known:
        return f"{range_m:.2f} +- {sigma_m:.2f}"
    factor = math.exp(sigma_m / range_m)
    return f"{range_m / factor:.1f} to {range_m * factor:.1f}"


def _described(one: DetectedDrone) -> str:
    kind = "" if one.kind_known else ", kind unknown"
    text = f"{range_text(one.range_m, one.range_sigma_m, known=one.kind_known)} m{kind}, p {one.probability:.2f}"
    return text if one.track is None else f"drone {one.track}: {text}"
