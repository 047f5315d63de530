"""A video of a recording: what the drone's cameras saw, with what it detected."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flockd.core.errors import UnavailableError, UsageError
from flockd.core.messages import Detection, FloatArray, PilotOutput, UInt8Array
from flockd.flight.geometry import Rig, build_rig
from flockd.onboard.message_json import from_json
from flockd.onboard.recording.reader import Recording
from flockd.review.report.style import FEW, PLATE, PLATE_INK, colour_of, line, rgb, rig_place, write

_RING = 32
"""Points of a detection's outline."""


@dataclass(frozen=True, eq=False)
class Outline:
    """A detected drone in one image."""

    pixels: FloatArray
    """(n, 2) along a line around the drone, as far as it is in the image; it ends where it began if all of it is."""
    track: int | None
    """The track it belongs to; None for one that has none yet."""
    range_m: float | None


@dataclass(frozen=True, eq=False)
class VideoStep:
    """One step of one drone."""

    time_s: float
    """Since the flight's start."""
    images: Mapping[str, UInt8Array]
    """(h, w, 3) RGB by camera."""
    outlines: Mapping[str, Sequence[Outline]]
    """By camera."""


def recorded_steps(recording: Recording) -> Iterator[VideoStep]:
    """Each step of a recording, with the detections that were recorded. Raises RecordingError where it is damaged."""
    rig, zero_s = build_rig(recording.config.rig), recording.pilot_began_s
    for step in recording.steps():
        zero_s = step.frames.time_s if zero_s is None else zero_s
        output: PilotOutput | None = None if step.output is None else from_json(PilotOutput, step.output)
        time_s = step.frames.time_s - zero_s
        images = {name: frame.image for name, frame in step.frames.frames.items()}
        outlines = {} if output is None else _outlines(rig, output)
        yield VideoStep(time_s, images, outlines)


def _outlines(rig: Rig, output: PilotOutput) -> dict[str, list[Outline]]:
    found: dict[str, list[Outline]] = {}
    for detection, track in zip(output.detections, output.detection_tracks, strict=True):
        for camera, pixels in rig.pixels_of(_ring(detection)).items():
            line = _within(pixels)
            if len(line):
                found.setdefault(camera, []).append(Outline(line, track, detection.range_m))
    return found


def _within(ring: FloatArray) -> FloatArray:
    """The known points of a ring as one line, whose gap is where the ring has its own."""
    known = np.isfinite(ring[:, 0])
    if known.all():
        return np.concatenate([ring, ring[:1]])
    begins = np.flatnonzero(known & ~np.roll(known, 1))
    return np.roll(ring, -int(begins[0]), axis=0)[np.roll(known, -int(begins[0]))] if len(begins) else ring[:0]


def _ring(detection: Detection) -> FloatArray:
    """(n, 3) body points around the drone, across the line of sight."""
    across = np.linalg.svd(detection.bearing[None])[2][1:]  # two unit vectors at right angles to it
    angles = np.linspace(0.0, 2.0 * math.pi, _RING, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ across
    ring: FloatArray = detection.position + 0.5 * detection.size_m * around
    return ring


CODECS = {".webm": "VP90", ".mp4": "vp09"}
"""VP9 in both: free of royalties, in OpenCV's own build, and shown by every browser."""
_HEAD_PX, _GAP_PX, _IMAGES_PX = 36, 6, 640
"""Heights of the line above, of the gaps between images, and of all images together."""


def write_video(path: Path, recording: Recording, progress: Callable[[int, int], None]) -> int:
    """Writes the video, a frame a step in real time, and gives the number of frames.

    The file appears when it is whole. Raises UnavailableError where OpenCV has no encoder, and RecordingError where
    the recording is damaged.
    """
    draft = path.with_name(f".{path.stem}.part{path.suffix}")
    count, video = 0, None
    try:
        for step in recorded_steps(recording):
            frame = drawn(step, recording.drone)
            video = video or _opened(draft, 1.0 / recording.config.step_s, (frame.shape[1], frame.shape[0]))
            video.write(np.ascontiguousarray(frame[..., ::-1]))
            count += 1
            progress(count, len(recording.contents.steps))
        if video is None:
            raise UsageError(f"{path} was not written, as the flight has no step; name another flight")
        video.release()
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return count


def _opened(path: Path, rate_hz: float, size: tuple[int, int]) -> cv2.VideoWriter:
    code = cv2.VideoWriter_fourcc(*CODECS[path.suffix.lower()])  # type: ignore[attr-defined]
    with _silent_stderr():
        video = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, rate_hz, size)
    if not video.isOpened():
        raise UnavailableError(
            f"{path.suffix}: this build of OpenCV cannot write VP9; install opencv-python-headless with pip"
        )
    return video


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """OpenCV complains there, past its own log level, that WebM has no tag for the codec, which it does not need."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def drawn(moment: VideoStep, name: str) -> UInt8Array:
    """(h, w, 3) RGB, both sides even: all images, in reading order of a turn to the right, below the drone's name."""
    cameras = sorted(moment.images, key=rig_place)
    across = math.ceil(math.sqrt(len(cameras)))
    down = math.ceil(len(cameras) / max(across, 1))
    height = (_IMAGES_PX - (down - 1) * _GAP_PX) // max(down, 1)
    tiles = [_tile(moment.images[camera], camera, moment.outlines, height) for camera in cameras]
    width = max((tile.shape[1] for tile in tiles), default=_IMAGES_PX)
    size = _HEAD_PX + _IMAGES_PX + _GAP_PX, max(across, 1) * (width + _GAP_PX) + _GAP_PX
    image = np.full((size[0] + size[0] % 2, size[1] + size[1] % 2, 3), rgb(PLATE), np.uint8)
    for number, tile in enumerate(tiles):
        top, left = _HEAD_PX + number // across * (height + _GAP_PX), _GAP_PX + number % across * (width + _GAP_PX)
        image[top : top + height, left : left + tile.shape[1]] = tile
    write(image, _GAP_PX + 2, 24, f"{name}   t = {moment.time_s:.1f} s", 0.6, PLATE_INK)
    return image


def _tile(image: UInt8Array, camera: str, outlines: Mapping[str, Iterable[Outline]], height: int) -> UInt8Array:
    scale = height / image.shape[0]
    size = (round(scale * image.shape[1]), height)
    tile = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    for outline in outlines.get(camera, ()):
        colour = colour_of(outline.track, FEW) if outline.track is not None else "#ffffff"
        pixels = scale * outline.pixels
        line(tile, pixels, colour, 2)
        name = "new" if outline.track is None else f"#{outline.track}"
        caption = name if outline.range_m is None else f"{name} {outline.range_m:.1f} m"
        wide = 8 * len(caption)
        left = float(np.clip(pixels[:, 0].mean() - wide / 2, 2, max(size[0] - wide, 2)))
        top = float(pixels[:, 1].min()) - 6
        write(tile, left, top if top > 14 else float(pixels[:, 1].max()) + 16, caption, 0.42)
    write(tile, 6, size[1] - 8, camera, 0.42)
    return tile
