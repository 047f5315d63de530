"""Small JPEGs of the cameras' images with detections and tracks for telemetry, and their boxes for any image."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from flockd.core import services
from flockd.core.messages import Frame, FrameSet, PilotOutput, UInt8Array, VehicleState
from flockd.flight.geometry import Rig, RigCamera

LARGEST_SIDE_PX = 320
JPEG_QUALITY = 70
EVERY_S = 0.2
"""Shortest time between two pictures of a camera, whatever the number of watchers."""
FRESH_S = services.PREVIEW.timeout
"""While the pilot steps, the newest step's frames are shown if they are at most this much older than the newest."""
_COLOURS = ((255, 109, 0), (0, 176, 255), (213, 0, 249), (0, 200, 83), (255, 214, 0), (255, 23, 68))
"""RGB of tracks, by their numbers."""
_WHITE = (255, 255, 255)
_FONT = cv2.FONT_HERSHEY_SIMPLEX

Step = tuple[FrameSet, VehicleState, PilotOutput]
"""One step of the pilot: its inputs and its output."""


class Previews:
    """Draws pictures on request, on the caller's thread: the pilot never waits."""

    def __init__(
        self,
        rig: Rig,
        newest: Callable[[], tuple[FrameSet | None, Step | None]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``newest``: the newest frames, and the pilot's newest step."""
        self._rig, self._newest, self._clock = rig, newest, clock
        self._lock = threading.Lock()
        self._made: dict[str, tuple[float, bytes]] = {}

    def picture(self, camera: str) -> bytes | None:
        """A JPEG, at most ``EVERY_S`` old if the camera delivers; None without a frame."""
        with self._lock:
            now_s = self._clock()
            made = self._made.get(camera)
            if made is None or now_s - made[0] >= EVERY_S:
                data = self._drawn(camera)
                if data is None:
                    self._made.pop(camera, None)
                    return None
                made = self._made[camera] = now_s, data
            return made[1]

    def _drawn(self, camera: str) -> bytes | None:
        frames, stepped = self._newest()
        if stepped is not None and (frames is None or frames.time_s - stepped[0].time_s < FRESH_S):
            frame = stepped[0].frames.get(camera)
            if frame is not None:
                return preview(frame, self._rig.cameras.get(camera), stepped)
        newest = None if frames is None else frames.frames.get(camera)
        return None if newest is None else preview(newest)


def preview(frame: Frame, camera: RigCamera | None = None, step: Step | None = None) -> bytes:
    """A JPEG of the frame, at most 320 pixels wide and high.

    With a step, each detection has a box with its range and the number of its track, with `?` until it is confirmed. A
    circle shows the expected position of a confirmed track that was not detected in this step.
    """
    height, width = frame.image.shape[:2]
    scale = min(1.0, LARGEST_SIDE_PX / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small: UInt8Array = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.uint8)
    if camera is not None and step is not None:
        _draw(small, camera, step, scale)
    _, data = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()


def _draw(image: UInt8Array, camera: RigCamera, step: Step, scale: float) -> None:
    """Draws detections and tracks whose centre is in this camera's image."""
    _, vehicle, output = step
    tracks = {one.track: one for one in output.neighbours if one.confirmed}
    for one in tracks.values():
        (u, v), *_ = scale * camera.pixels_of_points((vehicle.R_ned_body.T @ one.position)[None])
        if one.unseen_s > 0 and math.isfinite(u):
            cv2.circle(image, (round(u), round(v)), 5, colour_of(one.track), 1, cv2.LINE_AA)
            write_at(image, (u - 5, v - 5, u + 5, v + 5), f"#{one.track}", _WHITE)
    for detection, track in zip(output.detections, output.detection_tracks, strict=True):
        (u, v), *_ = scale * camera.pixels_of_points(detection.position[None])
        if math.isfinite(u):
            half = max(4.0, scale * camera.camera.focal_px * detection.size_m / detection.range_m / 2)
            box = u - half, v - half, u + half, v + half
            draw_box(image, box, colour_of(track))
            named = f"#{track}" if track in tracks else "?"
            write_at(image, box, f"{named} {detection.range_m:.1f} m", _WHITE)


def colour_of(number: int) -> tuple[int, int, int]:
    """RGB for the number of a track, or of a detection if there are no tracks."""
    return _COLOURS[number % len(_COLOURS)]


def draw_box(image: UInt8Array, box: Sequence[float], colour: tuple[int, int, int], thick: int = 1) -> None:
    """Draws a frame around a box (left, top, right, bottom, in pixels) without covering its content."""
    left, top = (int(np.floor(value)) - thick for value in box[:2])
    right, bottom = (int(np.ceil(value)) + thick - 1 for value in box[2:])
    cv2.rectangle(image, (left, top), (right, bottom), colour, thick)


def write_at(image: UInt8Array, box: Sequence[float], text: str, colour: tuple[int, int, int], thick: int = 1) -> None:
    """Writes a label below a box, or above it at the image's lower edge, on a dark background."""
    scale, (height, width) = 0.42 * thick, image.shape[:2]
    (wide, high), _ = cv2.getTextSize(text, _FONT, scale, thick)
    left, below = int(np.clip(box[0], 0, max(width - wide, 0))), int(box[3]) + 3 * thick
    top = below if below <= height - 2 * high else max(int(box[1]) - 3 * thick - 2 * high, 0)
    image[top : top + 2 * high, left : left + wide] //= 4
    cv2.putText(image, text, (left, top + round(1.5 * high)), _FONT, scale, colour, thick, cv2.LINE_AA)
