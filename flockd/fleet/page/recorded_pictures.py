"""Small pictures of a recording's cameras, with what the pilot detected: one a second of each."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

from flockd.core.config.rig import RigConfig
from flockd.core.messages import Detection, Frame
from flockd.flight.geometry import build_rig
from flockd.onboard.recording import RecordingError
from flockd.onboard.recording.reader import decoded_image
from flockd.onboard.telemetry.preview import EVERY_S, preview

SHOWN_S = 3.0
"""For so long a picture stands for what the camera sees."""


class RecordedPictures:
    """Takes a recording's messages in order, and keeps what the page may ask for: about 10 kB a picture."""

    def __init__(self, rig: RigConfig) -> None:
        self._rig = build_rig(rig)
        self._messages: dict[str, bytes] = {}
        self._times: dict[str, list[float]] = {}
        self._pictures: dict[str, list[bytes]] = {}

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those that there are pictures of."""
        return tuple(self._pictures)

    def take_image(self, camera: str, message: bytes) -> None:
        """A camera's image of the next step."""
        self._messages[camera] = message

    def take_step(self, time_s: float, detections: Sequence[Detection]) -> None:
        """What was detected in the images before; of those that do not decode there is no picture."""
        for camera, message in self._messages.items():
            times = self._times.setdefault(camera, [])
            if times and time_s - times[-1] < EVERY_S:
                continue
            try:
                frame = Frame(camera, decoded_image(message), time_s, 0)
            except (ValueError, RecordingError):
                continue
            times.append(time_s)
            self._pictures.setdefault(camera, []).append(preview(frame, self._rig.cameras.get(camera), detections))
        self._messages = {}

    def at(self, camera: str, time_s: float) -> bytes | None:
        """The newest by then; None where it is too old."""
        times = self._times.get(camera, [])
        index = bisect_right(times, time_s) - 1
        if index < 0 or time_s - times[index] > SHOWN_S:
            return None
        return self._pictures[camera][index]
