"""What the cameras of this computer give when all of them run: rate, jitter, sharpness and exposure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from flockd.core.config.source import SourceParameters
from flockd.core.messages import UInt8Array
from flockd.ground.cameras.found import FoundCamera, Mode
from flockd.ground.cameras.watching import Watched, watch
from flockd.onboard.sources.device_source import Devices
from flockd.onboard.sources.v4l2_kernel import Kernel

_NEIGHBOURHOOD_PX = 25
"""Across which an edge's contrast is taken; of edges blurred by more, too little is seen."""
_STEEPEST = 0.5
"""Per cent of an image's pixels that are looked at: where its edges are."""
_LEAST_CONTRAST = 30.0
"""Grey levels; a weaker edge has more noise than slope."""
_SILENCE_S = 3.0
"""A camera without an image for this long is opened again: longer than two images of any are apart."""
_BLACK, _WHITE = 4, 251
"""Grey levels beyond which nothing can be told apart."""


@dataclass(frozen=True, eq=False)
class Measured:
    """One camera in one mode."""

    mode: Mode
    watched: Watched
    edge_px: float
    """See ``edge_width_px``; NaN without an image."""
    mean_grey: float
    """Mean grey, 0 to 255; NaN without an image."""
    black_share: float
    white_share: float


def measure(cameras: Sequence[tuple[FoundCamera, Mode]], seconds: float, kernel: Kernel) -> list[Measured]:
    """Runs all cameras side by side, for ``seconds`` from their first image on."""
    names = [f"camera{number}" for number in range(len(cameras))]
    entries = [camera.parameters(name, mode) for name, (camera, mode) in zip(names, cameras, strict=True)]
    source = SourceParameters(kind="v4l2").model_copy(update={"cameras": entries, "silence_s": _SILENCE_S})
    sizes = {name: mode.size for name, (_, mode) in zip(names, cameras, strict=True)}
    watched = watch(sizes, source, seconds, Devices(kernel))
    return [_measured(mode, watched[name]) for name, (_, mode) in zip(names, cameras, strict=True)]


def edge_width_px(image: UInt8Array) -> float:
    """Pixels over which the sharpest edges of a scene go from dark to bright: contrast over steepest slope.

    ``image``: (h, w, 3) RGB of anything that has edges. Of a sharp image it is between 1.5 and 3; blurred with a
    deviation of s pixels about 2.5 s. NaN where nothing has enough contrast.
    """
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.float32)
    slope = np.hypot(cv2.Scharr(grey, cv2.CV_32F, 1, 0), cv2.Scharr(grey, cv2.CV_32F, 0, 1)) / 32.0
    around = np.ones((_NEIGHBOURHOOD_PX, _NEIGHBOURHOOD_PX), np.uint8)
    contrast = np.asarray(cv2.dilate(grey, around) - cv2.erode(grey, around))
    steep = (slope >= np.percentile(slope, 100.0 - _STEEPEST)) & (contrast >= _LEAST_CONTRAST) & (slope > 0.0)
    return float(np.median(contrast[steep] / slope[steep])) if steep.any() else math.nan


def as_png(image: UInt8Array) -> bytes:
    """An RGB image as a file."""
    return bytes(cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1])


def _measured(mode: Mode, watched: Watched) -> Measured:
    if watched.image is None:
        return Measured(mode, watched, math.nan, math.nan, math.nan, math.nan)
    grey = cv2.cvtColor(watched.image, cv2.COLOR_RGB2GRAY)
    return Measured(
        mode,
        watched,
        edge_width_px(watched.image),
        float(grey.mean()),
        float(np.mean(grey <= _BLACK)),
        float(np.mean(grey >= _WHITE)),
    )
