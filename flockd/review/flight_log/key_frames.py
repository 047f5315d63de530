"""Key frames of a flight: what one drone's pilot worked with at a few chosen steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.core.messages import PilotOutput, UInt8Array
from flockd.flight.pilot import StepTrace

_Pixel = TypeVar("_Pixel", bound=np.generic)


@dataclass(frozen=True, eq=False, kw_only=True)
class KeyFrame:
    """What one drone's pilot worked with at one step. A camera without a map is absent from that mapping."""

    time_s: float
    drone: int
    """From 0 up."""
    cameras: tuple[str, ...]
    images: Mapping[str, UInt8Array]
    """(h, w, 3) RGB, at ``time_s``."""
    depth: Mapping[str, NDArray[np.float32]]
    """(h, w) metres along the optical axis; inf is sky."""
    labels: Mapping[str, UInt8Array]
    """(h, w) instances, 0 is background; one label means the same drone in all cameras."""
    flow: Mapping[str, NDArray[np.float32]]
    """(h, w, 2) camera pixels from the previous image to this one; NaN where there is none."""
    track_ids: Mapping[int, int]
    """Label to the track it belongs to."""
    ranges: Mapping[int, float]
    """Label to its distance from the drone in metres."""
    name: str = ""
    """The drone's name, where it is another than its number."""

    @property
    def title(self) -> str:
        """The drone's name for people; they count from 1."""
        return self.name or f"drone {self.drone + 1}"

    def at_half_size(self) -> KeyFrame:
        """A copy of half the size, enough for a plate: images are averaged, maps keep every second pixel."""
        return replace(
            self,
            images={
                name: np.asarray(cv2.resize(image, _thin(image).shape[1::-1], interpolation=cv2.INTER_AREA), np.uint8)
                for name, image in self.images.items()
            },
            depth={name: _thin(depth) for name, depth in self.depth.items()},
            labels={name: _thin(labels) for name, labels in self.labels.items()},
            flow={name: _thin(flow) for name, flow in self.flow.items()},
        )


def _thin(image: NDArray[_Pixel]) -> NDArray[_Pixel]:
    """Every second pixel: means across a silhouette would invent depths and labels."""
    return np.ascontiguousarray(image[::2, ::2])


_KEY_FRAMES, _KEY_FRAMES_APART = 6, 6
"""Most in a flight, and least steps between two: each costs a second of the report's time and 0.2 MB of its size."""
_SKY_M = 75.0
"""Estimated depth beyond this is shown as sky."""


def key_frame_steps(steps: int) -> set[int]:
    """Which of a flight's steps, counted from 0, are key frames: evenly spread from the first that has optical flow."""
    count = min(max(steps // _KEY_FRAMES_APART, 2), _KEY_FRAMES)
    return set(np.linspace(1, steps - 1, count).astype(int).tolist())


def capture(trace: StepTrace, output: PilotOutput, drone: int, name: str = "") -> list[KeyFrame]:
    """The key frame of the step that gave ``output`` and ``trace``, in a list.

    Empty before its first step, and where no camera had a usable image, as of a drone that touched the ground.
    """
    view = trace.observation
    if view is None or not view.cameras:
        return []
    cameras = view.cameras
    return [
        KeyFrame(
            time_s=output.time_s,
            drone=drone,
            name=name,
            cameras=tuple(cameras),
            images={name: c.image for name, c in cameras.items()},
            depth={
                name: np.where(c.depth < _SKY_M, c.depth, np.float32(np.inf))
                for name, c in cameras.items()
                if c.depth is not None
            },
            labels={name: np.where(c.labels == 255, np.uint8(0), c.labels) for name, c in cameras.items()},
            flow=view.flows,
            track_ids={s.label: t for s, t in zip(output.detections, output.detection_tracks, strict=True)},
            ranges={s.label: float(np.linalg.norm(s.position)) for s in output.detections},
        )
    ]
