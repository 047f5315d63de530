"""Pictures on disk: images, folders of them, and the frames of videos."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2

from flockd.core.errors import UsageError
from flockd.core.messages import UInt8Array
from flockd.ground.datasets.image_files import (
    SUFFIXES,
    VIDEO_SUFFIXES,
    DatasetError,
    images_of_video,
    in_order,
    opened_video,
    read_image,
    unread,
    visible,
)


class Picture(NamedTuple):
    """An image, or a frame of a video."""

    name: str
    image: UInt8Array
    """(h, w, 3) RGB"""
    time_s: float = 0.0
    """Time since the beginning of the video; 0: an image."""


@dataclass(frozen=True)
class PictureFile:
    """An image or a video."""

    path: Path
    root: Path
    """The folder given by the user, or the file's own."""

    @property
    def is_video(self) -> bool:
        """Whether it is a video, by its suffix."""
        return self.path.suffix.lower() in VIDEO_SUFFIXES

    @property
    def relative(self) -> Path:
        """Path relative to the folder given by the user."""
        return self.path.relative_to(self.root)

    def count(self, every: int) -> int:
        """Approximate number of pictures, for a progress bar."""
        if not self.is_video:
            return 1
        with opened_video(self.path) as opened:
            return max(-(-int(opened.get(cv2.CAP_PROP_FRAME_COUNT)) // every), 1)

    def rate_hz(self, every: int) -> float:
        """Of a video's ``every``-th frames."""
        with opened_video(self.path) as opened:
            return (opened.get(cv2.CAP_PROP_FPS) or _USUAL_RATE_HZ) / every

    def images(self, every: int) -> Iterator[Picture]:
        """Reads the image, or every ``every``-th frame of a video, upright.

        Raises DatasetError where it cannot be read.
        """
        if not self.is_video:
            image = read_image(self.path)
            height, width = image.shape[:2]
            if min(height, width) < SMALLEST_PX:
                told = f"is {width} x {height} pixels, and {SMALLEST_PX} x {SMALLEST_PX} are needed"
                raise DatasetError(f"{self.path}: {told}; give the whole picture")
            yield Picture(str(self.path), image)
            return
        index = None
        for index, time_s, image in images_of_video(self.path, every):
            yield Picture(f"{self.path}#{index}", image, time_s)
        if index is None:
            raise DatasetError(f"{self.path}: cannot be decoded as a video; restore it, or convert it to MP4")


SMALLEST_PX = 32
"""Smallest side of an image, as in `rig.cameras[].size_px`."""
_USUAL_RATE_HZ = 30.0
"""Frame rate of videos that do not give theirs."""


def find_pictures(
    paths: Sequence[Path], but_not: Path | None = None, left_out: Callable[[str], None] = lambda sentence: None
) -> list[PictureFile]:
    """The given images and videos, and those in the given folders and below; each once.

    ``left_out`` is called with a sentence about files of a folder that are not read.

    In folders, hidden files and the contents of ``but_not``, a folder of copies, are ignored. Raises UsageError for a
    path that is neither image nor video, or is a folder without any.
    """
    endings = SUFFIXES | VIDEO_SUFFIXES
    copies = None if but_not is None else but_not.resolve()
    found: dict[Path, PictureFile] = {}
    for path in paths:
        if path.is_dir():
            there = [one for one in visible(path, "**/*") if not one.is_dir()]
            if copies is not None and path.resolve() in copies.parents:
                there = [one for one in there if not one.is_file() or copies not in one.resolve().parents]
            inside = in_order(one for one in there if one.suffix.lower() in endings and one.is_file())
            others = unread(there)
            if not inside:
                raise UsageError(f"{path}: has {others or 'no images or videos; name the folder that they are in'}")
            if others:
                left_out(f"{path}: {others}")
            for one in inside:
                found.setdefault(one.resolve(), PictureFile(one, path))
        elif not path.is_file():
            raise UsageError(f"{path}: is not an ordinary file; name an image, a video or a folder")
        elif path.suffix.lower() not in endings:
            raise UsageError(
                f"{path}: is not an image or a video by its name; its name ends in one of {', '.join(sorted(endings))}"
            )
        else:
            found.setdefault(path.resolve(), PictureFile(path, path.parent))
    return list(found.values())
