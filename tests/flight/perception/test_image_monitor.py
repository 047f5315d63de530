"""Images that are noise, damage or of a bad lens are told by what the camera and its neighbours showed before."""

from __future__ import annotations

import functools
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from flockd.core.config import load_drone
from flockd.core.config.perception import NoiseParameters
from flockd.core.data import data_path
from flockd.core.messages import FloatArray, ReasonKind, UInt8Array
from flockd.flight.geometry import build_rig, rotation_from_euler
from flockd.flight.perception.image_monitor import ImageMonitor, shown_in

pytestmark = [pytest.mark.fault("noisy-camera"), pytest.mark.fault("lens-covered")]
RIG = build_rig(load_drone(data_path("config") / "quadrotor.yaml").rig)
FIRST, *OTHERS = RIG.cameras
SIZE = RIG.cameras[FIRST].camera.size[::-1]
NO_GROUND = np.full((SIZE[0] // 32, SIZE[1] // 32), np.nan)
PARAMETERS = NoiseParameters()
ONLY_NOISE = NoiseParameters(max_unexplained=1.0, min_clarity=0.0)
ONLY_DAMAGE = NoiseParameters(max_white=1.0, max_white_rise=1.0, max_rough_rise=1.0, min_clarity=0.0)
STEP_S = 0.5
LEVEL = np.eye(3)


def white_share(image: UInt8Array) -> float:
    return shown_in(image, PARAMETERS, NO_GROUND).white


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
    """Says of one image after the other, a step apart, whether it is not used; no other camera's image ever is not."""

    def __init__(self, parameters: NoiseParameters = ONLY_NOISE) -> None:
        self._monitor = ImageMonitor(RIG.cameras, parameters)
        self._time_s = 100.0

    def shows(
        self, *images: UInt8Array, after_s: float = STEP_S, others: UInt8Array | None = None, R: FloatArray = LEVEL
    ) -> list[bool]:
        found = []
        for image in images:
            self._time_s += after_s
            shown = {FIRST: image, **dict.fromkeys(OTHERS, SCENE if others is None else others)}
            faults = self._monitor.faults(shown, self._time_s, R)
            assert not faults.keys() & set(OTHERS), "each camera has its own history"
            found.append(FIRST in faults)
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


def test_what_comes_all_at_once_and_stays_for_half_a_minute_is_the_view() -> None:
    camera = Camera()
    camera.shows(SCENE)
    refused = camera.shows(*[GRAVEL] * 65)
    assert refused == [True] * sum(refused) + [False] * (65 - sum(refused))
    assert 30.0 < STEP_S * sum(refused) < 32.0


def test_gravel_that_was_covered_is_no_noise_when_it_comes_back() -> None:
    """As it was seen before it was covered, or as nobody can tell who saw none; but not from one image to the next."""
    assert shown_in(GRAVEL, PARAMETERS, NO_GROUND).rough > PARAMETERS.max_rough_rise
    assert Camera().shows(COVERED, GRAVEL, GRAVEL, GRAVEL) == [False, True, True, True]
    assert Camera().shows(GRAVEL, *[COVERED] * 20, GRAVEL, GRAVEL) == [False] * 23
    lens = Camera(NoiseParameters(max_unexplained=1.0))
    lens.shows(*[SCENE] * 20)
    assert lens.shows(*[COVERED] * 8) == [False] * 4 + [True] * 4
    assert not any(lens.shows(*[GRAVEL] * 8)[4:]), "once its lens is clear, any view may come all at once"


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


def first_shows(*images: UInt8Array | None) -> list[bool]:
    """Whether the first camera is broken, for each image in turn; None: what it should show."""
    camera, views = Camera(ONLY_DAMAGE), (view(number) for number in range(1, len(images) + 1))
    return [
        camera.shows(now if image is None else image, others=now)[0] for now, image in zip(views, images, strict=True)
    ]


@pytest.mark.parametrize("side", [8, 16, 32])
def test_blocks_are_damage_from_their_first_image_on_until_two_good_ones_followed(side: int) -> None:
    damaged = [blocks(side, 1.0, number) for number in (2, 3, 4)]
    shown = [None, *damaged, None, None, None]
    # The first good image does not follow from the damage, the second is the first good one, the third is used.
    assert first_shows(*shown) == [False, True, True, True, True, True, False]


def test_light_that_changes_and_a_black_image_are_no_damage() -> None:
    brighter = np.clip(1.3 * view(2).astype(float) + 15.0, 0, 255).astype(np.uint8)
    assert first_shows(None, brighter, None) == [False] * 3
    assert first_shows(None, np.zeros((*SIZE, 3), np.uint8), None) == [False] * 3


def test_all_cameras_at_once_is_a_motion_and_no_damage_and_one_alone_is_not_judged() -> None:
    rig = Camera(ONLY_DAMAGE)
    for number in range(4):
        turned = scene(1.2, 40.0, seed=number)
        assert rig.shows(turned, others=turned) == [False]
    alone = ImageMonitor({FIRST: RIG.cameras[FIRST]}, ONLY_DAMAGE)
    assert not any(alone.faults({FIRST: scene(1.2, 40.0, seed=n)}, STEP_S * n, LEVEL) for n in range(3))


def test_a_camera_that_rested_may_show_something_else() -> None:
    rig = ImageMonitor(RIG.cameras, ONLY_DAMAGE)
    for number in range(1, 8):
        images = dict.fromkeys(OTHERS, view(number)) | (
            {FIRST: scene(1.2, 40.0, seed=number)} if number % 3 == 1 else {}
        )
        assert not rig.faults(images, 0.1 * number, LEVEL)


# Lenses are told by the ground that they showed before.

Spoil = Callable[[UInt8Array], UInt8Array]
KNOWN = 20
"""Steps in which a camera's ground becomes known."""


@functools.cache
def texture(number: int) -> UInt8Array:
    return scene(1.0, 25.0, seed=number, size=SIZE)


def ground(number: int) -> UInt8Array:
    """Sky above, ground of photographs' spectrum below, other ground in each image of a camera in turn."""
    image = np.roll(texture(number % 9), 37 * number, axis=1)
    image[: SIZE[0] // 2] = 190
    return image


def covered(image: UInt8Array) -> UInt8Array:
    """By a leaf: nearly one colour."""
    return np.full_like(image, 60)


def covered_in_the_dark(image: UInt8Array) -> UInt8Array:
    """By a hand: all that is left is noise of the sensor."""
    return noisy(np.full_like(image, 6), 1.5)


def fogged(image: UInt8Array) -> UInt8Array:
    """Droplets: a blur, and a veil that leaves a fifth of the contrast."""
    soft = cv2.GaussianBlur(image, (0, 0), 3.0)
    return np.asarray(np.clip(0.2 * soft + 0.8 * 180, 0, 255), np.uint8)


def dirty(image: UInt8Array) -> UInt8Array:
    """Grease: a strong blur, at full contrast."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 4.0), np.uint8)


def in_the_sun(image: UInt8Array) -> UInt8Array:
    """Stray light: a quarter of the contrast is left, near white."""
    return np.asarray(np.clip(0.25 * image.astype(np.float32) + 215.0, 0, 255), np.uint8)


def in_dusk(image: UInt8Array) -> UInt8Array:
    return np.asarray(0.2 * image, np.uint8)


def over_asphalt(image: UInt8Array) -> UInt8Array:
    """Half as bright as gravel, and a quarter of its contrast in fine details, which it has all the same."""
    asphalt = 0.5 * image.astype(np.float32)
    soft = cv2.GaussianBlur(asphalt, (0, 0), 6.0)
    return np.asarray(np.clip(soft + 0.5 * (asphalt - soft), 0, 255), np.uint8)


class Drone:
    """Four cameras, a step apart, over ground that changes with each image."""

    def __init__(self, min_clarity: float = PARAMETERS.min_clarity) -> None:
        self._monitor = ImageMonitor(RIG.cameras, NoiseParameters(max_unexplained=1.0, min_clarity=min_clarity))
        self._number, self._time_s = 0, 100.0

    def flies(
        self, steps: int, spoil: Spoil = np.asarray, others: Spoil = np.asarray, R_ned_body: FloatArray = LEVEL
    ) -> list[bool]:
        """Whether the first camera is not used, step by step; no other ever is."""
        found = []
        for _ in range(steps):
            self._time_s += STEP_S
            images = {}
            for name in RIG.cameras:
                self._number += 1
                images[name] = (spoil if name == FIRST else others)(ground(self._number))
            faults = self._monitor.faults(images, self._time_s, R_ned_body)
            assert not faults.keys() & set(OTHERS), faults
            assert {fault.kind for fault in faults.values()} <= {ReasonKind.LENS}
            found.append(FIRST in faults)
        return found


@pytest.mark.parametrize(
    ("spoil", "after"),
    [(covered, 3), (covered_in_the_dark, 3), *((one, KNOWN) for one in (covered, fogged, dirty, in_the_sun))],
)
def test_what_takes_contrast_or_sharpness_from_one_camera_makes_it_blind_until_it_is_clear(
    spoil: Spoil, after: int
) -> None:
    """After two seconds, and as long until it counts again; a cover that takes nearly all of it, from the start on."""
    drone = Drone()
    assert drone.flies(after) == [False] * after
    assert drone.flies(12, spoil) == [False] * 4 + [True] * 8
    assert drone.flies(12) == [True] * 4 + [False] * 8


@pytest.mark.parametrize(("after", "smooth"), [(6, 1), (6, 2), (KNOWN, 1), (100, 1)])
def test_a_clean_lens_that_comes_from_gravel_to_asphalt_stays_in_use(after: int, smooth: int) -> None:
    """In the first seconds of a flight, from when little is known of its ground, also to what is smooth twice over."""
    drone = Drone()
    drone.flies(after)
    assert not any(drone.flies(40, lambda image: over_asphalt(over_asphalt(image) if smooth > 1 else image)))
    assert not any(drone.flies(40))


@pytest.mark.parametrize("spoil", [in_dusk, fogged, dirty, covered])
def test_what_all_cameras_see_is_no_lens(spoil: Spoil) -> None:
    """Dusk, mist, ground without texture, and grass right before all of them after a landing."""
    drone = Drone()
    drone.flies(KNOWN)
    assert not any(drone.flies(20, spoil, others=spoil))


def test_a_camera_that_looks_at_the_sky_is_not_judged() -> None:
    """The drone leans by 70 degrees: the first camera, which looks ahead, sees the sky alone."""
    drone = Drone()
    drone.flies(KNOWN)
    up = rotation_from_euler(0.0, np.deg2rad(70.0), 0.0)
    assert not any(drone.flies(10, covered, R_ned_body=up))


def test_what_was_there_from_the_start_is_the_cameras_own_and_the_check_can_be_left_out() -> None:
    assert not any(Drone().flies(40, fogged))
    drone = Drone(min_clarity=0.0)
    drone.flies(KNOWN)
    assert not any(drone.flies(20, covered))
