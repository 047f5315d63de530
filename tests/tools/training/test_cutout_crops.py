"""Cut-outs as crops of the second stage: what is shown agrees with what is said of it. Needs the extra `train`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tools.training.cutout_crops import CutoutCrops
from tools.training.real_patches import CROP_PX

SIZE_M, RANGE_M, FOCAL_PX = 0.5, 4.0, 1600.0
"""A level drone that is 200 px wide then."""


def folder_of(folder: Path, **said: Any) -> Path:
    """One cut-out: a red plate of 200 x 60 pixels whose middle is beside the picture's."""
    image = np.zeros((320, 320, 4), np.uint8)
    image[140:200, 70:270] = (0, 0, 255, 255)
    assert cv2.imwrite(str(folder / "one.png"), image)
    entry = {
        "file": "one.png", "name": "Plate", "kind": "real", "size_m": SIZE_M, "range_m": RANGE_M,
        "focal_px": FOCAL_PX, "middle_px": [170.0, 170.0], "held_out": False, "kept": True,
    }  # fmt: skip
    (folder / "index.jsonl").write_text(json.dumps(entry | said) + "\n")
    return folder


def test_the_drone_is_as_large_as_is_said_and_where_a_crop_may_be_aimed(tmp_path: Path) -> None:
    crops, rng = CutoutCrops([folder_of(tmp_path)]), np.random.default_rng(0)
    places = []
    for _ in range(200):
        sample = crops.draw(rng)
        mask = sample["mask"] > 127
        rows, columns = np.nonzero(mask)
        if min(columns.min(), rows.min()) == 0 or max(columns.max(), rows.max()) == 95:
            continue
        # The variance of a bar along itself is its length squared over 12, however it is rolled.
        length = np.sqrt(12 * np.linalg.eigvalsh(np.cov(np.stack([columns, rows])))[-1])
        assert length == pytest.approx(np.exp(sample["apparent"]), abs=1.5)
        places.append([columns.mean() + 0.5, rows.mean() + 0.5])
        assert sample["picture"][mask].mean(0) == pytest.approx([255, 0, 0], abs=3)
    # The middle is aimed at, half of the time within 3 % of the crop's half width, else within 15 %.
    assert np.mean(places, axis=0) == pytest.approx([CROP_PX / 2, CROP_PX / 2], abs=1.5)
    assert np.std(places, axis=0) == pytest.approx([0.108 * CROP_PX / 2] * 2, abs=1.5)


def test_a_held_out_airframe_is_never_learnt_from(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cut-outs of Plate, from which nothing may be learnt"):
        CutoutCrops([folder_of(tmp_path, held_out=True)])


def test_what_is_too_small_is_left_out_and_an_empty_folder_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no cut-outs here; make them with tools.training.render_cutouts"):
        CutoutCrops([folder_of(tmp_path, kept=False)])
