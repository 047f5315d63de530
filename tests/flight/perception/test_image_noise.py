"""Images that are noise are told from those of scenes and from what the camera and its neighbours showed before."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flockd.core.config.perception import NoiseParameters
from flockd.core.messages import UInt8Array
from flockd.flight.perception.continuity import ContinuityMonitor
from flockd.flight.perception.image_noise import NoiseMonitor, noise_shares

pytestmark = pytest.mark.fault("noisy-camera")

SIZE = (480, 640)
PARAMETERS = NoiseParameters()
STEP_S = 0.5


def white_share(image: UInt8Array) -> float:
    return noise_shares(image, PARAMETERS).white


def scene(slope: float, contrast: float, seed: int = 0, size: tuple[int, int] = SIZE) -> UInt8Array:
    """A random texture whose amplitude falls with this power of the spatial frequency, as photographs' does with 1."""
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(rng.standard_normal(size))
    rows, columns = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None]
    frequency = np.hypot(rows, columns)
    frequency[0, 0] = np.inf
    texture = np.fft.irfft2(spectrum * frequency**-slope, s=size)
    grey = 128 + contrast * texture / texture.std()
    image: UInt8Array = np.clip(grey, 0, 255).astype(np.uint8)[..., None].repeat(3, axis=2)
    return image


def noisy(image: UInt8Array, sigma: float, share: float = 1.0, seed: int = 1) -> UInt8Array:
    """Its upper rows with noise."""
    rows = round(share * len(image))
    added = image[:rows] + sigma * np.random.default_rng(seed).standard_normal(image[:rows].shape)
    return np.concatenate([np.clip(added, 0, 255).astype(np.uint8), image[rows:]])


def test_fine_texture_of_photographs_is_no_noise_however_strong_it_is() -> None:
    """Amplitudes as 1/f, at 55 grey levels more than any grass, and half as steep: gravel, seen without any blur."""
    assert white_share(scene(1.0, 55.0)) < 0.01
    assert white_share(scene(0.7, 55.0)) < PARAMETERS.max_white_rise


@pytest.mark.parametrize("sigma", [35.0, 50.0, 80.0])
def test_noise_that_invents_drones_is_noise_before_a_plain_sky_and_before_texture(sigma: float) -> None:
    assert white_share(noisy(scene(1.0, 2.0), sigma)) > 0.85
    assert white_share(noisy(scene(1.0, 40.0), sigma)) > 1.5 * PARAMETERS.max_white


class Camera:
    """Says of one image after the other, a step apart, whether it is noisy."""

    def __init__(self) -> None:
        self._monitor = NoiseMonitor(PARAMETERS)
        self._time_s = 100.0

    def shows(self, *images: UInt8Array, after_s: float = STEP_S) -> list[bool]:
        found = []
        for image in images:
            self._time_s += after_s
            found.append(self._monitor.is_noisy("front", image, self._time_s))
            assert not self._monitor.is_noisy("back", SCENE, self._time_s), "each camera has its own history"
        return found


SCENE = scene(1.0, 20.0)
NOISE = noisy(SCENE, 50.0)


def test_a_camera_counts_as_noisy_until_two_of_its_images_in_a_row_were_clean() -> None:
    shown = [SCENE, NOISE, NOISE, SCENE, NOISE, SCENE, SCENE, SCENE]
    assert Camera().shows(*shown) == [False, True, True, True, True, True, False, False]


def test_a_band_of_noise_is_noticed_by_what_the_camera_showed_before() -> None:
    """An eighth of the image, less than the share that is too much for any camera."""
    band = noisy(SCENE, 60.0, share=0.14)
    assert white_share(band) < PARAMETERS.max_white
    assert Camera().shows(band, band) == [False, False], "it may always have shown that"
    assert Camera().shows(SCENE, band, band) == [False, True, True], "refused images are no history"


@pytest.mark.parametrize("blur_px", [1.0, 2.0])
def test_noise_that_was_filtered_is_noticed_as_it_comes_all_at_once(blur_px: float) -> None:
    """Noise of 35 grey levels, as soft as the scene: at the finest scale there is none of it."""
    added = cv2.GaussianBlur(np.random.default_rng(2).standard_normal((*SIZE, 3)), (0, 0), blur_px)
    soft = np.clip(SCENE + 35.0 / added.std() * added, 0, 255).astype(np.uint8)
    assert white_share(soft) < 0.01
    assert Camera().shows(SCENE, soft, soft, soft, soft, soft, soft) == [False, *[True] * 6]
    assert Camera().shows(SCENE) + Camera().shows(soft, after_s=5.0) == [False, False], "it may be another view"


