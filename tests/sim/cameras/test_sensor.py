"""Sensor, glass, compression, shake and timing against data sheets, standards and arithmetic."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flockd.core.messages import Float32Array
from flockd.flight.geometry import PinholeCamera
from flockd.sim.cameras.imperfect_cameras import (
    CamerasConfig,
    CameraTimingConfig,
    SensorNoiseConfig,
    ShakeConfig,
)
from flockd.sim.cameras.real_camera import (
    CameraClock,
    NoiseTile,
    RealCamera,
    grey_levels,
    jpeg,
    linear_light,
    noisy,
    veiled,
)
from flockd.sim.cameras.shutter import CameraMotion, LensField, Shaking
from flockd.sim.renderer.renderer import View

SIZE = (320, 240)
CAMERA = PinholeCamera(np.array([[160.0, 0.0, 160.0], [0.0, 160.0, 120.0], [0.0, 0.0, 1.0]]), SIZE)
LENS = LensField.of(CAMERA)
EVERYWHERE = np.ones(SIZE[::-1], np.bool_)
BEHIND = np.array([0.0, 0.0, -1.0])
TILE = NoiseTile(np.random.default_rng([3, 6]))


def flat(light: float) -> Float32Array:
    return np.full((SIZE[1], SIZE[0], 3), light, np.float32)


def test_light_and_grey_levels_are_those_of_srgb() -> None:
    """IEC 61966-2-1: grey 188 is half of white's light, and 10 is on the straight part, 10 / 255 / 12.92."""
    greys = np.arange(256, dtype=np.uint8).reshape(1, 256, 1).repeat(3, axis=2)
    light = linear_light(greys)
    assert light[0, 188, 0] == pytest.approx(0.5, abs=0.005)
    assert light[0, 10, 0] == pytest.approx(10 / 255 / 12.92, rel=1e-6)
    assert np.array_equal(grey_levels(light), greys)
    assert np.array_equal(grey_levels(np.array([[[-0.1, 1.1, 2.0]]], np.float32)), [[[0, 255, 255]]])


@pytest.mark.parametrize("quality", [None, 80])
def test_twice_as_many_pixels_that_are_reduced_have_half_the_noise(quality: int | None) -> None:
    """Four independent pixels make one. A JPEG takes some of the noise out by itself, so that less is won."""
    grey = View(
        np.full((*SIZE[::-1], 3), 128, np.uint8), np.full(SIZE[::-1], 9.0, np.float32), np.zeros(SIZE[::-1], np.uint8)
    )  # fmt: skip
    still = CameraMotion(np.zeros(3), np.zeros(3), lambda times_s: np.zeros((len(times_s), 3)), {})
    off = []
    for reduce in (1, 2):
        config = CamerasConfig.model_validate(
            {"noise": {"gain": 16.0}, "compression": {"jpeg_quality": quality}, "reduce": reduce}
        )
        camera = RealCamera(config, LENS, TILE, (7,))
        image = camera.compressed(camera.image(grey, still, BEHIND))
        assert image.shape == (*SIZE[::-1], 3)
        off.append(float((image.astype(float) - 128.0).std()))
    assert off[1] == pytest.approx(off[0] / 2, rel=0.1) if quality is None else off[1] < 0.75 * off[0]


def test_noise_at_the_lowest_gain_is_that_of_the_data_sheet() -> None:
    """OV5647: 36 dB of signal over noise at a full well of 4300 electrons, and 68 dB down to the noise in the dark."""
    config = SensorNoiseConfig(gain=1.0, full_well_e=4300.0, read_noise_e=1.7)
    normal = TILE.crop(SIZE[::-1], np.random.default_rng(1))
    white, black = (float(noisy(flat(level), normal, config).std()) for level in (1.0, 0.0))
    assert 20 * math.log10(1.0 / white) == pytest.approx(36.0, abs=0.5)
    assert 20 * math.log10(1.0 / black) == pytest.approx(68.0, abs=0.5)


@pytest.mark.parametrize("gain", [1.0, 4.0, 16.0])
def test_the_variance_grows_with_the_light_by_the_gain(gain: float) -> None:
    """The photon transfer of EMVA 1288: its slope is white over electrons, half the light has half the variance."""
    config = SensorNoiseConfig(gain=gain, full_well_e=4000.0, read_noise_e=0.0)
    normal = TILE.crop(SIZE[::-1], np.random.default_rng(2))
    for light in (0.1, 0.4):
        assert float(noisy(flat(light), normal, config).var()) == pytest.approx(light * gain / 4000.0, rel=0.02)


