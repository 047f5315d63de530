"""What several tests of perception begin with."""

from __future__ import annotations

import cv2
import numpy as np

from flockd.core.messages import Float32Array, UInt8Array
from tests.flight.inference.conftest import copies

__all__ = ["copies"]


def grey(image: UInt8Array) -> UInt8Array:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


class WrongFlow:
    """A network that sees motion where there is none."""

    name = "wrong"

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        return np.full((*first.shape[:2], 2), (40.0, 70.0), np.float32)