GRAVEL = scene(0.8, 60.0, seed=4)
COVERED = np.full((*SIZE, 3), 50, np.uint8)


def test_gravel_that_was_covered_is_no_noise_when_it_comes_back() -> None:
    """As it was seen before it was covered, or as nobody can tell who saw none; but not from one image to the next."""
    assert noise_shares(GRAVEL, PARAMETERS).rough > PARAMETERS.max_rough_rise
    assert Camera().shows(COVERED, GRAVEL, GRAVEL, GRAVEL) == [False, True, True, True]
    assert Camera().shows(GRAVEL, *[COVERED] * 20, GRAVEL, GRAVEL) == [False] * 23
    monitor = NoiseMonitor(PARAMETERS)
    for step in range(8):
        assert not monitor.is_noisy("front", COVERED if step < 6 else GRAVEL, step * STEP_S)
        if 2 <= step < 6:  # by then the lens counts as covered
            monitor.forget("front")


# Images that do not follow from the ones before them are told by comparison with the other cameras'.


CAMERAS = ("front", "right", "left")
WORLD = scene(1.2, 40.0, size=(SIZE[0], 2 * SIZE[1]))


def view(number: int, pixels_a_step: int = 12) -> UInt8Array:
    """The world, from a camera that moves along it."""
    left = number * pixels_a_step
    return WORLD[:, left : left + SIZE[1]]


def blocks(side: int, share: float, number: int) -> UInt8Array:
    """The view with squares of one colour each; a share of all, at other places in each image."""
    rng = np.random.default_rng(number)
    cells = (SIZE[0] // side, SIZE[1] // side)
    colours = cv2.resize(rng.integers(0, 256, (*cells, 3), dtype=np.uint8), SIZE[::-1], interpolation=cv2.INTER_NEAREST)
    hit = cv2.resize((rng.random(cells) < share).astype(np.uint8), SIZE[::-1], interpolation=cv2.INTER_NEAREST)
    return np.where(hit[..., None] > 0, np.asarray(colours, np.uint8), view(number))


class Rig:
    """Cameras that all see the world; one of them may show something else."""

    def __init__(self) -> None:
        self._monitor = ContinuityMonitor(NoiseParameters())
        self._number = 0

    def left_shows(self, *images: UInt8Array | None, after_s: float = STEP_S) -> list[bool]:
        """Whether the left camera is broken, for each image in turn; None: what it should show."""
        found = []
        for image in images:
            self._number += 1
            shown = {name: view(self._number) for name in CAMERAS}
            shown["left"] = shown["left"] if image is None else image
            broken = self._monitor.broken(shown, 100.0 + after_s * self._number, np.eye(3))
            assert set(broken) <= {"left"}
            found.append(bool(broken))
        return found


@pytest.mark.parametrize("side", [8, 16, 32])
def test_blocks_are_damage_from_their_first_image_on_until_two_good_ones_followed(side: int) -> None:
    damaged = [blocks(side, 1.0, number) for number in (2, 3, 4)]
    shown = [None, *damaged, None, None, None]
    # The first good image does not follow from the damage, the second is the first good one, the third is used.
    assert Rig().left_shows(*shown) == [False, True, True, True, True, True, False]


def test_light_that_changes_and_a_black_image_are_no_damage() -> None:
    brighter = np.clip(1.3 * view(2).astype(float) + 15.0, 0, 255).astype(np.uint8)
    assert Rig().left_shows(None, brighter, None) == [False] * 3
    assert Rig().left_shows(None, np.zeros((*SIZE, 3), np.uint8), None) == [False] * 3


def test_all_cameras_at_once_is_a_motion_and_no_damage_and_one_alone_is_not_judged() -> None:
    monitor = ContinuityMonitor(NoiseParameters())
    for number in range(4):
        turned = scene(1.2, 40.0, seed=number)
        assert monitor.broken(dict.fromkeys(CAMERAS, turned), STEP_S * number, np.eye(3)) == []
    alone = ContinuityMonitor(NoiseParameters())
    found = [alone.broken({"front": scene(1.2, 40.0, seed=n)}, STEP_S * n, np.eye(3)) for n in range(3)]
    assert found == [[]] * 3
