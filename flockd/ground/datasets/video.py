"""Video files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from flockd.core.jpeg_header import MAX_IMAGE_PIXELS
from flockd.core.messages import UInt8Array
from flockd.ground.datasets.errors import DatasetError

SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v", ".mpg", ".mpeg"})


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
