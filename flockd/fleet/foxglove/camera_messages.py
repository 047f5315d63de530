"""Cameras: where they sit, their small pictures, and in them the drones that are tracked."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from foxglove.messages import (
    CircleAnnotation,
    Color,
    CompressedImage,
    FrameTransform,
    ImageAnnotations,
    Point2,
    TextAnnotation,
    Timestamp,
)
from pydantic import ValidationError

from flockd.core.config.rig import CameraConfig, RigConfig
from flockd.core.image_header import jpeg_size
from flockd.fleet.foxglove.map_places import Message, R_ned_body, transform
from flockd.fleet.page.drone_rows import Known
from flockd.flight.geometry import Rig, RigCamera, build_rig
from flockd.onboard.recording import foxglove

_CENTRE_PX = 0.5
"""Pixel centres lie at whole numbers in Foxglove, and half a pixel farther here."""
_CONFIRMED, _TENTATIVE = Color(r=0.4, g=0.8, b=0.93, a=1.0), Color(r=0.4, g=0.8, b=0.93, a=0.4)


class Cameras:
    """One drone's, as its configuration has them; none where it is not known or cannot be."""

    def __init__(self, known: Known) -> None:
        self._configs: dict[str, CameraConfig] = {}
        self._rig: Rig | None = None
        configuration: Mapping[str, Any] = {} if known.about is None else known.about["configuration"]
        try:
            config = RigConfig.model_validate_json(json.dumps(configuration.get("rig")))
            self._rig = build_rig(config)
        except (ValidationError, ValueError):  # of a peer of another version
            return
        self._configs = {camera.name: camera for camera in config.cameras}

    def transforms(self, stamp: Timestamp, body: str) -> Iterator[FrameTransform]:
        """From each camera's frame (right, down, forward) to the body's."""
        for name, camera in ({} if self._rig is None else self._rig.cameras).items():
            mounted = camera.T_body_camera
            yield transform(stamp, body, frame_of(body, name), mounted.translation, mounted.rotation)

    def calibration(self, time_ns: int, body: str, camera: str, picture: bytes) -> bytes | None:
        """A CameraCalibration of the camera's small picture; None where one of them is not known."""
        size, config = jpeg_size(picture), self._configs.get(camera)
        if size is None or config is None:
            return None
        (width, height), scale = size, size[0] / config.size_px[0]
        lens = config.intrinsics
        scaled = {"fx": scale * lens.fx, "fy": scale * lens.fy, "cx": scale * lens.cx, "cy": scale * lens.cy}
        small = config.model_copy(
            update={
                "name": frame_of(body, camera),
                "size_px": (width, height),
                "intrinsics": lens.model_copy(update=scaled),
            }
        )
        return foxglove.calibration(time_ns, small)

    def tracks(
        self, stamp: Timestamp, camera: str, picture: bytes, messages: Mapping[str, Message]
    ) -> ImageAnnotations:
        """A circle and the range at each tracked drone, where its observer believes it to be."""
        size, seen = jpeg_size(picture), None if self._rig is None else self._rig.cameras.get(camera)
        circles, texts = [], []
        if size is not None and seen is not None:
            scale = size[0] / self._configs[camera].size_px[0]
            for one, (u, v) in _in_camera(seen, messages):
                at = Point2(x=scale * u - _CENTRE_PX, y=scale * v - _CENTRE_PX)
                colour = _CONFIRMED if one["confirmed"] else _TENTATIVE
                text = f"track {one['track']}: {math.hypot(*one['position_ned']):.1f} m"
                circles.append(
                    CircleAnnotation(timestamp=stamp, position=at, diameter=24.0, outline_color=colour, thickness=1.0)
                )
                texts.append(TextAnnotation(timestamp=stamp, position=at, text=text, text_color=colour, font_size=10.0))
        return ImageAnnotations(timestamp=stamp, circles=circles, texts=texts)


def frame_of(body: str, camera: str) -> str:
    """A camera's frame; so its topics begin."""
    return f"{body}/camera/{camera}"


def image(stamp: Timestamp, body: str, camera: str, picture: bytes) -> CompressedImage:
    """Of a JPEG."""
    return CompressedImage(timestamp=stamp, frame_id=frame_of(body, camera), data=picture, format="jpeg")


def _in_camera(camera: RigCamera, messages: Mapping[str, Message]) -> Iterator[tuple[Message, tuple[float, float]]]:
    """Each neighbour in this camera's image, and its pixel there."""
    turn = R_ned_body(messages.get("state"))
    for one in messages.get("neighbours", {}).get("neighbours", ()):
        if len(one["position_ned"]) != 3 or None in one["position_ned"]:
            continue
        ((u, v),) = camera.pixels_of_points(np.array([one["position_ned"]]) @ turn).tolist()
        if math.isfinite(u):
            yield one, (u, v)
