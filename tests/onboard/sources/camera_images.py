"""Pictures for cameras to send: each shows something else, and says so in its colours."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import UInt8Array

SIZE = (640, 480)


def scene(number: int = 0) -> UInt8Array:
    """RGB: red on the left, blue on the right, with grain that is new for each number."""
    rng = np.random.default_rng(number)
    image = np.empty((SIZE[1], SIZE[0], 3), np.uint8)
    image[:, : SIZE[0] // 2] = (220, 40, 40)
    image[:, SIZE[0] // 2 :] = (40, 40, 220)
    grain = cv2.resize(rng.integers(0, 30, (SIZE[1] // 8, SIZE[0] // 8, 1), np.uint8), SIZE)[..., None]
    return np.asarray(image + grain, np.uint8)


def jpeg(image: UInt8Array) -> bytes:
    ok, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])
    assert ok
    return data.tobytes()


def yuyv(colours: list[tuple[int, int, int]], size: tuple[int, int], padding: int = 0) -> bytes:
    """Vertical bars of (Y, U, V), each row followed by padding."""
    width, height = size
    row = np.empty((width // 2, 4), np.uint8)
    for bar, columns in enumerate(np.array_split(np.arange(width // 2), len(colours))):
        y, u, v = colours[bar]
        row[columns] = (y, u, y, v)
    return (row.tobytes() + b"\xee" * padding) * height
