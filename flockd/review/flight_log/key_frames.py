"""Key frames of a flight: what one drone's pilot worked with at a few chosen steps, and the file they are kept in."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
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
    shrink: int = 1
    """How many camera pixels, each way, one pixel of these images stands for."""
    name: str = ""
    """The drone's name, where it is another than its number."""

    @property
    def title(self) -> str:
        """The drone's name for people; they count from 1."""
        return self.name or f"drone {self.drone + 1}"

    def at_half_size(self) -> KeyFrame:
        """With a quarter of the pixels, as it is stored; maps are thinned, images averaged."""
        return replace(
            self,
            images={name: _half(image) for name, image in self.images.items()},
            depth={name: _thin(depth) for name, depth in self.depth.items()},
            labels={name: _thin(labels) for name, labels in self.labels.items()},
            flow={name: _thin(flow) for name, flow in self.flow.items()},
            shrink=self.shrink * _STORED_SHRINK,
        )

    def __post_init__(self) -> None:
        for camera in self.cameras:
            if camera not in self.images:
                raise ValueError(f"key frame at {self.time_s:g} s: camera {camera!r} has no image")
            size = self.images[camera].shape[:2]
            for name, maps in self._maps():
                if camera in maps and maps[camera].shape[:2] != size:
                    raise ValueError(
                        f"key frame at {self.time_s:g} s, camera {camera!r}: {name} is {maps[camera].shape[:2]},"
                        f" the image {size}"
                    )

    def _maps(self) -> Iterator[tuple[str, Mapping[str, NDArray[np.generic]]]]:
        yield from (
            ("the depth", self.depth),
            ("the labels", self.labels),
            ("the flow", self.flow),
        )


# ----------------------------------------------------------------------------------------------------------- storage
# Every image is stored encoded: images as JPEG, labels as PNG, depth as 16-bit PNG, flow as 16-bit PNG with a
# channel for where it is known. That is a tenth of what compressed arrays take.

_STORED_SHRINK = 2
_DEPTH_UNIT_M = 0.01
_DEPTH_SKY = 65535
_FLOW_UNIT_PX = 1 / 8
_FLOW_ZERO = 32768


def save_key_frames(path: Path, frames: Sequence[KeyFrame]) -> None:
    """Write the frames at half size, unless they are so already; some 0.4 MB for each frame of four 480x640 cameras."""
    arrays: dict[str, NDArray[np.generic]] = {}
    index = []
    for number, given in enumerate(frames):
        frame = given if given.shrink > 1 else given.at_half_size()
        index.append(
            {
                "time_s": frame.time_s,
                "drone": frame.drone,
                "cameras": list(frame.cameras),
                "track_ids": {str(label): int(track) for label, track in frame.track_ids.items()},
                "ranges": {str(label): float(metres) for label, metres in frame.ranges.items()},
                "shrink": frame.shrink,
                "name": frame.name,
            }
        )
        for camera in frame.cameras:
            arrays[f"{number}/{camera}/image"] = _encode_image(frame.images[camera])
            if camera in frame.depth:
                arrays[f"{number}/{camera}/depth"] = _encode_depth(frame.depth[camera])
            if camera in frame.labels:
                arrays[f"{number}/{camera}/labels"] = _png(frame.labels[camera])
            if camera in frame.flow:
                arrays[f"{number}/{camera}/flow"] = _encode_flow(frame.flow[camera])
    np.savez(path, index=np.frombuffer(json.dumps(index).encode(), np.uint8), **arrays)  # type: ignore[arg-type]


