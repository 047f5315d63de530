"""What must hold of the networks' arithmetic while they are trained. Needs the extra `train`."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tools.training.networks import DistanceNet


def test_training_on_16_bit_numbers_reads_the_motors_places_to_a_fraction_of_a_pixel() -> None:
    maps = torch.full((1, DistanceNet.maps, 48, 48), -60.0)
    across = []
    for motor, column in enumerate((8, 19, 30, 39)):
        maps[0, motor, 24, column], maps[0, motor, 24, column + 1] = 0.0, np.log(9.0)
        across.append(2 * column + 1 - 48 + 0.9 * 2)
    net = DistanceNet().train()
    net.look.register_forward_hook(lambda _layer, _given, _answer: maps.expand(2, -1, -1, -1))
    net.head.weight.data.zero_()
    net.head.bias.data.zero_()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        apparent = net(torch.zeros(2, 96, 96, 3, dtype=torch.uint8))[0][:, 5]
    assert apparent.tolist() == pytest.approx([np.log(np.std(across)) + 1.0] * 2, abs=1e-4)
