"""Combines the frames of several cameras into frame sets by time stamp; cameras may deliver on any threads."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flockd.core.config.source import SourceParameters
from flockd.core.messages import Frame, FrameSet, UInt8Array
from flockd.onboard.sources.frames import CameraStatus, Count, RawFrame
from flockd.onboard.sources.image_formats import CorruptImageError

_MOST_HELD = 16
"""Largest number of frames kept of one camera."""


@dataclass(frozen=True, eq=False)
class RawFrameSet:
    """Frames of one time; a camera without a frame near it is absent."""

    time_s: float
    frames: Mapping[str, RawFrame]


@dataclass(frozen=True, eq=False)
class _Held:
    frame: RawFrame
    arrival_s: float


@dataclass
class _Line:
    """State of one camera."""

    held: deque[_Held] = field(default_factory=deque)
    last: RawFrame | None = None
    repeats: int = 0
    usable_s: float = -math.inf
    """Arrival time of its last usable frame."""
    awaited: bool = True
    counts: Counter[Count] = field(default_factory=Counter)


class Assembler:
    """Combines single frames into sets; `take` returns the newest one.

    A set's time is the stamp of one of its frames. The set is complete when every awaited camera has a frame within
    ``set_tolerance_s`` of that time. ``set_wait_s`` after the arrival of a frame its set is returned even if it is
    incomplete; a camera that is missing from it is not awaited again before its next usable frame. The times of sets
    increase, and each frame is in at most one set.

    ``now_s`` is on the caller's clock; it is never compared with time stamps.
    """

    def __init__(self, cameras: Sequence[str], parameters: SourceParameters) -> None:
        self._lines = {camera: _Line() for camera in cameras}
        self._tolerance_s = parameters.set_tolerance_s
        self._wait_s = parameters.set_wait_s
        self._frozen_after = parameters.frozen_after or math.inf
        self._last_set_s = -math.inf

    def offer(self, frame: RawFrame, now_s: float) -> Count | None:
        """Takes a frame of a known camera. Returns why it is refused; None: it is usable."""
        line = self._lines[frame.camera]
        line.counts["received"] += 1
        refused = self._judge(line, frame)
        if refused is not None:
            line.counts[refused] += 1
            return refused
        line.usable_s = now_s
        line.awaited = True
        line.held.append(_Held(frame, now_s))
        while self._is_useless(line):
            line.held.popleft()
            line.counts["superseded"] += 1
        return None

    def take(self, now_s: float) -> RawFrameSet | None:
        """The newest set that is ready; None if no set is newer than the last one returned."""
        awaited = {name for name, line in self._lines.items() if line.awaited}
        best: RawFrameSet | None = None
        stamps = {held.frame.time_s for line in self._lines.values() for held in line.held}
        for time_s in sorted((stamp for stamp in stamps if stamp > self._last_set_s), reverse=True):
            candidate = RawFrameSet(time_s, self._near(time_s))
            if awaited <= candidate.frames.keys():
                return self._handed_out(candidate)
            if best is None or len(candidate.frames) > len(best.frames):
                best = candidate
        if best is not None and now_s - self._oldest_arrival_s() > self._wait_s:
            return self._handed_out(best)
        return None

    def count(self, camera: str, what: Count) -> None:
        """Adds one to a count of a camera."""
        self._lines[camera].counts[what] += 1

    def spoil(self, camera: str, *what: Count) -> None:
        """Corrects the counts after a frame of the last set turned out to be unusable: its camera counts as missing."""
        self._lines[camera].counts.update((*what, "missing"))
        self._lines[camera].counts["used"] -= 1

    def counts(self, camera: str) -> dict[Count, int]:
        """A camera's counts so far, without zeros."""
        return {what: count for what, count in self._lines[camera].counts.items() if count}

    def age_s(self, camera: str, now_s: float) -> float:
        """Time since the camera's last usable frame arrived; infinite before the first."""
        return now_s - self._lines[camera].usable_s

    def _judge(self, line: _Line, frame: RawFrame) -> Count | None:
        last = line.last
        if not math.isfinite(frame.time_s) or (last is not None and frame.time_s <= last.time_s):
            return "time_stamp"
        line.last = frame
        if last is not None:
            same = frame.sequence == last.sequence or frame.data == last.data
            line.repeats = line.repeats + 1 if same else 0
            line.counts["lost"] += max(frame.sequence - last.sequence - 1, 0)  # a reopened camera begins at zero
        if line.repeats >= self._frozen_after:
            return "frozen"
        return "late" if frame.time_s + self._tolerance_s <= self._last_set_s else None

    def _is_useless(self, line: _Line) -> bool:
        """Whether a camera's oldest frame is older than any set can wait for."""
        span_s = line.held[-1].frame.time_s - line.held[0].frame.time_s
        return span_s > self._wait_s + self._tolerance_s or len(line.held) > _MOST_HELD

    def _near(self, time_s: float) -> dict[str, RawFrame]:
        nearest = {}
        for name, line in self._lines.items():
            frames = [held.frame for held in line.held if abs(held.frame.time_s - time_s) <= self._tolerance_s]
            if frames:
                nearest[name] = min(frames, key=lambda frame: abs(frame.time_s - time_s))
        return nearest

    def _oldest_arrival_s(self) -> float:
        return min(
            held.arrival_s
            for line in self._lines.values()
            for held in line.held
            if held.frame.time_s > self._last_set_s
        )

    def _handed_out(self, chosen: RawFrameSet) -> RawFrameSet:
        self._last_set_s = chosen.time_s
        for name, line in self._lines.items():
            used = chosen.frames.get(name)
            line.counts["used" if used else "missing"] += 1
            line.awaited = used is not None
            until_s = used.time_s if used else chosen.time_s - self._tolerance_s
            while line.held and line.held[0].frame.time_s <= until_s:
                if line.held.popleft().frame is not used:
                    line.counts["superseded"] += 1
        return chosen


