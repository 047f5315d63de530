"""A network with its weights in 16 bits: half the file, the same outputs, and a manifest that it is checked against."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from flockd.flight.inference import OnnxModel
from flockd.flight.inference.feeds import golden_feeds
from tools.training.halve import halve

MODELS = Path(__file__).parents[3] / "models"


def test_a_halved_network_is_half_as_large_and_says_the_same(tmp_path: Path) -> None:
    for suffix in (".yaml", ".onnx"):
        shutil.copy(MODELS / f"flow{suffix}", tmp_path)
    before = OnnxModel(MODELS / "flow.yaml", threads=1)
    changes = halve(tmp_path / "flow.yaml")
    after = OnnxModel(tmp_path / "flow.yaml", threads=1)
    sizes = [(folder / "flow.onnx").stat().st_size for folder in (tmp_path, MODELS)]
    assert 0.45 < sizes[0] / sizes[1] < 0.6
    assert after.manifest.command.endswith("tools.training.halve")
    assert any("16" in what or "32-bit" in what for what in after.manifest.accuracy)
    feeds = golden_feeds(before.manifest)
    was, now = (model.run(feeds)["flow"] for model in (before, after))
    assert np.abs(now - was).mean() < 0.01 * was.std()
    assert 0.0 < changes["flow"] < 0.01
