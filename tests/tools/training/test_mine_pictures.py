"""Real drones are followed from their labelled frames into others; clips of one scene stay on one side."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flockd.core.data import data_path
from tools.training import mine_pictures
from tools.training.mine_pictures import FOLLOW_STEP, FOLLOW_STEPS, followed, found_again
from tools.training.real_patches import PATCH_PX
from tools.training.skydrones import split_of

RENDERED = Path(__file__).resolve().parents[2] / "ground" / "pictures" / "rendered"
SKY, DRONE = (120, 160, 200), (40, 45, 50)
WIDE, HIGH = 14, 5
LABELLED = 40


def _place(number: int) -> tuple[int, int]:
    """Left and top of the drone in an image: 1.5 px a frame to the right, and slowly up."""
    return 60 + 3 * number // 2, 50 - number // 4


def _image(number: int, *, wide: int = WIDE) -> NDArray[np.uint8]:
    """Noisy sky with a dark drone."""
    image = np.empty((120, 240, 3), np.float64)
    image[:] = SKY
    left, top = _place(number)
    image[top : top + HIGH, left : left + wide] = DRONE
    return np.clip(image + np.random.default_rng(number).normal(0, 2, image.shape), 0, 255).astype(np.uint8)


def _box(number: int) -> tuple[float, float, float, float]:
    left, top = _place(number)
    return float(left), float(top), float(left + WIDE), float(top + HIGH)


def test_a_drone_is_followed_both_ways_from_its_label() -> None:
    images = [_image(number) for number in range(80)]
    boxes = followed(images, {LABELLED: _box(LABELLED)})
    reach = FOLLOW_STEP * FOLLOW_STEPS
    assert sorted(boxes) == list(range(LABELLED - reach, LABELLED + reach + 1, FOLLOW_STEP))
    for number, box in boxes.items():
        np.testing.assert_allclose(box, _box(number), atol=1.0)


def test_a_label_is_never_replaced() -> None:
    images = [_image(number) for number in range(80)]
    late = (1.0, 2.0, 3.0, 4.0)
    boxes = followed(images, {LABELLED: _box(LABELLED), LABELLED + FOLLOW_STEP: late})
    assert boxes[LABELLED + FOLLOW_STEP] == late


def test_following_ends_with_the_clip_and_with_the_drone() -> None:
    images = [_image(number) for number in range(LABELLED + 2)]
    for number in range(LABELLED - 4):  # nothing flies in the first images
        images[number] = np.full_like(images[number], SKY)
    assert sorted(followed(images, {LABELLED: _box(LABELLED)})) == [LABELLED - FOLLOW_STEP, LABELLED]


@pytest.mark.parametrize("wide", [WIDE // 3, 3 * WIDE], ids=["smaller", "larger"])
def test_what_is_of_another_size_is_not_the_drone(wide: int) -> None:
    assert found_again(_image(LABELLED, wide=wide), _box(LABELLED)) is None


def test_before_trees_nothing_is_found() -> None:
    image = _image(LABELLED)
    left, top, right, _ = (round(value) for value in _box(LABELLED))
    image[top + 3 :, left - 30 : right + 30] = DRONE
    assert found_again(image, _box(LABELLED)) is None


def test_each_block_of_ten_clips_is_on_one_side() -> None:
    sides = {number: split_of(f"V_DRONE_{number:03d}.mp4") for number in (11, 20, 31, 40, 51, 80, 91, 100, 111, 114)}
    assert sides == {
        11: "training", 20: "training", 31: "validation", 40: "validation", 51: "training", 80: "training",
        91: "validation", 100: "validation", 111: "tuning", 114: "tuning",
    }  # fmt: skip


@pytest.mark.parametrize("network", ["neighbours_int8", "detector"])
def test_what_either_first_stage_proposes_in_a_folder_of_pictures_is_mined(
    network: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A picture with a drone stands for one where something is proposed; a file beside the folders is none."""
    (tmp_path / "photographs" / "some").mkdir(parents=True)
    (tmp_path / "photographs" / "index.jsonl").write_text("")
    shutil.copy(RENDERED / "2.5_m_0.jpg", tmp_path / "photographs" / "some")
    model = data_path("models") / f"{network}.yaml"
    arguments = [tmp_path / "mined", "--crops", tmp_path / "photographs", "--model", model]
    monkeypatch.setattr(sys, "argv", ["mine_pictures", *map(str, arguments)])
    mine_pictures.main()
    assert [path.name for path in (tmp_path / "mined").iterdir()] == ["some.npz"]
    with np.load(tmp_path / "mined" / "some.npz") as mined:
        assert len(mined["negative"]) >= 1
        assert len(mined["place"]) == mine_pictures.PLACES
        assert len(mined["drone"]) == 0
        left, top, right, bottom = mined["negative_box"][0]
    # Aimed at what was proposed: its box is around the middle of the patch.
    assert left < PATCH_PX / 2 < right
    assert top < PATCH_PX / 2 < bottom