def test_noise_differs_from_image_to_image_and_not_between_equal_seeds() -> None:
    tile, first, second = TILE, np.random.default_rng(7), np.random.default_rng(7)
    crops = [tile.crop((40, 30), rng) for rng in (first, first, second)]
    assert not np.array_equal(crops[0], crops[1])
    assert np.array_equal(crops[0], crops[2])
    assert tile.crop((1200, 1100), first).shape == (1200, 1100, 3), "larger than the tile"


def test_veiling_glare_is_the_share_of_a_white_field_that_black_shows() -> None:
    """ISO 9358: the light in a small black patch over that of the white around it is the index."""
    field = flat(0.8)
    field[118:122, 158:162] = 0.0
    shown = veiled(field, 0.03, LENS, EVERYWHERE, BEHIND)
    assert shown[120, 160, 0] / shown[10, 10, 0] == pytest.approx(0.03, rel=0.02)
    assert shown[10, 10, 0] == pytest.approx(0.8, rel=0.002), "no light is lost"


def test_the_suns_scattered_light_is_its_share_and_brightest_around_it() -> None:
    """Square to the sun white paper takes pi times its own radiance: 2 % of that over the lens's solid angle."""
    ahead = np.array([0.0, 0.0, 1.0])
    shown = veiled(flat(0.0), 0.02, LENS, EVERYWHERE, ahead)[..., 0]
    assert shown.argmax() in (120 * 320 + 160, 119 * 320 + 160, 119 * 320 + 159, 120 * 320 + 159)
    # A pinhole's pixel spans cos^3 / f^2; 90 degrees across and 73.7 down: Omega = 4 asin(sin 45 sin 36.87).
    omega = 4 * math.asin(math.sin(math.atan(1.0)) * math.sin(math.atan(0.75)))
    assert pytest.approx(omega, rel=0.02) == LENS.solid_angle_sr
    assert shown[5, 5] == pytest.approx(0.02 * math.pi * 0.5 / omega, rel=0.1), "far from it the even half alone"
    for hidden in (~EVERYWHERE, EVERYWHERE):
        sun = ahead if hidden is not EVERYWHERE else BEHIND
        assert veiled(flat(0.0), 0.02, LENS, hidden, sun).max() == 0.0, "behind a tree, or behind the camera"


def test_jpeg_keeps_grey_steps_of_a_block_and_halves_the_resolution_of_colours() -> None:
    blocks = np.repeat(np.repeat(np.array([[40, 90], [160, 220]], np.uint8), 8, 0), 8, 1)[..., None].repeat(3, 2)
    assert np.abs(jpeg(blocks, 95).astype(int) - blocks).max() <= 2
    columns = np.zeros((16, 16, 3), np.uint8)
    columns[:, ::2, 0], columns[:, 1::2, 2] = 200, 200
    shown = jpeg(columns, 95)
    assert np.ptp(shown[..., 0].astype(int) - shown[..., 2].astype(int)) < 40, "red and blue columns become violet"


def test_shaking_has_its_angle_and_its_two_bands() -> None:
    """80 % of the power within 10 % of the propellers' revolutions, the rest at twice as many."""
    times_s = np.arange(0.0, 8.0, 0.001)
    angles = Shaking(ShakeConfig(rms_deg=0.1, frequency_hz=100.0), np.random.default_rng(2)).at(times_s)
    assert np.rad2deg(angles.std(axis=0)) == pytest.approx(0.1, rel=0.02)
    power = (np.abs(np.fft.rfft(angles[:, 0])) ** 2)[1:]
    hertz = np.fft.rfftfreq(len(times_s), 0.001)[1:]
    for low, high, share in ((89.0, 111.0, 0.8), (178.0, 222.0, 0.2)):
        assert power[(hertz > low) & (hertz < high)].sum() / power.sum() == pytest.approx(share, abs=0.02)


def test_stamps_are_honest_of_what_is_known_and_not_of_delay_and_jitter() -> None:
    config = CameraTimingConfig(apart_s=0.03, delay_s=0.02, jitter_s=0.01, dropped=0.1)
    clocks = [CameraClock(config, np.random.default_rng(seed)) for seed in range(40)]
    befores = [10.0 - clock.shot(10.0).stamp_s for clock in clocks]
    assert 0.0 <= min(befores) < 0.01
    assert 0.02 < max(befores) <= 0.03
    shots = [clocks[0].shot(0.5 * number) for number in range(2000)]
    assert np.ptp([0.5 * number - shot.stamp_s for number, shot in enumerate(shots)]) < 1e-9, "a camera keeps its phase"
    late = np.array([shot.stamp_s - shot.shown_s for shot in shots])
    assert late.min() == pytest.approx(0.02, abs=1e-3)
    assert late.max() == pytest.approx(0.03, abs=1e-3)
    assert late.std() == pytest.approx(0.01 / math.sqrt(12), rel=0.1)
    assert np.mean([not shot.comes for shot in shots]) == pytest.approx(0.1, abs=0.02)
