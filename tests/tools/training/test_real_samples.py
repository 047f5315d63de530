"""Crops of real pictures, and drones in front of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tools.training.real_patches import PATCH_PX, RealPatches, crop_of_drone, crop_of_negative
from tools.training.real_samples import composite, matte, negative, real_drone, sharp, softened, visibility

SKY, DRONE = (150, 180, 220), (40, 45, 50)


def patches(folder: Path, kind: str, images: NDArray[np.uint8], half_px: float, box: tuple[float, ...]) -> RealPatches:
    arrays: dict[str, NDArray[np.generic]] = {}
    for one in ("negative", "place", "drone"):
        mine = images if one == kind else images[:0]
        arrays[one] = mine
        arrays[f"{one}_half_px"] = np.full(len(mine), half_px, np.float32)
        arrays[f"{one}_box"] = np.tile(np.array(box, np.float32), (len(mine), 1))
    np.savez(folder / f"{kind}.npz", allow_pickle=False, **arrays)
    return RealPatches(folder, kind)


def sky_with_a_drone() -> NDArray[np.uint8]:
    """60 x 24 pixels of it in the middle of a patch."""
    image = np.full((PATCH_PX, PATCH_PX, 3), SKY, np.uint8)
    image[68:92, 50:110] = DRONE
    return image


def rendered(grey: int = 40) -> dict[str, NDArray[np.generic]]:
    picture = np.full((96, 96, 3), 200, np.uint8)
    mask = np.zeros((96, 96), np.uint8)
    picture[36:60, 14:82], mask[36:60, 14:82] = grey, 255
    return {
        "picture": picture, "mask": mask, "target": np.array([-3.0, 0.0, 0.0], np.float32),
        "motors": np.zeros((4, 2), np.float32), "family": np.array(3), "apparent": np.array(np.log(68.0), np.float32),
        "drone": np.array(1.0, np.float32),
    }  # fmt: skip


def test_a_drones_box_stays_on_it_wherever_the_crop_is_aimed() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        crop, box, camera_px = crop_of_drone(sky_with_a_drone(), 12.0, np.array([50, 68, 110, 92], np.float32), rng)
        dark = np.argwhere(crop[:, :, 0] < 95)
        left, top, right, bottom = box
        if left > 0 and right < 96:
            assert np.allclose([dark[:, 1].min(), dark[:, 1].max() + 1], [left, right], atol=1.0)
        assert np.allclose([dark[:, 0].min(), dark[:, 0].max() + 1], [top, bottom], atol=1.0)
        # The patch's half is 1.75 times 12 camera pixels, so the drone's 60 patch pixels are 15.75 of the camera.
        assert (right - left) * camera_px == pytest.approx(15.75, rel=0.01)


def test_a_negatives_crop_knows_how_large_the_cameras_pixels_are_in_it() -> None:
    u = np.tile(np.arange(PATCH_PX, dtype=np.uint8), (PATCH_PX, 1))
    rng = np.random.default_rng(0)
    for _ in range(20):
        crop, camera_px = crop_of_negative(np.repeat(u[:, :, None], 3, 2), 10.0, rng)
        patch_px_per_crop_px = (float(crop[48, 80, 0]) - float(crop[48, 16, 0])) / 64
        if crop[48, 16, 0] > 2 and crop[48, 80, 0] < PATCH_PX - 3:  # not at the reflected border
            assert camera_px == pytest.approx(patch_px_per_crop_px * 1.75 * 10.0 / (PATCH_PX / 2), rel=0.08)


def test_a_drone_is_cut_out_of_the_sky() -> None:
    image = np.full((96, 96, 3), SKY, np.uint8)
    image[40:56, 20:76] = DRONE
    share = matte(image, np.array([20, 40, 76, 56], np.float32))
    assert share[40:56, 20:76].min() == 1.0
    assert share.sum() == 16 * 56


def test_what_cannot_be_seen_hardly_counts() -> None:
    sample = rendered()
    assert visibility(sample["picture"].astype(np.uint8), sample["mask"].astype(np.uint8), 0.3) == 1.0
    hidden = rendered(grey=199)
    assert visibility(hidden["picture"].astype(np.uint8), hidden["mask"].astype(np.uint8), 0.3) < 0.15
    assert float(softened(hidden, np.random.default_rng(0))["exists_weight"]) < 0.3
    assert float(sharp(hidden)["exists_weight"]) == 1.0


def test_a_composite_shows_the_real_background_and_keeps_the_truth(tmp_path: Path) -> None:
    green = np.full((3, PATCH_PX, PATCH_PX, 3), (30, 160, 30), np.uint8)
    places = patches(tmp_path, "place", green, 60.0, (40, 40, 120, 120))
    sample = composite(rendered(), places, np.random.default_rng(2))
    corner = sample["picture"][:16, :16].reshape(-1, 3).mean(0)
    assert corner[1] > 1.5 * max(corner[0], corner[2])  # grass, not the rendered grey
    assert sample["drone"] == 1.0


def test_every_kind_of_sample_has_the_same_parts(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (3, PATCH_PX, PATCH_PX, 3), dtype=np.uint8)
    places = patches(tmp_path, "place", images, 60.0, (40, 40, 120, 120))
    drones = patches(tmp_path, "drone", sky_with_a_drone()[None], 20.0, (50, 68, 110, 92))
    of_real = real_drone(drones, rng)
    assert of_real["drone"] == 1.0
    none = negative(*places.draw(rng)[:2], rng)
    assert none["drone"] == 0.0
    kinds = [sharp(rendered()), softened(rendered(), rng), composite(rendered(), places, rng), of_real, none]
    kinds.append(real_drone(drones, rng, backgrounds=places))
    shapes = [{name: value.shape for name, value in kind.items()} for kind in kinds]
    assert all(one == shapes[0] for one in shapes)
