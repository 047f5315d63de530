"""What several tests of perception begin with."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from flockd.data import data_path
from flockd.messages import Float32Array, UInt8Array


@pytest.fixture
def copies(tmp_path: Path) -> Path:
    """The shipped models, to be spoilt."""
    folder = tmp_path / "models"
    shutil.copytree(data_path("models"), folder)
    return folder


def grey(image: UInt8Array) -> UInt8Array:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


class Astray:
    """A network that sees motion where there is none."""

    name = "astray"

    def flow(self, first: UInt8Array, second: UInt8Array) -> Float32Array:
        return np.full((*first.shape[:2], 2), (40.0, 70.0), np.float32)
