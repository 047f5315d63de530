"""Images that are noise are told from images of scenes, and camera by camera from what it showed before."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flockd.config.perception import NoiseParameters
from flockd.messages import UInt8Array
from flockd.perception.image_noise import NoiseMonitor, noise_share

SIZE = (480, 640)
PARAMETERS = NoiseParameters()


def scene(slope: float, contrast: float, seed: int = 0, size: tuple[int, int] = SIZE) -> UInt8Array:
    """A random texture whose amplitude falls with this power of the spatial frequency, as photographs' does with 1."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(rng.standard_normal(size))
    rows, columns = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None]
    frequency = np.hypot(rows, columns)
    frequency[0, 0] = np.inf
    texture = np.fft.irfft2(spectrum * frequency**-slope, s=size)
    grey = 128 + contrast * texture / texture.std()
    return np.clip(grey, 0, 255).astype(np.uint8)[..., None].repeat(3, axis=2)


def noisy(image: UInt8Array, sigma: float, share: float = 1.0, seed: int = 1) -> UInt8Array:
    """Its upper rows with noise."""
    rows = round(share * len(image))
    added = image[:rows] + sigma * np.random.default_rng(seed).standard_normal(image[:rows].shape)
    return np.concatenate([np.clip(added, 0, 255).astype(np.uint8), image[rows:]])


def test_fine_texture_of_photographs_is_no_noise_however_strong_it_is() -> None:
    """Amplitudes as 1/f, at 55 grey levels more than any grass, and half as steep: gravel, seen without any blur."""
    assert noise_share(scene(1.0, 55.0), PARAMETERS) < 0.01
    assert noise_share(scene(0.7, 55.0), PARAMETERS) < PARAMETERS.max_rise


@pytest.mark.parametrize("sigma", [35.0, 50.0, 80.0])
def test_noise_that_invents_drones_is_noise_before_a_plain_sky_and_before_texture(sigma: float) -> None:
    assert noise_share(noisy(scene(1.0, 2.0), sigma), PARAMETERS) > 0.85
    assert noise_share(noisy(scene(1.0, 40.0), sigma), PARAMETERS) > 1.5 * PARAMETERS.max_share


def test_noise_of_a_good_camera_is_none_and_so_are_images_of_one_colour_or_too_small() -> None:
    assert noise_share(noisy(scene(1.0, 30.0), 8.0), PARAMETERS) < 0.02
    assert noise_share(np.full((*SIZE, 3), 70, np.uint8), PARAMETERS) == 0.0
    assert noise_share(noisy(scene(1.0, 10.0, size=(24, 640)), 80.0), PARAMETERS) == 0.0


def test_noise_is_found_in_what_jpeg_leaves_of_it() -> None:
    done, data = cv2.imencode(".jpg", noisy(scene(1.0, 20.0), 50.0), [cv2.IMWRITE_JPEG_QUALITY, 70])
    assert done
    assert noise_share(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8), PARAMETERS) > 0.85


def test_the_share_is_that_of_the_noisy_part() -> None:
    """240 of 480 rows: 7.5 of 15 rows of blocks."""
    assert noise_share(noisy(scene(1.0, 5.0), 60.0, share=0.5), PARAMETERS) == pytest.approx(0.5, abs=1 / 15)


def test_a_camera_counts_as_noisy_until_two_of_its_images_in_a_row_were_clean() -> None:
    monitor, clean, bad = NoiseMonitor(PARAMETERS), scene(1.0, 20.0), noisy(scene(1.0, 20.0), 50.0)
    shown = [clean, bad, bad, clean, bad, clean, clean, clean]
    assert [monitor.is_noisy("front", image) for image in shown] == [False, True, True, True, True, True, False, False]
    assert not monitor.is_noisy("back", clean), "each camera has its own history"


def test_a_band_of_noise_is_noticed_by_what_the_camera_showed_before() -> None:
    """An eighth of the image, less than the share that is too much for any camera."""
    clean, band = scene(1.0, 20.0), noisy(scene(1.0, 20.0), 60.0, share=0.14)
    assert noise_share(band, PARAMETERS) < PARAMETERS.max_share
    unknown, known = NoiseMonitor(PARAMETERS), NoiseMonitor(PARAMETERS)
    assert not unknown.is_noisy("front", band), "it may always have shown that"
    assert not unknown.is_noisy("front", band)
    assert not known.is_noisy("front", clean)
    assert known.is_noisy("front", band)
    assert known.is_noisy("front", band), "refused images are no history"
