"""Drawing from pictures of drones that are rendered while training goes on. Needs the extra `train`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="the extra `train` is not installed")

from tools.training.pictures import PictureFiles


def test_a_family_of_few_pictures_is_drawn_as_often_as_one_of_many(tmp_path: Path) -> None:
    for name, families, drones in (("a", [0] * 90 + [1] * 5, 1.0), ("b", [0] * 5, 0.0), ("c", [1], 1.0)):
        values = np.arange(len(families), dtype=np.float32)
        np.savez(tmp_path / f"{name}.npz", family=families, drone=np.full(len(families), drones), apparent=values)
    files, rng = PictureFiles(tmp_path), np.random.default_rng(0)
    drawn = [files.draw(rng) for _ in range(3000)]
    shares = [
        np.mean([sample["drone"] > 0.5 and sample["family"] == 0 for sample in drawn]),
        np.mean([sample["drone"] > 0.5 and sample["family"] == 1 for sample in drawn]),
        np.mean([sample["drone"] < 0.5 for sample in drawn]),
    ]
    assert shares == pytest.approx([1 / 3] * 3, abs=0.04)
    lonely = [sample for sample in drawn if sample["family"] == 1 and sample["drone"] > 0.5]
    assert {float(sample["apparent"]) for sample in lonely} == {0.0} | {float(n) for n in range(90, 95)}


def test_a_folder_without_pictures_says_how_to_make_them(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"make them with tools/render_drone_pictures\.py"):
        PictureFiles(tmp_path)
