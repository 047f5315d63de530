"""A video of a flight: what one drone's cameras saw with what it detected, beside the flock from above."""

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
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.style import FEW, PLATE, PLATE_INK, PLATE_MUTED, colour_of, line, rgb, rig_place, ring, write

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
    """Since the flight's start, as in its log."""
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
_PANEL, _GRID = "#1c222b", "#2c3440"
_HEAD_PX, _GAP_PX, _MAP_PX = 36, 6, 640
"""Heights of the line above and of the gaps between the parts, and each side of the map."""
_TRAIL_S = 20.0
_LEAST_REACH_M = 6.0
Progress = Callable[[int, int], None]


def check_video_path(path: Path, *, force: bool) -> None:
    """Raises UsageError for what cannot be written, or must not be."""
    if path.suffix.lower() not in CODECS:
        raise UsageError(f"{path}: a video's name ends in {' or '.join(CODECS)}; give it another")
    if path.exists() and not force:
        raise UsageError(f"{path} exists; name another file, or overwrite it with --force")
    if not path.parent.is_dir():
        raise UsageError(f"{path.parent} is not a folder; make it first")


def write_video(
    path: Path,
    log: FlightLog,
    drone: int,
    steps: Iterable[VideoStep],
    progress: Progress = lambda done, total: None,
    *,
    scale: float = 1.0,
) -> int:
    """Writes the video, a frame a step in real time, and gives the number of frames.

    ``drone`` (from 0) is whose ``steps`` these are; ``scale`` makes the frames smaller. The file appears when it is
    whole. Raises UnavailableError where OpenCV has no encoder.
    """
    draft = path.with_name(f".{path.stem}.part{path.suffix}")
    plate, count, video = _Plate(log, drone), 0, None
    try:
        for step in steps:
            frame = _scaled(plate.draw(step), scale)
            video = video or _opened(draft, 1.0 / log.metadata.step_s, (frame.shape[1], frame.shape[0]))
            video.write(np.ascontiguousarray(frame[..., ::-1]))
            count += 1
            progress(min(count, len(log.time_s)), len(log.time_s))
        if video is None:
            raise UsageError(f"{path} was not written, as the flight has no step; name another flight")
        video.release()
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return count


def _scaled(image: UInt8Array, scale: float) -> UInt8Array:
    """Both sides stay even, as encoders want them."""
    if scale == 1.0:
        return image
    height, width = (2 * round(side * scale / 2) for side in image.shape[:2])
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


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


