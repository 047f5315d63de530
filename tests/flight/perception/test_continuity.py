"""An image that does not follow from the one before it is told by comparison with the other cameras'."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from flockd.core.config.perception import NoiseParameters
from flockd.core.messages import UInt8Array
from flockd.flight.geometry.rotations import rotation_from_euler
from flockd.flight.perception.continuity import ContinuityMonitor
from tests.flight.perception.test_image_noise import SIZE, scene

pytestmark = pytest.mark.fault("noisy-camera")

STEP_S = 0.5
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


def test_few_blocks_are_not_enough_and_many_are() -> None:
    assert Rig().left_shows(None, blocks(16, 0.03, 2), None) == [False] * 3
    assert Rig().left_shows(None, blocks(16, 0.5, 2), blocks(16, 0.5, 3)) == [False, True, True]


def test_light_that_changes_and_a_black_image_are_no_damage() -> None:
    brighter = np.clip(1.3 * view(2).astype(float) + 15.0, 0, 255).astype(np.uint8)
    assert Rig().left_shows(None, brighter, None) == [False] * 3
    assert Rig().left_shows(None, np.zeros((*SIZE, 3), np.uint8), None) == [False] * 3


def test_after_a_pause_a_camera_may_see_something_else() -> None:
    assert Rig().left_shows(None, scene(1.2, 40.0, seed=9), after_s=5.0) == [False, False]


def test_all_cameras_at_once_is_a_motion_and_no_damage_and_one_alone_is_not_judged() -> None:
    monitor = ContinuityMonitor(NoiseParameters())
    for number in range(4):
        turned = scene(1.2, 40.0, seed=number)
        assert monitor.broken(dict.fromkeys(CAMERAS, turned), STEP_S * number, np.eye(3)) == []
    alone = ContinuityMonitor(NoiseParameters())
    found = [alone.broken({"front": scene(1.2, 40.0, seed=n)}, STEP_S * n, np.eye(3)) for n in range(3)]
    assert found == [[]] * 3


@pytest.mark.parametrize(("turn_deg", "judged"), [(5.0, True), (15.0, False)])
def test_while_the_drone_turns_fast_no_camera_is_judged(turn_deg: float, judged: bool) -> None:
    monitor = ContinuityMonitor(NoiseParameters())
    for number in range(2):
        shown = {name: view(number) for name in CAMERAS} | {"left": blocks(16, 1.0, number)}
        broken = monitor.broken(shown, STEP_S * number, rotation_from_euler(0.0, 0.0, number * np.deg2rad(turn_deg)))
    assert broken == (["left"] if judged else [])
