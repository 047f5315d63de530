"""What cameras do to pictures, against optics, sensors and JPEG as they are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tools.training.camera_effects import (
    CameraEffects,
    through_camera,
)

PERFECT = CameraEffects(
    scale=1.0, blur_px=0.0, smear_px=0.0, smear_angle=0.0, gains=(1.0, 1.0, 1.0), gamma=1.0, offset=0.0,
    has_mosaic=False, noise=0.0, denoising=0.0, sharpening=0.0, quality=None, resampling=1.0,
)  # fmt: skip


def edge(height: int = 96, width: int = 96) -> NDArray[np.uint8]:
    image = np.full((height, width, 3), 60, np.uint8)
    image[:, width // 2 :] = 180
    return image


def rise_px(image: NDArray[np.uint8]) -> float:
    """From 10 to 90 % of the edge in the middle row."""
    row = image[image.shape[0] // 2, :, 1].astype(float)
    low, high = row[:8].mean(), row[-8:].mean()
    places = np.interp([0.1, 0.9], np.maximum.accumulate((row - low) / (high - low)), np.arange(len(row)))
    return float(places[1] - places[0])


def test_a_camera_without_faults_changes_nothing() -> None:
    image = np.random.default_rng(0).integers(0, 256, (96, 96, 3), dtype=np.uint8)
    assert np.array_equal(through_camera(image, PERFECT, np.random.default_rng(1)), image)


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_blur_counts_in_pixels_of_the_camera_and_not_of_the_enlarged_crop(scale: float) -> None:
    effects = replace(PERFECT, scale=scale, blur_px=1.2)
    # A Gaussian edge rises from 10 to 90 % over 2.563 sigma; enlarging adds the width of a camera pixel's triangle.
    expected = 2.563 * 1.2 / scale
    found = rise_px(through_camera(edge(384, 384), effects, np.random.default_rng(0)))
    assert found == pytest.approx(expected, rel=0.25)
    assert found > 0.95 * expected


def test_noise_has_the_strength_that_was_asked_for_and_denoising_lessens_it() -> None:
    grey = np.full((96, 96, 3), 128, np.uint8)
    noisy = through_camera(grey, replace(PERFECT, noise=6.0), np.random.default_rng(0))
    assert noisy.astype(float).std() == pytest.approx(6.0, rel=0.05)
    denoised = through_camera(grey, replace(PERFECT, noise=6.0, denoising=25.0), np.random.default_rng(0))
    assert denoised.astype(float).std() < 3.5
