"""Drawing from pictures of drones that are rendered while training goes on. Needs the extra `train`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tools.training.crop_files import CropFiles


def _write(file: Path, family: NDArray[Any], **arrays: NDArray[Any]) -> None:
    """``arrays`` in the place of drones without any apparent size, target or mask."""
    zeros = np.zeros(len(family))
    plain = {"drone": zeros + 1.0, "apparent": zeros, "target": np.zeros((len(family), 3))}
    np.savez(file, family=family, mask=np.zeros((len(family), 1, 1)), allow_pickle=False, **{**plain, **arrays})


def test_a_family_of_few_images_is_drawn_as_often_as_one_of_many(tmp_path: Path) -> None:
    for name, families, drones in (("a", [0] * 90 + [1] * 5, 1.0), ("b", [0] * 5, 0.0), ("c", [1], 1.0)):
        values, shown = np.arange(len(families), dtype=np.float32), np.full(len(families), drones)
        _write(tmp_path / f"{name}.npz", np.array(families), apparent=values, drone=shown)
    files, rng = CropFiles(tmp_path), np.random.default_rng(0)
    drawn = [files.draw(rng) for _ in range(3000)]
    shares = [
        np.mean([sample["drone"] > 0.5 and sample["family"] == 0 for sample in drawn]),
        np.mean([sample["drone"] > 0.5 and sample["family"] == 1 for sample in drawn]),
        np.mean([sample["drone"] < 0.5 for sample in drawn]),
    ]
    assert shares == pytest.approx([0.46, 0.46, 0.08], abs=0.04)
    lonely = [sample for sample in drawn if sample["family"] == 1 and sample["drone"] > 0.5]
    assert {float(sample["apparent"]) for sample in lonely} == {0.0} | {float(n) for n in range(90, 95)}


def test_hundreds_of_shapes_do_not_crowd_out_the_families(tmp_path: Path) -> None:
    family = np.concatenate([np.arange(12), 1000 + np.arange(400)])
    _write(tmp_path / "a.npz", family)
    files, rng = CropFiles(tmp_path), np.random.default_rng(0)
    drawn = np.array([files.draw(rng)["family"] for _ in range(3000)])
    assert np.mean(drawn < 12) == pytest.approx(0.5, abs=0.04)
    assert np.bincount(drawn[drawn < 12], minlength=12).min() > 0.5 * 1500 / 12
    assert len(np.unique(drawn[drawn >= 1000])) > 350


def test_where_there_are_only_shapes_nothing_else_is_drawn(tmp_path: Path) -> None:
    _write(tmp_path / "a.npz", 1000 + np.arange(3))
    files, rng = CropFiles(tmp_path), np.random.default_rng(0)
    assert {int(files.draw(rng)["family"]) for _ in range(300)} == {1000, 1001, 1002}


def test_images_like_the_last_crop_of_a_drone_are_drawn_more_often_than_others(tmp_path: Path) -> None:
    target = np.zeros((100, 3))
    target[:80, 1], target[80:90, 2] = 20.0, -9.0
    values = np.full(100, np.log(70.0))
    values[90] = np.log(120.0)
    _write(tmp_path / "a.npz", np.zeros(100), apparent=values, target=target)
    files, rng = CropFiles(tmp_path), np.random.default_rng(0)
    drawn = [files.draw(rng) for _ in range(3000)]
    like_it = [np.abs(sample["target"]).max() == 0.0 and sample["apparent"] < np.log(100.0) for sample in drawn]
    assert np.mean(like_it) == pytest.approx(0.6 + 0.4 * 0.09, abs=0.03)


def test_a_folder_without_images_says_how_to_make_them(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"make them with `python -m tools\.training\.render_drone_crops`"):
        CropFiles(tmp_path)
