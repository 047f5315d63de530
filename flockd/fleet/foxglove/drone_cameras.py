"""Cameras: where they sit, their small pictures, and in them the drones that are tracked."""

from __future__ import annotations

import math
from collections.abc import Iterable

import foxglove.messages as fm
import numpy as np
from scipy.spatial.transform import Rotation

from flockd.core.config.rig import CameraConfig
from flockd.fleet.camera_rigs import DroneCamera
from flockd.fleet.foxglove.fleet_scene import attitude, transform
from flockd.fleet.page.drone_rows import Row
from flockd.flight.geometry import RigCamera
from flockd.onboard.recording import foxglove

_CENTRE_PX = 0.5
"""Pixel centres lie at whole numbers in Foxglove, and half a pixel farther here."""


def frame_of(drone: str, camera: str) -> str:
    """A camera's frame; so its topics begin."""
    return f"{drone}/camera/{camera}"


def camera_transforms(stamp: fm.Timestamp, drone: str, cameras: Iterable[RigCamera]) -> list[fm.FrameTransform]:
    """From each camera's frame (right, down, forward) to the body's."""
    mountings = [(frame_of(drone, camera.name), camera.T_body_camera) for camera in cameras]
    return [
        transform(stamp, drone, frame, place.translation, Rotation.from_matrix(place.rotation))
        for frame, place in mountings
    ]


def image(stamp: fm.Timestamp, frame: str, picture: bytes) -> fm.CompressedImage:
    """The message of a JPEG."""
    return fm.CompressedImage(timestamp=stamp, frame_id=frame, data=picture, format="jpeg")


def calibration(time_ns: int, frame: str, camera: CameraConfig, size_px: tuple[int, int]) -> bytes:
    """A serialized CameraCalibration of the camera's small picture."""
    scale, lens = size_px[0] / camera.size_px[0], camera.intrinsics
    scaled = lens.model_copy(update={name: scale * getattr(lens, name) for name in ("fx", "fy", "cx", "cy")})
    small = camera.model_copy(update={"name": frame, "size_px": size_px, "intrinsics": scaled})
    return foxglove.calibration(time_ns, small)


def tracks(stamp: fm.Timestamp, camera: DroneCamera, size_px: tuple[int, int], row: Row) -> fm.ImageAnnotations:
    """A circle and the range at each tracked drone in the small picture, where its observer believes it to be."""
    circles, texts, scale = [], [], size_px[0] / camera.config.size_px[0]
    for one in (one for one in row["sees"] if one["ned"] is not None):
        place_body = attitude(row).inv().apply(one["ned"])
        ((u, v),) = camera.mounted.pixels_of_points(np.array([place_body])).tolist()
        if math.isnan(u):  # not in this camera's image
            continue
        at = fm.Point2(x=scale * u - _CENTRE_PX, y=scale * v - _CENTRE_PX)
        colour = fm.Color(r=0.4, g=0.8, b=0.93, a=1.0 if one["confirmed"] else 0.4)
        text = f"track {one['track']}: {math.hypot(*one['ned']):.1f} m"
        circles.append(
            fm.CircleAnnotation(timestamp=stamp, position=at, diameter=24.0, outline_color=colour, thickness=1.0)
        )
        texts.append(fm.TextAnnotation(timestamp=stamp, position=at, text=text, text_color=colour, font_size=10.0))
    return fm.ImageAnnotations(timestamp=stamp, circles=circles, texts=texts)