class _Plate:
    """Everything that is the same in all frames."""

    def __init__(self, log: FlightLog, drone: int) -> None:
        self._log, self._drone = log, drone
        self._known = bool(np.isfinite(log.position[:, drone]).any())
        self._colours = [colour_of(number, log.position.shape[1]) for number in range(log.position.shape[1])]
        self._middle, self._reach_m = self._extent()

    def draw(self, moment: VideoStep) -> UInt8Array:
        """(h, w, 3) RGB; both sides are even."""
        row = int(np.clip(np.searchsorted(self._log.time_s, moment.time_s - 1e-6), 0, len(self._log.time_s) - 1))
        seen = _tiles(moment)
        height = _HEAD_PX + _MAP_PX + _GAP_PX
        width = seen.shape[1] + _MAP_PX + 3 * _GAP_PX
        image = np.full((height + height % 2, width + width % 2, 3), rgb(PLATE), np.uint8)
        image[_HEAD_PX : _HEAD_PX + _MAP_PX, _GAP_PX : _GAP_PX + seen.shape[1]] = seen
        left = seen.shape[1] + 2 * _GAP_PX
        image[_HEAD_PX : _HEAD_PX + _MAP_PX, left : left + _MAP_PX] = self._map(row)
        names = self._log.metadata.names
        name = names[self._drone] if names else f"drone {self._drone + 1}"
        write(image, _GAP_PX + 2, 24, f"{name}   t = {moment.time_s:.1f} s", 0.6, PLATE_INK)
        return image

    def _extent(self) -> tuple[FloatArray, float]:
        """Middle (2,) and half width in metres of what the map shows."""
        plan = self._log.position[..., :2].reshape(-1, 2)
        plan = plan[np.isfinite(plan).all(axis=1)]
        if not len(plan):
            tracked = self._log.tracked[self._log.tracked[:, 1] == self._drone, 3:5]
            far_m = float(np.abs(tracked).max()) if len(tracked) else 0.0
            return np.zeros(2), max(1.15 * far_m, _LEAST_REACH_M)
        low, high = plan.min(axis=0), plan.max(axis=0)
        return (low + high) / 2, max(0.56 * float((high - low).max()), _LEAST_REACH_M)

    def _map(self, row: int) -> UInt8Array:
        """The flock from above, north up, with the drone's tracks as rings."""
        log, own = self._log, self._drone
        image = np.full((_MAP_PX, _MAP_PX, 3), rgb(_PANEL), np.uint8)
        self._grid(image)
        since = int(np.searchsorted(log.time_s, log.time_s[row] - _TRAIL_S))
        for number, colour in enumerate(self._colours):
            trail = log.position[since : row + 1, number, :2]
            trail = trail[np.isfinite(trail).all(axis=1)]
            if len(trail):
                line(image, self._pixels(trail), colour, 1)
                ring(image, self._pixels(trail[-1:])[0], 5, colour, -1)
        origin = log.position[row, own, :2] if np.isfinite(log.position[row, own, :2]).all() else np.zeros(2)
        here = self._pixels(origin[None])[0]
        ring(image, here, 10, PLATE_INK, 1)
        if not self._known:
            ring(image, here, 5, self._colours[own], -1)
        for track in log.tracked[(log.tracked[:, 0] == row) & (log.tracked[:, 1] == own)]:
            place = self._pixels((origin + track[3:5])[None])[0]
            ring(image, place, 7, colour_of(int(track[2]), FEW), 2)
        command = log.command_velocity[row, own]
        if np.isfinite(command).all():
            line(image, self._pixels(np.stack([origin, origin + 2.0 * command])), PLATE_INK, 1)
        told = "paths, tracks (rings), command (line, 2 s)" if self._known else "tracks around the drone, command"
        write(image, 8, _MAP_PX - 10, told, 0.42, PLATE_MUTED)
        return image

    def _grid(self, image: UInt8Array) -> None:
        step_m = next(step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500, 10_000) if 2 * self._reach_m / step < 9)
        for axis in (0, 1):
            first = math.ceil((self._middle[axis] - self._reach_m) / step_m) * step_m
            for at_m in np.arange(first, self._middle[axis] + self._reach_m, step_m):
                ends = np.stack([self._middle - self._reach_m, self._middle + self._reach_m])
                ends[:, axis] = at_m
                line(image, self._pixels(ends), _GRID, 1)
        write(image, 8, 20, f"north up, grid {step_m} m", 0.42, PLATE_MUTED)

    def _pixels(self, plan: FloatArray) -> FloatArray:
        """(n, 2) across and down of (n, 2) metres north and east."""
        scale = _MAP_PX / (2 * self._reach_m)
        off = (plan - self._middle) * scale
        return np.stack([_MAP_PX / 2 + off[:, 1], _MAP_PX / 2 - off[:, 0]], axis=1)


def _tiles(moment: VideoStep) -> UInt8Array:
    """All images, in reading order of a turn to the right, with gaps; as high together as the map."""
    cameras = sorted(moment.images, key=rig_place)
    if not cameras:
        return np.full((_MAP_PX, _MAP_PX, 3), rgb(_PANEL), np.uint8)
    across = math.ceil(math.sqrt(len(cameras)))
    down = math.ceil(len(cameras) / across)
    height = (_MAP_PX - (down - 1) * _GAP_PX) // down
    tiles = [_tile(moment.images[name], name, moment.outlines, height) for name in cameras]
    width = max(tile.shape[1] for tile in tiles)
    image = np.full((_MAP_PX, across * (width + _GAP_PX) - _GAP_PX, 3), rgb(PLATE), np.uint8)
    for number, tile in enumerate(tiles):
        top, left = number // across * (height + _GAP_PX), number % across * (width + _GAP_PX)
        image[top : top + height, left : left + tile.shape[1]] = tile
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
