"""Where frames arrive from whatever threads bring them, and where the pilot fetches sets of them."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from flockd.core.config.source import SourceParameters
from flockd.core.messages import Frame, FrameSet
from flockd.onboard.sources.assembler import Assembler, RawFrameSet
from flockd.onboard.sources.frames import CameraStatus, Count, RawFrame
from flockd.onboard.sources.image_formats import CorruptImageError

_TICK_S = 0.01
"""How often a waiting reader checks whether a set that is not complete has waited long enough."""

_USELESS_AFTER = 3
"""So many frames in a row that are worth nothing are a fault of their camera; the drone flies on by the others."""

MAX_AHEAD_S = 0.02
"""Drivers that work out time stamps from the camera's own clock may be this much ahead."""


class ReceivedFrames:
    """What all sources have in common for the pilot: sets are fetched from a receiver."""

    _receiver: FrameReceiver

    def newest(self, timeout_s: float = 0.0) -> FrameSet | None:
        """See ``FrameSource``."""
        return self._receiver.newest(timeout_s)

    def status(self) -> Mapping[str, CameraStatus]:
        """See ``FrameSource``."""
        return self._receiver.status()

    def notes(self) -> tuple[str, ...]:
        """See ``FrameSource``."""
        return ()


class FrameReceiver:
    """The assembler behind a lock, and the decoding in front of it: what all sources have in common."""

    def __init__(
        self,
        cameras: Sequence[str],
        parameters: SourceParameters,
        clock: Callable[[], float] = time.monotonic,
        on_frame: Callable[[RawFrame], None] = lambda frame: None,
    ) -> None:
        """``on_frame`` is called with each usable frame, on the thread that brings it."""
        self._clock, self._on_frame = clock, on_frame
        self._assembler = Assembler(cameras, parameters)
        self._faults: dict[str, str | None] = dict.fromkeys(cameras)
        self._useless: Counter[str] = Counter()
        """Images in a row that could not be decoded, by camera."""
        self._refused: Counter[str] = Counter()
        """Frames in a row that `refuse` was called for, by camera."""
        self._changed = threading.Condition()
        self._stopped = False

    def is_of_now(self, time_s: float, max_age_s: float) -> bool:
        """Whether a time stamp is of the receiver's clock and not older than that; one ahead would silence all cameras.

        False for NaN.
        """
        return -MAX_AHEAD_S <= self._clock() - time_s <= max_age_s

    def offer(self, frame: RawFrame) -> Count | None:
        """Takes a frame from any thread; gives what it is refused for, None for a usable one."""
        with self._changed:
            refused = self._assembler.offer(frame, self._clock())
            if refused is None:
                self._faults[frame.camera] = None
                self._refused[frame.camera] = 0
                self._on_frame(frame)
                self._changed.notify_all()
            elif refused == "frozen":
                self._faults[frame.camera] = f"{frame.camera}: the image is frozen; restart its camera or program"
        return refused

    def count(self, camera: str, *what: Count) -> None:
        """Counts what happened to a camera, or to a frame of it that is worth nothing."""
        with self._changed:
            for one in what:
                self._assembler.count(camera, one)

    def refuse(self, camera: str, what: Count, sentence: str) -> None:
        """Counts a frame that is worth nothing; with `_USELESS_AFTER` in a row the sentence says why none comes."""
        with self._changed:
            self._assembler.count(camera, "received")
            self._assembler.count(camera, what)
            self._refused[camera] += 1
            if self._refused[camera] >= _USELESS_AFTER:
                self._faults[camera] = sentence

    def fault(self, camera: str, sentence: str) -> None:
        """Says why a camera gives nothing, until it gives something."""
        with self._changed:
            self._faults[camera] = sentence

    def newest(self, timeout_s: float) -> FrameSet | None:
        """See ``FrameSource``."""
        until_s = self._clock() + timeout_s
        while (raw := self._next(until_s)) is not None:
            decoded = {name: self._decoded(frame) for name, frame in raw.frames.items()}
            frames = {name: frame for name, frame in decoded.items() if frame is not None}
            if frames:
                return FrameSet(raw.time_s, frames)
        return None

    def status(self) -> dict[str, CameraStatus]:
        """See ``FrameSource``."""
        with self._changed:
            now_s = self._clock()
            return {
                camera: CameraStatus(
                    self._assembler.age_s(camera, now_s), self._fault(camera), self._assembler.counts(camera)
                )
                for camera in self._faults
            }

    def stop(self) -> None:
        """Lets a waiting reader go."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def _fault(self, camera: str) -> str | None:
        useless = self._useless[camera] >= _USELESS_AFTER
        return f"{camera}: its images show nothing; check its lens and cable" if useless else self._faults[camera]

    def _next(self, until_s: float) -> RawFrameSet | None:
        with self._changed:
            while not self._stopped:
                now_s = self._clock()
                raw = self._assembler.take(now_s)
                if raw is not None or now_s >= until_s:
                    return raw
                self._changed.wait(min(until_s - now_s, _TICK_S))
        return None

    def _decoded(self, raw: RawFrame) -> Frame | None:
        try:
            image = raw.decode(raw.data)
        except CorruptImageError:
            with self._changed:
                self._assembler.spoil(raw.camera)
                self._useless[raw.camera] += 1
            return None
        self._useless[raw.camera] = 0
        return Frame(raw.camera, image, raw.time_s, raw.sequence)
