"""What one drone saw, step by step, for a video: its images, and the drones that it had found in them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flockd.core.messages import Detection, FloatArray, PilotOutput, UInt8Array
from flockd.flight.geometry import Rig, build_rig
from flockd.onboard.message_json import from_json
from flockd.onboard.recording.reader import Recording
from flockd.review.flight_log.key_frames import KeyFrame

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
class Moment:
    """One step of one drone."""

    time_s: float
    """Since the flight's start, as in its log."""
    images: Mapping[str, UInt8Array]
    """(h, w, 3) RGB by camera."""
    outlines: Mapping[str, Sequence[Outline]]
    """By camera."""
    taken_s: float
    """When the images were taken: earlier than `time_s` where there are none of the step itself."""


def recorded_moments(recording: Recording) -> Iterator[Moment]:
    """Each step of a recording, with the detections that were recorded. Raises RecordingError where it is damaged."""
    rig, zero_s = build_rig(recording.config.rig), recording.pilot_began_s
    for step in recording.steps():
        zero_s = step.frames.time_s if zero_s is None else zero_s
        output: PilotOutput | None = None if step.output is None else from_json(PilotOutput, step.output)
        time_s = step.frames.time_s - zero_s
        images = {name: frame.image for name, frame in step.frames.frames.items()}
        outlines = {} if output is None else _outlines(rig, output)
        yield Moment(time_s, images, outlines, time_s)


def held_moments(times_s: Sequence[float], frames: Sequence[KeyFrame]) -> Iterator[Moment]:
    """Each time with the newest key frame of before; the first one until there is one."""
    for time_s in times_s:
        known = [frame for frame in frames if frame.time_s <= time_s] or frames[:1]
        if known:
            yield Moment(time_s, known[-1].images, _masks(known[-1]), known[-1].time_s)
        else:
            yield Moment(time_s, {}, {}, time_s)


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


def _masks(frame: KeyFrame) -> dict[str, list[Outline]]:
    """The boxes of a key frame's masks."""
    found: dict[str, list[Outline]] = {}
    for camera, labels in frame.labels.items():
        for label in (int(one) for one in np.unique(labels) if one):
            rows, columns = np.nonzero(labels == label)
            left, right, top, bottom = columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
            corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)], np.float64)
            outline = Outline(corners, frame.track_ids.get(label), frame.ranges.get(label))
            found.setdefault(camera, []).append(outline)
    return found