_TICK_S = 0.01
"""Interval at which a waiting reader checks whether an incomplete set has waited long enough."""

_USELESS_AFTER = 3
"""After this many unusable frames in a row their camera is reported as faulty; the drone flies on with the others."""

_BLOCK_PX = 16
"""Side of a block of JPEG with colours at half the resolution."""
_FROZEN = "{}: the image is frozen; restart its camera or program"

MAX_AHEAD_S = 0.02
"""A driver that computes time stamps from the camera's own clock may be ahead by this much."""


class FrameReceiver:
    """Base of all sources: guards the assembler with a lock, and decodes the frames of the sets that it returns."""

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
        self._frozen_after = parameters.frozen_after or math.inf
        self._useless: Counter[str] = Counter()
        """Images in a row that could not be decoded, by camera."""
        self._parts: dict[str, tuple[UInt8Array, int]] = {}
        """For cameras that share an image: each one's part when it last changed, and the number of that frame."""
        self._still: set[str] = set()
        """Cameras whose part is frozen."""
        self._refused: Counter[str] = Counter()
        """Frames in a row that `refuse` counted, by camera."""
        self._changed = threading.Condition()
        self._stopped = False

    def is_of_now(self, time_s: float, max_age_s: float) -> bool:
        """Whether a time stamp may be on the receiver's clock: not in the future, and at most ``max_age_s`` old.

        False for NaN. Set times increase, so one stamp in the future would block all cameras until then.
        """
        return -MAX_AHEAD_S <= self._clock() - time_s <= max_age_s

    def offer(self, frame: RawFrame) -> Count | None:
        """Takes a frame from any thread. Returns why it is refused; None: it is usable."""
        with self._changed:
            refused = self._assembler.offer(frame, self._clock())
            if refused is None:
                self._faults[frame.camera] = None
                self._refused[frame.camera] = 0
                self._on_frame(frame)
                self._changed.notify_all()
            elif refused == "frozen":
                self._faults[frame.camera] = _FROZEN.format(frame.camera)
        return refused

    def count(self, camera: str, *what: Count) -> None:
        """Adds one to each of these counts of a camera."""
        with self._changed:
            for one in what:
                self._assembler.count(camera, one)

    def refuse(self, camera: str, what: Count, sentence: str) -> None:
        """Counts an unusable frame. After `_USELESS_AFTER` in a row, ``sentence`` becomes the camera's fault."""
        with self._changed:
            self._assembler.count(camera, "received")
            self._assembler.count(camera, what)
            self._refused[camera] += 1
            if self._refused[camera] >= _USELESS_AFTER:
                self._faults[camera] = sentence

    def fault(self, camera: str, sentence: str) -> None:
        """Sets a camera's fault, one sentence, until its next usable frame."""
        with self._changed:
            self._faults[camera] = sentence

    def newest(self, timeout_s: float = 0.0) -> FrameSet | None:
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
        """See ``FrameSource``; wakes a waiting reader."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def _fault(self, camera: str) -> str | None:
        if camera in self._still:
            return _FROZEN.format(camera)
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
                self._assembler.spoil(raw.camera, "corrupt", "undecodable")
                self._useless[raw.camera] += 1
            return None
        self._useless[raw.camera] = 0
        if raw.shared and self._is_still(raw, image):
            with self._changed:
                self._assembler.spoil(raw.camera, "frozen")
            return None
        return Frame(raw.camera, image, raw.time_s, raw.sequence)

    def _is_still(self, raw: RawFrame, image: UInt8Array) -> bool:
        """Whether a camera's part has not changed for `frozen_after` images. Its border is left out, as a JPEG block
        there also covers the next part."""
        border = min(_BLOCK_PX, *(side // 4 for side in image.shape[:2]))
        image = image[border:-border, border:-border]
        before, number = self._parts.get(raw.camera, (None, 0))
        if before is None or raw.sequence < number or not np.array_equal(before, image):
            self._parts[raw.camera] = image, raw.sequence
            self._still.discard(raw.camera)
        elif raw.sequence - number >= self._frozen_after:
            self._still.add(raw.camera)
        return raw.camera in self._still