def load_key_frames(path: Path) -> tuple[KeyFrame, ...]:
    """Read what :func:`save_key_frames` wrote: depth to 1 cm up to 655 m, flow to 1/8 px."""
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    frames = []
    for number, entry in enumerate(json.loads(arrays["index"].tobytes())):
        kinds: dict[str, dict[str, NDArray[np.uint8]]] = {}
        for camera in entry["cameras"]:
            for kind in ("image", "depth", "labels", "flow"):
                encoded = arrays.get(f"{number}/{camera}/{kind}")
                if encoded is not None:
                    kinds.setdefault(kind, {})[camera] = encoded
        frames.append(
            KeyFrame(
                time_s=entry["time_s"],
                drone=entry["drone"],
                cameras=tuple(entry["cameras"]),
                images={camera: _decode_image(data) for camera, data in kinds.get("image", {}).items()},
                depth={camera: _decode_depth(data) for camera, data in kinds.get("depth", {}).items()},
                labels={
                    camera: np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.uint8)
                    for camera, data in kinds.get("labels", {}).items()
                },
                flow={camera: _decode_flow(data) for camera, data in kinds.get("flow", {}).items()},
                track_ids={int(label): track for label, track in entry["track_ids"].items()},
                ranges={int(label): metres for label, metres in entry["ranges"].items()},
                shrink=entry["shrink"],
                name=entry.get("name", ""),
            )
        )
    return tuple(frames)


def _thin(image: NDArray[_Pixel]) -> NDArray[_Pixel]:
    """Every second pixel: means across a silhouette would invent depths and labels."""
    return np.ascontiguousarray(image[::_STORED_SHRINK, ::_STORED_SHRINK])


def _png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> UInt8Array:
    return np.asarray(cv2.imencode(".png", image)[1], np.uint8)


def _half(image: UInt8Array) -> UInt8Array:
    height, width = _thin(image).shape[:2]
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _encode_image(image: UInt8Array) -> UInt8Array:
    return np.asarray(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1], np.uint8)


def _decode_image(data: UInt8Array) -> UInt8Array:
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)[..., ::-1]


def _encode_depth(depth: NDArray[np.float32]) -> UInt8Array:
    known = np.isfinite(depth)
    units = np.clip(np.where(known, depth, 0.0) / _DEPTH_UNIT_M, 0, _DEPTH_SKY - 1)
    return _png(np.where(known, np.round(units), _DEPTH_SKY).astype(np.uint16))


def _decode_depth(data: UInt8Array) -> NDArray[np.float32]:
    units = np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))
    return np.where(units == _DEPTH_SKY, np.inf, units * _DEPTH_UNIT_M).astype(np.float32)


def _encode_flow(flow: NDArray[np.float32]) -> UInt8Array:
    pixels = flow.astype(np.float64)
    valid = np.isfinite(pixels).all(axis=2, keepdims=True)
    units = np.where(valid, pixels, 0.0) / _FLOW_UNIT_PX + _FLOW_ZERO
    coded = np.concatenate([np.clip(np.round(units), 0, 65535), valid], axis=2)
    return _png(coded.astype(np.uint16))


def _decode_flow(data: UInt8Array) -> NDArray[np.float32]:
    coded = np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED)).astype(np.float32)
    flow = (coded[..., :2] - _FLOW_ZERO) * np.float32(_FLOW_UNIT_PX)
    return np.where(coded[..., 2:] == 0, np.float32(np.nan), flow)


_KEY_FRAMES, _KEY_FRAMES_APART = 6, 6
"""In a flight, and at least how many steps apart: each costs a second of the report's time and 0.2 MB of its size."""
_SKY_M = 75.0
"""Estimated depth beyond this is shown as sky."""


def key_frame_steps(steps: int) -> set[int]:
    """Which of a flight's steps, counted from 0, are key frames: evenly spread from the first that has optical flow."""
    count = min(max(steps // _KEY_FRAMES_APART, 2), _KEY_FRAMES)
    return set(np.linspace(1, steps - 1, count).astype(int).tolist())


def capture(trace: StepTrace, output: PilotOutput, drone: int, name: str = "") -> list[KeyFrame]:
    """What a pilot worked with in the step that gave ``output`` and ``trace``.

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
