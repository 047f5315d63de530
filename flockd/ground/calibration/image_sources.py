"""Images to calibrate with, from a folder or a live camera."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from flockd.core.config import DroneConfig
from flockd.core.errors import UnavailableError
from flockd.core.messages import UInt8Array
from flockd.ground.calibration.board import CalibrationError
from flockd.ground.datasets.image_files import SUFFIXES, in_order, read_image, unread, visible
from flockd.onboard.sources import FrameSource, open_source

MOST_S = 120.0
"""Longest calibration by a live camera."""
FIRST_FRAME_S = 10.0
FRAME_WAIT_S = 0.2


@dataclass(frozen=True, eq=False)
class ImageStream:
    """One camera's images, one after the other."""

    images: Iterator[tuple[str, UInt8Array]]
    """Name, and (h, w, 3) RGB."""
    count: int
    """Approximate number of images; 0 for a live camera."""
    live: bool
    identity: str
    """The camera's path, preferably that of its socket."""


def from_folder(path: Path) -> ImageStream:
    """All images of a folder, by name. Raises CalibrationError if it has no images."""
    files = in_order(file for file in visible(path) if file.suffix.lower() in SUFFIXES and file.is_file())
    if (others := unread(visible(path))) is not None:
        raise CalibrationError(f"{path}: has {others}")
    if not files:
        raise CalibrationError(f"{path}: has no images; name the folder they are in")
    images = ((file.name, read_image(file)) for file in files)
    return ImageStream(images, len(files), live=False, identity=f"not known (images in {path.name})")


def from_camera(config: DroneConfig, file: str, name: str, enough: Callable[[], bool]) -> ImageStream:
    """Frames of a drone's live camera, until there are enough views, the time is up, or Ctrl-C. Raises ConfigError.
    Reading raises UnavailableError if no frame comes."""
    rig = config.rig.model_copy(update={"cameras": tuple(one for one in config.rig.cameras if one.name == name)})
    source, device = config.source, None
    if source is not None and source.cameras:
        wanted = next(one for one in source.cameras if one.name == name)
        if wanted.crop is not None:
            wanted = wanted.model_copy(update={"crop_of": source.whole_px(wanted)})
        source, device = source.model_copy(update={"cameras": (wanted,)}), wanted.device
    images = _frames(open_source(config.model_copy(update={"rig": rig, "source": source}), file), name, enough)
    return ImageStream(images, 0, live=True, identity=device or f"not known ({name})")


def _frames(source: FrameSource, name: str, enough: Callable[[], bool]) -> Iterator[tuple[str, UInt8Array]]:
    source.start()
    began_s, seen = time.monotonic(), False
    try:
        while (since_s := time.monotonic() - began_s) < MOST_S and not enough():
            frames = source.newest(FRAME_WAIT_S)
            if frames is not None:
                seen = True
                if name in frames.frames:
                    yield f"{since_s:.1f} s", frames.frames[name].image
            elif not seen and since_s > FIRST_FRAME_S:
                break
        if not seen:
            faults = [status.fault for status in source.status().values() if status.fault]
            raise UnavailableError(faults[0] if faults else "no camera gave a frame; check how it is plugged in")
    finally:
        source.stop()
