"""A small JPEG of a camera's newest frame, for telemetry over a radio link."""

from __future__ import annotations

import cv2

from flockd.messages import Frame

LARGEST_SIDE_PX = 320
JPEG_QUALITY = 70


def preview(frame: Frame) -> bytes:
    """A JPEG of the frame, at most 320 pixels wide and high."""
    height, width = frame.image.shape[:2]
    scale = min(1.0, LARGEST_SIDE_PX / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()
