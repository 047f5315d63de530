"""What the simulator adds to images that it drew."""

from __future__ import annotations

import numpy as np
import pytest

from flockd.sim.cameras.camera_simulator import ImageNoise


@pytest.mark.parametrize("size", [(240, 320), (1280, 960), (1500, 1100)])
def test_images_of_any_size_get_the_noise_that_is_asked_for(size: tuple[int, int]) -> None:
    """Larger ones than the tile of noise, too: before, they ended the flight."""
    grey = np.full((*size, 3), 128, np.uint8)
    noisy = ImageNoise(4.0, seed=1).add(grey)
    assert noisy.shape == grey.shape
    assert (noisy.astype(float) - 128.0).std() == pytest.approx(4.0, rel=0.05)
