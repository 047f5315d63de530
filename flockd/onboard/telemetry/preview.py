"""Small JPEGs of the cameras' images, with the detected drones, for telemetry over a radio link."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from flockd.core import services
from flockd.core.messages import Detection, Frame, FrameSet, PilotOutput, UInt8Array
from flockd.flight.geometry import Rig, RigCamera

LARGEST_SIDE_PX = 320
JPEG_QUALITY = 70
EVERY_S = 0.2
"""Shortest time between two pictures of a camera, however many watchers ask."""
FRESH_S = services.PREVIEW.timeout
"""While the pilot steps, the newest step's frames are shown if they are at most this much older than the newest."""
_COLOUR = (255, 109, 0)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class Previews:
    """Pictures on request, on the caller's thread: the pilot never waits for one."""

    def __init__(
        self,
        rig: Rig,
        newest: Callable[[], tuple[FrameSet | None, tuple[FrameSet, PilotOutput] | None]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``newest``: the newest frames, and the frames and the output of the pilot's newest step."""
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
                return preview(frame, self._rig.cameras.get(camera), stepped[1].detections)
        newest = None if frames is None else frames.frames.get(camera)
        return None if newest is None else preview(newest)


def preview(frame: Frame, camera: RigCamera | None = None, detections: Sequence[Detection] = ()) -> bytes:
    """A JPEG of the frame, at most 320 pixels wide and high, with a circle and the range of each detection in it."""
    height, width = frame.image.shape[:2]
    scale = min(1.0, LARGEST_SIDE_PX / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small: UInt8Array = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.uint8)
    if camera is not None:
        for detection in detections:
            _circle(small, camera, detection, scale)
    _, data = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()


def _circle(image: UInt8Array, camera: RigCamera, detection: Detection, scale: float) -> None:
    """Draws a circle of the detected size around a drone, at its place in this camera's image."""
    (u, v), *_ = scale * camera.pixels_of_points(detection.position[None])
    if not math.isfinite(u):
        return
    radius = max(4, round(scale * camera.camera.focal_px * detection.size_m / detection.range_m / 2) + 3)
    cv2.circle(image, (round(u), round(v)), radius, _COLOUR, 1, cv2.LINE_AA)
    place = (max(0, round(u) - radius), max(9, round(v) - radius - 3))
    cv2.putText(image, f"{detection.range_m:.1f} m", place, _FONT, 0.35, _COLOUR, 1, cv2.LINE_AA)
