"""A video file of one camera; its calibration comes from elsewhere."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flockd.core.config.rig import CameraConfig
from flockd.core.errors import ConfigError
from flockd.core.image_header import MAX_IMAGE_PIXELS
from flockd.core.messages import UInt8Array
from flockd.ground.datasets.camera_intrinsics import read_calibration
from flockd.ground.datasets.dataset import DatasetFrame, Moment
from flockd.ground.datasets.errors import DatasetError

SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".mpg", ".mpeg"})
_COUNT_TOLERANCE = 2
"""So many frames fewer than the file claims are no damage: containers count what a decoder does not show."""


@dataclass(frozen=True, eq=False)
class VideoDataset:
    """Frames decoded one after the other."""

    path: Path
    camera: CameraConfig
    claimed: int
    """How many frames the file says it has."""
    rate_hz: float
    has_depth: bool = False
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return self.claimed

    def frames(self, *, with_depth: bool) -> Iterator[DatasetFrame]:
        """See ``FileDataset``; there is no depth."""
        count = 0
        for index, image in images_of_video(self.path):
            yield DatasetFrame(Moment(index, f"{index}", index / self.rate_hz, None), image, None)
            count = index + 1
        if count < self.claimed - _COUNT_TOLERANCE:
            raise DatasetError(f"{self.path}: ends after {count} of {self.claimed} frames; restore it")


def open_video(path: Path, calibration: Path | None) -> VideoDataset:
    """A video, its frames evenly spaced in time. Raises DatasetError and ConfigError."""
    if not path.is_file():
        raise DatasetError(f"{path}: does not exist; name a video")
    with opened_video(path) as video:
        rate_hz, claimed = video.get(cv2.CAP_PROP_FPS), int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    _, first = next(images_of_video(path), (0, None))
    if first is None or not rate_hz > 0 or claimed < 1:
        raise DatasetError(f"{path}: is no video that can be decoded; restore it, or convert it to MP4")
    if calibration is None:
        raise ConfigError.at(path, "brings no calibration; name one with --calibration")
    camera = read_calibration(calibration, (first.shape[1], first.shape[0]))
    return VideoDataset(path, camera, claimed, rate_hz)


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
