"""Export a trained network to ONNX, check it against torch, and write its manifest, which is the shipped one's.

    python -m tools.training.export neighbours --checkpoint RUNS/neighbours/checkpoint.pt --out models_of_mine --half

Crops, thresholds, meanings and data are those of models/NETWORK.yaml. The flow is exported with one iteration: it
trains with three, and DIS does the rest better.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from flockd.core.data import data_path
from flockd.flight.inference import load_manifest
from flockd.flight.inference.feeds import golden_feeds
from flockd.flight.inference.manifest import Manifest
from flockd.ground.manifest_writer import write_manifest
from tools.training.detector import Boxes
from tools.training.networks import DistanceNet, FlowNet, NeighboursNet, VerificationNet
from tools.training.weights import HALVED

Arrays = dict[str, NDArray[Any]]
NETWORKS: dict[str, Callable[[], nn.Module]] = {
    "neighbours": NeighboursNet, "distance": DistanceNet, "verification": VerificationNet, "detector": Boxes,
    "flow": lambda: FlowNet(iterations=1),
}  # fmt: skip
ALLOWED_DIFFERENCE = 2e-3
"""Between ONNX Runtime and torch, as a share of the output's largest value."""
HALF_AT_MOST = 0.01
"""Mean difference of an output in its standard deviations, beyond which weights of 16 bits are refused."""
_SMALL = 64
"""Arrays with fewer numbers, such as biases, keep 32 bits."""
BEGUN_WITH_SHARE = 0.35


def main() -> None:
    """Export one network."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", choices=NETWORKS)
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--half", action="store_true", help="store weights in 16 bits: half the file")
    with_its_start = "the run's start.pt: the mean of both weights is exported"
    parser.add_argument("--begun-with", type=Path, metavar="CHECKPOINT", help=with_its_start)
    parser.add_argument("--share", type=float, default=BEGUN_WITH_SHARE, help="of --begun-with in that mean")
    arguments = parser.parse_args()
    net = NETWORKS[arguments.network]()
    state = torch.load(arguments.checkpoint, map_location="cpu")
    trained = net.detector if isinstance(net, Boxes) else net
    trained.load_state_dict(state["net"])
    if arguments.begun_with:
        draw_back(trained, torch.load(arguments.begun_with, map_location="cpu")["net"], arguments.share)
    like, _ = load_manifest(data_path("models") / f"{arguments.network}.yaml")
    document = like.model_dump(mode="json", exclude_defaults=True) | {
        "name": arguments.network,
        "accuracy": {},
        "command": f"tools.training.train {arguments.network} ({state['spent'] / 60:.0f} minutes, {state['step']} "
        f"steps), tools.training.export{' --half' * arguments.half}",
    }
    path = export(net, document, arguments.out, half=arguments.half)
    print(f"{path}: {path.with_suffix('.onnx').stat().st_size / 1e6:.1f} MB, {state['step']} steps, checked")


def export(net: nn.Module, document: dict[str, Any], out: Path, *, half: bool = False) -> Path:
    """Write the network and its manifest into ``out``; the manifest's path. ``half``: its weights have 16 bits.

    Raises SystemExit where ONNX Runtime's outputs are not torch's, or 16 bits change them.
    """
    net.eval()
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{document['name']}.onnx"
    document = copy.deepcopy(document) | {"file": file.name}
    manifest = Manifest.model_validate(document, strict=False)
    feeds = golden_feeds(manifest)
    _write_onnx(net, manifest, feeds, file)
    outputs = _compare(net, feeds, file)
    if half:
        before, outputs = outputs, halve(file, feeds)
        for name, was in before.items():
            change = float(np.abs(outputs[name] - was).mean() / was.std())
            if change > HALF_AT_MOST:
                raise SystemExit(f"{file}: in 16 bits {name} changes by {change:.3f} deviations; leave --half out")
            document["accuracy"][f"{name}, mean difference from 32-bit weights"] = f"{change:.4f} deviations"
    return write_manifest(document, file, outputs)


def draw_back(net: nn.Module, start: dict[str, Tensor], share: float = BEGUN_WITH_SHARE) -> None:
    """Weights between a run's end and its start err less than either (WiSE-FT, Wortsman et al. 2022).

    Layers that the start did not have stay as they are.
    """
    weights = net.state_dict()
    for name, old in start.items():
        if name not in weights or weights[name].shape != old.shape:
            raise SystemExit(f"--begun-with: its {name} is not the run's; give what the run was started with")
        if old.is_floating_point():
            weights[name] = torch.lerp(weights[name], old, share)
    net.load_state_dict(weights)


def halve(file: Path, feeds: Arrays) -> Arrays:
    """Store a model's weights as 16-bit floats, which it casts to 32 bits when it runs; its outputs then."""
    model, casts = onnx.load(file), []
    for weights in model.graph.initializer:
        numbers = numpy_helper.to_array(weights)
        if weights.data_type == TensorProto.FLOAT and numbers.size >= _SMALL:
            name = weights.name
            weights.CopyFrom(numpy_helper.from_array(numbers.astype(np.float16), f"{name}{HALVED}"))
            casts.append(helper.make_node("Cast", [f"{name}{HALVED}"], [name], name=f"{name}_32", to=TensorProto.FLOAT))
    for place, node in enumerate(casts):
        model.graph.node.insert(place, node)
    file.write_bytes(model.SerializeToString())
    return _run(file, feeds)


def _write_onnx(net: nn.Module, manifest: Manifest, feeds: Arrays, file: Path) -> None:
    outputs = list(manifest.outputs)
    free = {0: "n"} if "crop" in manifest.contents else None
    axes = {n: free or ({1: "h", 2: "w"} if v.dtype == np.uint8 else {2: "h2", 3: "w2"}) for n, v in feeds.items()}
    axes |= {name: free or {2: "ho", 3: "wo"} for name in outputs}
    axes |= {name: {0: "cells"} for name in outputs if name == "boxes"}
    torch.onnx.export(
        net, tuple(torch.from_numpy(v) for v in feeds.values()), str(file), input_names=list(feeds),
        output_names=outputs, opset_version=17, dynamo=False, dynamic_axes=axes,
    )  # fmt: skip


def _run(file: Path, feeds: Arrays) -> Arrays:
    session = ort.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(names, feeds), strict=True))


def _compare(net: nn.Module, feeds: Arrays, file: Path) -> Arrays:
    """ONNX Runtime's outputs, after checking them against torch's."""
    ours = _run(file, feeds)
    with torch.no_grad():
        theirs = net(*(torch.from_numpy(v) for v in feeds.values()))
    for (name, our), their in zip(ours.items(), theirs if isinstance(theirs, tuple) else (theirs,), strict=True):
        difference = float(np.abs(our - their.numpy()).max()) / (float(np.abs(our).max()) + 1e-9)
        if difference > ALLOWED_DIFFERENCE:
            raise SystemExit(f"{file}: output {name} differs from torch by {difference:.1e} of its largest value")
    return ours


if __name__ == "__main__":
    main()
