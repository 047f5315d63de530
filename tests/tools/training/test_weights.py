"""Going on with a network of which only the ONNX file is left. Needs the extra `train`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from flockd.core.data import data_path
from tools.training.detector.network import Boxes, DroneDetector
from tools.training.networks import DistanceNet, FlowNet, NeighboursNet, VerificationNet
from tools.training.weights import begin_with_onnx

MODELS = data_path("models")
Feeds = dict[str, NDArray[Any]]


def picture_of_nothing(*shape: int) -> NDArray[np.uint8]:
    return np.random.default_rng(1).integers(0, 255, shape, dtype=np.uint8)


def flow_as_exported() -> FlowNet:
    return FlowNet(iterations=1)


NETWORKS: dict[str, tuple[Callable[[], nn.Module], Feeds]] = {
    "distance": (DistanceNet, {"picture": picture_of_nothing(8, 96, 96, 3)}),
    "verification": (VerificationNet, {"crop": picture_of_nothing(8, 96, 96, 3)}),
    "neighbours": (
        NeighboursNet,
        {
            "image": picture_of_nothing(1, 96, 128, 3),
            "geometry": np.random.default_rng(2).uniform(-0.3, 0.3, (1, 3, 48, 64)).astype(np.float32),
        },
    ),
    "flow": (
        flow_as_exported,
        {"first": picture_of_nothing(1, 64, 96, 3), "second": picture_of_nothing(1, 64, 96, 3)[:, :, ::-1].copy()},
    ),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_a_shipped_network_says_the_same_in_torch_as_its_file_does(name: str) -> None:
    made, feeds = NETWORKS[name]
    net, tensors = made(), [torch.from_numpy(values) for values in feeds.values()]
    begin_with_onnx(net, MODELS / f"{name}.onnx", lambda: net(*tensors))
    net.eval()
    with torch.no_grad():
        ours = net(*tensors)
    theirs = ort.InferenceSession(str(MODELS / f"{name}.onnx")).run(None, feeds)
    for our, their in zip(ours if isinstance(ours, tuple) else (ours,), theirs, strict=True):
        assert np.abs(our.numpy() - their).max() < 1e-3 * np.abs(their).max()


def test_a_detector_goes_on_from_the_shipped_one() -> None:
    image, net = picture_of_nothing(1, 64, 64, 3), Boxes()
    given = torch.from_numpy(image)
    begin_with_onnx(net.detector, MODELS / "detector.onnx", lambda: net(given))
    with torch.no_grad():
        ours = net.eval()(given).numpy()
    (theirs,) = ort.InferenceSession(str(MODELS / "detector.onnx")).run(None, {"image": image})
    assert np.abs(ours - theirs).max() < 1e-3 * np.abs(theirs).max()
    with pytest.raises(ValueError, match=r"flow\.onnx: its .* is not DroneDetector's"):
        begin_with_onnx(DroneDetector(), MODELS / "flow.onnx", lambda: None)


def test_it_says_so_in_training_too_of_what_its_normalisations_were_settled_on() -> None:
    feeds = NETWORKS["distance"][1]
    net, picture = DistanceNet(), torch.from_numpy(feeds["picture"])
    begin_with_onnx(net, MODELS / "distance.onnx", lambda: net(picture))
    with torch.no_grad():
        trained = net.train()(picture)[0]
        ran = net.eval()(picture)[0]
    assert (trained - ran).abs().max() < 0.05, "the borders are another grey by half a level"
    (momentum,) = {layer.momentum for layer in net.modules() if isinstance(layer, nn.BatchNorm2d)}
    assert momentum == nn.BatchNorm2d(1).momentum, "and go on learning"


def test_the_file_of_another_network_is_refused() -> None:
    net = DistanceNet()
    with pytest.raises(ValueError, match=r"neighbours\.onnx: its context\.0\.weight is not DistanceNet's"):
        begin_with_onnx(net, Path(MODELS / "neighbours.onnx"), lambda: None)
