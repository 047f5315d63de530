"""Copies of pictures with what was detected drawn into them: images as images, videos as videos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Self

import cv2

from flockd.core.errors import UnavailableError, UsageError
from flockd.core.messages import UInt8Array
from flockd.ground.pictures.picture_files import PictureFile

_JPEG = {".jpg", ".jpeg"}


class Copies:
    """A folder of copies, each at its picture's place in the folder that was named. JPEG stays JPEG, else it is PNG."""

    def __init__(self, folder: Path, pictures: Sequence[PictureFile], every: int, *, overwrite: bool) -> None:
        """Raises UsageError where a copy would take a file's place: before the work, not after it."""
        self._every = every
        self._targets: dict[PictureFile, Path] = {}
        self._video: _VideoCopy | None = None
        self.written = 0
        """Copies that are there; a video counts from its first image on."""
        sources = {picture.path.resolve() for picture in pictures}
        if folder.exists() and not folder.is_dir():
            raise UsageError(f"{folder}: is no folder; name one with --out")
        taken: dict[Path, Path] = {}
        for picture in pictures:
            target = folder / _named(picture)
            if target.resolve() in sources:
                raise UsageError(f"{target}: is one of the pictures themselves; name another folder with --out")
            if target in taken:
                both = f"{taken[target]} and {picture.path}"
                raise UsageError(f"{both}: both copies would be {target}; draw them with a command each")
            if target.exists() and not overwrite:
                raise UsageError(f"{target}: exists; name another folder, or overwrite it with --force")
            self._targets[picture], taken[target] = target, picture.path

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._end_video(whole=kind is None)

    def write(self, picture: PictureFile, image: UInt8Array) -> None:
        """The next image (h, w, 3), RGB, of a picture. Raises OSError, and UnavailableError without a video encoder."""
        target = self._targets[picture]
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        if self._video is not None and self._video.target != target:
            self._end_video(whole=True)
        target.parent.mkdir(parents=True, exist_ok=True)
        self.written += self._video is None
        if picture.is_video:
            if self._video is None:
                self._video = _VideoCopy(target, picture.rate_hz() / self._every, (image.shape[1], image.shape[0]))
            self._video.writer.write(bgr)
        else:
            target.write_bytes(cv2.imencode(target.suffix, bgr)[1].tobytes())

    def _end_video(self, *, whole: bool) -> None:
        if self._video is not None:
            self._video.close(whole=whole)
            self._video = None


class _VideoCopy:
    """A video that takes its name when it is whole."""

    def __init__(self, target: Path, rate_hz: float, size: tuple[int, int]) -> None:
        self.target, self._draft = target, target.with_name(f".{target.stem}.part.mp4")
        self.writer = cv2.VideoWriter(str(self._draft), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, size)
        if not self.writer.isOpened():
            raise UnavailableError(f"{target}: OpenCV cannot write MP4 here; run without --out, or on single images")

    def close(self, *, whole: bool) -> None:
        self.writer.release()
        if whole:
            self._draft.replace(self.target)
        else:
            self._draft.unlink(missing_ok=True)


def _named(picture: PictureFile) -> Path:
    if picture.is_video:
        return picture.relative.with_suffix(".mp4")
    return picture.relative if picture.path.suffix.lower() in _JPEG else picture.relative.with_suffix(".png")
