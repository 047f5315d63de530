"""The network that verifies drones, and the weights that it begins with. Needs the extra `train`."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F

from tools.training.verification_net import VerificationNet, weights_of_efficientnet


def of_efficientnet() -> dict[str, torch.Tensor]:
    """Weights under the names of the package, of the same shapes; the values are drawn."""
    generator = torch.Generator().manual_seed(3)
    names = {"stem.0": "_conv_stem", "stem.1": "_bn0"}
    weights = {}
    for name, value in VerificationNet().state_dict().items():
        layer, _, kind = name.rpartition(".")
        parts = layer.split(".")
        if parts[0] in ("fixed", "blocks"):
            number = int(parts[1]) + (3 if parts[0] == "blocks" else 0)
            of = {
                "expand": ("_expand_conv", "_bn0"),
                "each": ("_depthwise_conv", "_bn1"),
                "project": ("_project_conv", "_bn2"),
            }
            theirs = f"_blocks.{number}.{of[parts[2]][int(parts[3])]}"
        elif layer in names:
            theirs = names[layer]
        else:
            continue
        drawn = torch.rand(value.shape, generator=generator) if value.is_floating_point() else value
        weights[f"{theirs}.{kind}"] = drawn
    return weights | {"_conv_head.weight": torch.zeros(1280, 320, 1, 1)}


def test_the_first_layer_says_what_it_says_with_the_padding_that_its_weights_were_learnt_with() -> None:
    weights = of_efficientnet()
    net = VerificationNet()
    net.load_state_dict(weights_of_efficientnet(weights), strict=False)
    crop = torch.randint(0, 255, (2, 96, 96, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(4))
    image = (crop.permute(0, 3, 1, 2).float() - 128) / 128
    padded = F.pad(image, (0, 1, 0, 1))  # TensorFlow's SAME padding of a 3 x 3 kernel with stride 2 on an even size
    expected = F.conv2d(padded, weights["_conv_stem.weight"], stride=2)
    of_net = net.stem[0](image.flip(2, 3)).flip(2, 3)
    assert torch.allclose(of_net, expected, atol=1e-4)


def test_it_says_the_same_when_it_runs_as_when_it_trains_in_its_fixed_layers() -> None:
    net = VerificationNet()
    net.load_state_dict(weights_of_efficientnet(of_efficientnet()), strict=False)
    grey = torch.randint(-128, 128, (1, 3, 96, 96), generator=torch.Generator().manual_seed(5)).float()
    net.train()
    assert not net.stem.training
    with torch.no_grad():
        assert torch.allclose(net.stem(grey / 128), net._stem_on_grey(grey), rtol=1e-3, atol=1e-3)


def test_weights_of_something_else_are_refused() -> None:
    weights = of_efficientnet()
    del weights["_blocks.4._project_conv.weight"]
    with pytest.raises(ValueError, match=r"no blocks\.1\.project\.0\.weight of shape .* EfficientNet-Lite0"):
        weights_of_efficientnet(weights)
