"""Watches cameras: runs them side by side for some seconds, as a source does in flight, and writes down what came."""

from __future__ import annotations

import statistics
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from flockd.core.config.source import SourceParameters
from flockd.core.messages import UInt8Array
from flockd.onboard.sources.device_source import Devices, DeviceSource
from flockd.onboard.sources.frames import CameraStatus, Count, FrameSource, RawFrame
from flockd.onboard.sources.image_formats import CorruptImageError
from flockd.onboard.sources.shared_memory import SharedMemorySource

START_S = 10.0
"""To open any device, or to find another program, and to get the first image."""
_LOOK_S = 0.05
_REFUSED: Mapping[Count, str] = {
    "flagged": "damaged, as the driver reports",
    "time_stamp": "with a time stamp far from now",
    "corrupt": "corrupt",
    "frozen": "frozen",
    "malformed": "malformed",
}
"""What images are that are worth nothing, in words."""


@dataclass
class Watched:
    """What one camera did."""

    fault: str | None = None
    """Why it gives nothing, in one sentence that ends in its fix."""
    stamps_s: list[float] = field(default_factory=list)
    """When each image was taken, as its time stamp says."""
    lost: int = 0
    """Gaps in the sequence numbers."""
    refused: Counter[str] = field(default_factory=Counter)
    """Images that are worth nothing, by reason."""
    image: UInt8Array | None = None
    """The last one."""

    @property
    def rate_hz(self) -> float:
        """0 for less than two images."""
        if len(self.stamps_s) < 2:
            return 0.0
        return (len(self.stamps_s) - 1) / max(self.stamps_s[-1] - self.stamps_s[0], 1e-9)

    def jitter_s(self) -> float:
        """95th percentile of how far an interval is from the nearest multiple of the usual one."""
        intervals = np.diff(self.stamps_s)
        if len(intervals) < 2:
            return 0.0
        usual = statistics.median(intervals.tolist())
        beats = np.maximum(np.round(intervals / usual), 1.0) if usual > 0 else np.ones(len(intervals))
        return float(np.percentile(np.abs(intervals - beats * usual), 95))


def watch(
    sizes: Mapping[str, tuple[int, int]],
    parameters: SourceParameters,
    seconds: float,
    devices: Devices,
    start_s: float = START_S,
) -> dict[str, Watched]:
    """Runs all cameras of a source side by side, as a USB bus has to carry them in flight; ``sizes`` by camera.

    Each is watched for ``seconds`` from its first image on, which has to come within ``start_s``. Raises
    UnavailableError for an endpoint that cannot be one.
    """
    watched = {name: Watched() for name in sizes}
    last: dict[str, RawFrame] = {}

    def take(frame: RawFrame) -> None:
        watched[frame.camera].stamps_s.append(frame.time_s)
        last[frame.camera] = frame

    shared = parameters.kind == "shared_memory"
    source: FrameSource = (
        SharedMemorySource(sizes, parameters, on_frame=take)
        if shared
        else DeviceSource(sizes, parameters, devices, take)
    )
    source.start()
    try:
        _wait(source, watched, seconds, start_s)
        status = source.status()
    finally:
        source.stop()
    for name, record in watched.items():
        silent = f"{name}: its driver does not respond; unplug the camera and plug it in again"
        if shared:
            silent = (
                f"no frame of {parameters.shared_memory.drone}/{name} came from "
                f"{', '.join(parameters.shared_memory.connect)} within {start_s:g} s; "
                "start the program that publishes them, or fix source.shared_memory"
            )
        _conclude(record, status[name], last.get(name), silent)
    return watched


def _wait(source: FrameSource, watched: Mapping[str, Watched], seconds: float, start_s: float) -> None:
    """Until each camera was watched for long enough, or has a fault."""
    now_s = began_s = time.monotonic()
    until_s: dict[str, float] = {}
    while now_s < max([began_s + start_s, *until_s.values()]):
        time.sleep(_LOOK_S)
        now_s = time.monotonic()
        status = source.status()
        until_s |= {name: now_s + seconds for name in watched.keys() - until_s if watched[name].stamps_s}
        if all(now_s >= until_s[name] if name in until_s else status[name].fault for name in watched):
            return


def _conclude(record: Watched, status: CameraStatus, last: RawFrame | None, silent: str) -> None:
    record.fault = status.fault if record.stamps_s else status.fault or silent
    if record.fault is not None and "; " not in record.fault:
        record.fault += "; try another cable, port and pixel_format"
    record.refused.update({words: status.counts[what] for what, words in _REFUSED.items() if status.counts.get(what)})
    # What is refused before its number is looked at leaves a gap, too.
    unseen = sum(status.counts.get(what, 0) for what in ("flagged", "corrupt"))
    record.lost = max(status.counts.get("lost", 0) - unseen, 0)
    if last is not None:
        try:
            record.image = last.decode(last.data)
        except CorruptImageError as error:
            record.refused[f"not to be decoded ({error})"] += 1
