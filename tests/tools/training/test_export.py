"""What export does to weights. Needs the extra `train`."""

from __future__ import annotations

import pytest
import torch

from flockd.core.data import data_path
from flockd.flight.inference import load_manifest
from tools.training.export import NETWORKS, draw_back


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_that_is_exported_again_is_judged_as_the_shipped_one(name: str) -> None:
    manifest, _ = load_manifest(data_path("models") / f"{name}.yaml")
    assert manifest.thresholds == NETWORKS[name].get("thresholds", {})


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
