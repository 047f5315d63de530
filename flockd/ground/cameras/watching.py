"""Runs all cameras for some seconds, as a source does in flight, and measures their images."""

from __future__ import annotations

import math
import statistics
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from flockd.core.config.source import SourceParameters
from flockd.core.messages import UInt8Array
from flockd.ground.cameras.listing import FoundCamera, Mode
from flockd.onboard.sources.device_source import Devices, DeviceSource
from flockd.onboard.sources.frames import CameraStatus, Count, FrameSource, RawFrame
from flockd.onboard.sources.image_formats import CorruptImageError
from flockd.onboard.sources.shared_memory import SharedMemorySource
from flockd.onboard.sources.v4l2_kernel import Kernel

START_S = 10.0
"""Time to open a device, or to find another program, and to get the first image."""
_LOOK_S = 0.05
_REFUSED: Mapping[Count, str] = {
    "flagged": "damaged, as the driver reports",
    "time_stamp": "with a time stamp far from now",
    "corrupt": "corrupt",
    "frozen": "frozen",
    "malformed": "malformed",
}
"""Reasons why images cannot be used, in words."""


@dataclass
class Watched:
    """Measurements of one camera."""

    fault: str | None = None
    """Why it gives no images: one sentence that ends with the remedy."""
    stamps_s: list[float] = field(default_factory=list)
    """Time stamp of each image."""
    lost: int = 0
    """Gaps in the sequence numbers."""
    refused: Counter[str] = field(default_factory=Counter)
    """Images that cannot be used, by reason."""
    image: UInt8Array | None = None
    """The last one."""

    @property
    def rate_hz(self) -> float:
        """0 for less than two images."""
        if len(self.stamps_s) < 2:
            return 0.0
        return (len(self.stamps_s) - 1) / max(self.stamps_s[-1] - self.stamps_s[0], 1e-9)

    def jitter_s(self) -> float:
        """95th percentile of the difference between an interval and the nearest multiple of the usual one."""
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
    """Runs all cameras of a source at the same time, as in flight; ``sizes``: width and height by camera.

    Each is watched for ``seconds`` from its first image on, which has to come within ``start_s``. Raises
    UnavailableError for an invalid endpoint.
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


_NEIGHBOURHOOD_PX = 25
"""Distance in pixels across which an edge's contrast is measured."""
_STEEPEST = 0.5
"""Percentage of an image's pixels, the steepest ones, that count as edges."""
_LEAST_CONTRAST = 30.0
"""Grey levels; a weaker edge has more noise than slope."""
_SILENCE_S = 3.0
"""Time without an image after which a camera is opened again; longer than any camera's interval."""


def measure(cameras: Sequence[tuple[FoundCamera, Mode]], seconds: float, kernel: Kernel) -> list[Watched]:
    """Runs all cameras side by side, for ``seconds`` from their first image on."""
    modes = {f"camera{number}": mode for number, (_, mode) in enumerate(cameras)}
    entries = [camera.parameters(name, mode) for name, (camera, mode) in zip(modes, cameras, strict=True)]
    source = SourceParameters(kind="v4l2").model_copy(update={"cameras": entries, "silence_s": _SILENCE_S})
    return list(watch({name: mode.size for name, mode in modes.items()}, source, seconds, Devices(kernel)).values())


def edge_width_px(image: UInt8Array) -> float:
    """Width in pixels of the sharpest edges of a scene: contrast over steepest slope.

    ``image``: (h, w, 3) RGB of a scene with edges. The width is between 1.5 and 3 for a sharp image, and about 2.5 s
    for a blur of standard deviation s pixels. NaN: no edge has enough contrast.
    """
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.float32)
    slope = np.hypot(cv2.Scharr(grey, cv2.CV_32F, 1, 0), cv2.Scharr(grey, cv2.CV_32F, 0, 1)) / 32.0
    around = np.ones((_NEIGHBOURHOOD_PX, _NEIGHBOURHOOD_PX), np.uint8)
    contrast = np.asarray(cv2.dilate(grey, around) - cv2.erode(grey, around))
    steep = (slope >= np.percentile(slope, 100.0 - _STEEPEST)) & (contrast >= _LEAST_CONTRAST) & (slope > 0.0)
    return float(np.median(contrast[steep] / slope[steep])) if steep.any() else math.nan
