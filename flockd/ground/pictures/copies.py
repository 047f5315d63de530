"""Copies of pictures with what was detected drawn into them, of videos of each frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from flockd.core.errors import UsageError
from flockd.core.messages import UInt8Array
from flockd.ground.pictures.picture_files import PictureFile
from flockd.ground.pictures.single_frame import Box, DetectedDrone, PictureResult

_JPEG = {".jpg", ".jpeg"}


class Copies:
    """A folder of copies, each at its picture's place in the folder that was named: JPEG stays JPEG, else it is PNG. Of
    a video's frames each has its number behind the video's name."""

    def __init__(self, folder: Path, pictures: Sequence[PictureFile], *, overwrite: bool) -> None:
        """Raises UsageError where a copy would take a file's place: before the work, not after it."""
        self._targets: dict[PictureFile, Path] = {}
        self.written = 0
        sources = {picture.path.resolve() for picture in pictures}
        if folder.exists() and not folder.is_dir():
            raise UsageError(f"{folder}: is no folder; name one with --out")
        taken: dict[Path, Path] = {}
        for picture in pictures:
            suffix = picture.path.suffix if picture.path.suffix.lower() in _JPEG else ".png"
            target = folder / picture.relative.with_suffix(suffix)
            if target.resolve() in sources:
                raise UsageError(f"{target}: is one of the pictures themselves; name another folder with --out")
            if target in taken:
                both = f"{taken[target]} and {picture.path}"
                raise UsageError(f"{both}: both copies would be {target}; draw them with a command each")
            frames = target.parent.glob(f"{target.stem}-*{suffix}") if picture.is_video else ()
            if (target.exists() or any(frames)) and not overwrite:
                raise UsageError(f"{target}: exists; name another folder, or overwrite it with --force")
            self._targets[picture], taken[target] = target, picture.path

    def write(self, picture: PictureFile, name: str, image: UInt8Array) -> None:
        """The image (h, w, 3), RGB, of this name as `PictureFile.images` gives it. Raises OSError."""
        target = self._targets[picture]
        if picture.is_video:
            target = target.with_stem(f"{target.stem}-{name.rpartition('#')[2]}")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(cv2.imencode(target.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes())
        self.written += 1


_COLOURS = ((255, 109, 0), (0, 176, 255), (213, 0, 249), (0, 200, 83), (255, 214, 0), (255, 23, 68))
"""RGB, of one detection after the other."""
_MASK_WEIGHT = 0.4
_REFERENCE_PX = 900.0
"""Longer side of a picture that lines of one pixel suit."""
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def annotated(image: UInt8Array, result: PictureResult) -> UInt8Array:
    """A copy of an image (h, w, 3), RGB, with each detection's box, mask, range and probability."""
    height, width = image.shape[:2]
    mask = cv2.resize(result.mask, (width, height), interpolation=cv2.INTER_NEAREST)
    drawn = image.copy()
    thick = max(round(max(width, height) / _REFERENCE_PX), 1)
    for number, one in enumerate(result.detections):
        colour = _COLOURS[number % len(_COLOURS)]
        mine = mask == one.label
        tint = (1 - _MASK_WEIGHT) * drawn[mine] + _MASK_WEIGHT * np.array(colour)
        drawn[mine] = np.round(tint).astype(np.uint8)
        _rectangle(drawn, one.box, colour, thick)
    for number, one in enumerate(result.detections):
        _write(drawn, one, _COLOURS[number % len(_COLOURS)], thick)
    return drawn


def _rectangle(image: UInt8Array, box: Box, colour: tuple[int, int, int], thick: int) -> None:
    """Around the box, not over what is in it."""
    left, top = (int(np.floor(value)) - thick for value in box[:2])
    right, bottom = (int(np.ceil(value)) + thick - 1 for value in box[2:])
    cv2.rectangle(image, (left, top), (right, bottom), colour, thick)


def _write(image: UInt8Array, one: DetectedDrone, colour: tuple[int, int, int], thick: int) -> None:
    """Below the box, or above it where the image ends; on a dark ground, to be read on any background."""
    text = f"{one.range_m:.2f} +- {one.range_sigma_m:.2f} m, p {one.probability:.2f}"
    scale, (height, width) = 0.42 * thick, image.shape[:2]
    (wide, high), _ = cv2.getTextSize(text, _FONT, scale, thick)
    left, below = int(np.clip(one.box[0], 0, max(width - wide, 0))), int(one.box[3]) + 3 * thick
    top = below if below <= height - 2 * high else max(int(one.box[1]) - 3 * thick - 2 * high, 0)
    image[top : top + 2 * high, left : left + wide] //= 4
    cv2.putText(image, text, (left, top + round(1.5 * high)), _FONT, scale, colour, thick, cv2.LINE_AA)
