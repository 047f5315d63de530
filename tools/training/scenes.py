"""How drones and cameras are held in the rendered scenes, and what of a drone would be seen if nothing hid it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from flockd.flight.geometry import rotation_from_euler


def attitude(yaw: float, tilt: NDArray[Any]) -> NDArray[np.float64]:
    """R_ned_body (3, 3) of a heading, and roll and pitch (2,); all rad."""
    roll, pitch = tilt
    return rotation_from_euler(roll, pitch, yaw)


def drawn_attitude(rng: np.random.Generator) -> NDArray[np.float64]:
    """Any heading, and the tilt of a multirotor on its way."""
    return attitude(rng.uniform(-np.pi, np.pi), rng.normal(0, np.radians(7), 2))


def outline_of(corners: NDArray[Any], matrix: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """(h, w) pixels within a thread around all points (n, 3) m, camera axes; ``matrix`` (3, 3) is its pinhole K."""
    pixels = corners[corners[:, 2] > 0.05] @ matrix.T
    hull = cv2.convexHull(np.round(pixels[:, :2] / pixels[:, 2:]).astype(np.int32))
    outline = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(outline, hull, 1)
    return outline > 0
