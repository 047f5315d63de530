"""What export does to weights and manifests. Needs the extra `train`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from flockd.core.data import data_path
from flockd.flight.inference import OnnxModel, load_manifest
from tools.training.export import draw_back, export
from tools.training.networks import FlowNet


def test_a_network_is_exported_as_the_shipped_one_is_used_and_in_16_bits_says_the_same(tmp_path: Path) -> None:
    torch.manual_seed(0)
    shipped, _ = load_manifest(data_path("models") / "flow.yaml")
    document = shipped.model_dump(mode="json", exclude_defaults=True)
    net = FlowNet(iterations=1)
    whole, half = (OnnxModel(export(net, document, tmp_path / str(k), half=k == 1), threads=1) for k in (0, 1))
    for model in (whole, half):
        assert model.manifest.thresholds == shipped.thresholds
        assert model.manifest.image_scale == shipped.image_scale
        assert model.manifest.sha256 != shipped.sha256
    sizes = [(tmp_path / folder / "flow.onnx").stat().st_size for folder in ("1", "0")]
    assert 0.45 < sizes[0] / sizes[1] < 0.6
    assert "flow, mean difference from 32-bit weights" in half.manifest.accuracy.keys() - whole.manifest.accuracy.keys()
    images = np.random.default_rng(0).integers(0, 255, (2, 1, 64, 64, 3), dtype=np.uint8)
    was, now = (model.run(dict(zip(("first", "second"), images, strict=True)))["flow"] for model in (whole, half))
    assert 0.0 < np.abs(now - was).mean() < 0.01 * was.std()


def test_weights_are_drawn_back_a_third_of_the_way_to_what_the_run_began_with() -> None:
    net = torch.nn.Sequential(torch.nn.Linear(2, 1), torch.nn.Linear(1, 1))
    torch.nn.init.constant_(net[0].weight, 1.0)
    torch.nn.init.constant_(net[1].weight, 7.0)
    draw_back(net, {"0.weight": torch.tensor([[3.0, 0.0]])})
    assert net[0].weight.tolist() == [pytest.approx([1.7, 0.65])]
    assert net[1].weight.item() == 7.0, "a layer that the start did not have"


def test_a_run_that_this_one_cannot_have_begun_with_is_refused() -> None:
    with pytest.raises(SystemExit, match=r"--begun-with: its 0\.weight is not the run's"):
        draw_back(torch.nn.Sequential(torch.nn.Linear(2, 1)), {"0.weight": torch.zeros(1, 3)})
