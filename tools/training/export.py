"""Export a trained network to ONNX, check it against torch, and write its manifest.

python -m tools.training.export neighbours --checkpoint RUNS/neighbours/checkpoint.pt --out models
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from flockd.flight.inference.feeds import golden_feeds
from flockd.flight.inference.manifest import Manifest
from tools.training.detector.network import CLASSES, Boxes
from tools.training.manifests import write_manifest
from tools.training.networks import DistanceNet, FlowNet, NeighboursNet, VerificationNet

ALLOWED_DIFFERENCE = 2e-3
"""Between ONNX Runtime and torch, as a share of the output's largest value."""
BEGUN_WITH_SHARE = 0.35
DATA = "Rendered by tools.training.render_training_data from seeded worlds; no foreign data."
_CLIPS = "Drone Detection and Classification using Machine Learning and Sensor Fusion"
_AIRFRAMES = (
    "drones rendered by tools.training.render_cutouts (its own shapes, and airframes of mrs_uav_gazebo_simulation, "
    "BSD-3-Clause, and of subt and rotors_simulator, Apache-2.0) before real photographs"
)
_SETS = (
    "BoofCV-Data@cc6d8adf (P. Abeles, CC BY 4.0; without what others made and without mvs and triple); "
    "DoorDetect-Dataset@1db107fe (part of Open Images, listed as CC BY 2.0); license-plate-dataset@f00f309e "
    "(R. L. Chiriac, MIT); robocup_ml@45430e3b (A. Poole, Apache-2.0); sample-videos@57978890 (Intel, CC BY 4.0); "
    "clothing-dataset@7ed86a9c (A. Grigorev, CC0 1.0); odm_data_caliterra@bec3dc72 (CC0 1.0); "
    "drone_dataset_brighton_beach@9506a9bf (P. Toffanin, BSD-2-Clause)"
)
_MORE_SETS = (
    "odm_data_seneca@9220acfd (CC0 1.0); CarND-LaneLines-P1@ce5681be and CarND-Advanced-Lane-Lines@91b08035 "
    "(Udacity, MIT); DeepForest@1bad4419, its pictures of NEON (B. Weinstein and others, MIT); "
    f"data set of {_CLIPS}, all clips but 31-40, 91-100 and from 111 (F. Svanstroem, CC0 1.0)"
)
REAL_DATA = (
    "Rendered by tools.training.render_drone_crops from seeded worlds. Real pictures, none of a held-out scene: "
    f"data set of {_CLIPS}, from 111 too (F. Svanstroem, CC0 1.0); HoloLens sample data of deep-video-mvs, first 73 "
    f"frames (A. Duzceker, MIT); {_SETS}; openimages-personcar@3b7ac13b and "
    "Machine-Learning-with-Apache-Spark-Quick-Start-Guide@d001ad4b (parts of Open Images, listed as CC BY 2.0). At "
    f"last also {_AIRFRAMES} of these sets and of {_MORE_SETS}. Begun with the encoder of `distance`."
)
DETECTOR_DATA = (
    f"Begun with YOLOX-nano as trained on COCO (Megvii, Apache-2.0). Then {_AIRFRAMES}, and worlds of "
    "tools.training.render_training_data. Real pictures, none of a held-out scene: the sets of `verification` "
    f"without robocup_ml's days of 2019 and 2023, and {_MORE_SETS}, where boxes that its labels lack were "
    "found by the detector before it, in frames in which it saw one thing only."
)
TRAINED_BY = {"verification": "tools.training.train_verification", "detector": "tools.training.train_detector"}
"""Where it is not tools.training.train."""

IMAGE = {"shape": [1, "h", "w", 3], "dtype": "uint8", "meaning": "RGB image", "unit": "grey levels 0-255"}
COLUMNS = {
    "range": (
        *("log_range_per_focal", "right_px", "down_px", "log_relative_sigma"),
        *("drone_logit", "log_apparent_size", "log_size_sigma"),
    ),
    "drone": ("drone_logit",),
    "boxes": (
        *("centre_right_px", "centre_down_px", "width_px", "height_px"),
        *(f"{name}_probability" for name in CLASSES),
    ),
}
"""Columns of an output (n, k), in the order in which the network writes them."""
NETWORKS: dict[str, dict[str, Any]] = {
    "neighbours": {
        "net": NeighboursNet,
        "roles": ["depth", "segmentation"],
        "description": "U-Net: metric depth, drone mask and centre offsets of one image",
        "size_multiple": 32,
        "map_stride": 2,
        "thresholds": {"proposal_logit": -1.5, "mask_logit": 0.4, "proposal_logit_alone": 0.0},
        "golden_size": [480, 640],
        "inputs": {
            "image": IMAGE,
            "geometry": {
                "shape": [1, 3, "h/2", "w/2"],
                "dtype": "float32",
                "meaning": "ray tangents right and down; inverse depth of flat ground, 0 where unknown",
                "unit": "1, 1, 1/m",
                "kind": "planes",
            },
        },
        "outputs": {
            "depth": ([1, 1, "h/2", "w/2"], "depth along the optical axis; 80 is sky", "m"),
            "drone": ([1, 1, "h/2", "w/2"], "logit of being on a drone", "1"),
            "offset": ([1, 2, "h/2", "w/2"], "from the pixel to its drone's centre, right and down", "output px"),
        },
    },
    "distance": {
        "net": DistanceNet,
        "roles": ["distance"],
        "description": "Range of the drone in the middle of a crop, its centre, the uncertainty, and its pixels",
        "size_multiple": 1,
        "golden_size": [96, 96],
        "crop": {
            "fill": 0.68,
            "first_margin": 0.95,
            "cut_margin": 1.4,
            "mirror_scale": 0.9,
            "min_half_width_px": 4.0,  # as `samples.py` draws them
            "max_half_angle_deg": 35.0,
            "max_resize": 1.7,
            "max_crops": 4,
        },
        "thresholds": {
            "drone_probability": 0.8,
            "expected_drone_probability": 0.7,
            "another_crop_probability": 0.2,
            "bearing_sigma_rad": 0.004,
            "min_relative_sigma": 0.005,
            "mean_sigma_factor": 0.98,
        },
        "inputs": {"picture": {**IMAGE, "shape": ["n", 96, 96, 3], "carries": "crop"}},
        "outputs": {
            "range": (
                ["n", 7],
                "log(range / focal length), centre right and down of the middle, log of the first's deviation for a "
                "drone of known size, logit of a drone being there, log(size * focal length / range), log of the "
                "deviation of log(size)",
                "log(m/px), px, px, 1, 1, log(px), 1",
            ),
            "mask": (["n", 96, 96], "logit of being this drone's", "1"),
        },
    },
    "verification": {
        "net": VerificationNet,
        "roles": ["verification"],
        "description": "Whether there is a drone in the middle of a crop",
        "data": REAL_DATA,
        "size_multiple": 1,
        "golden_size": [96, 96],
        "thresholds": {
            "drone_probability": 0.95,
            "expected_drone_probability": 0.8,
            "another_crop_probability": 0.2,
            "distance_logit_limit": 2.0,
        },
        "inputs": {"crop": {**IMAGE, "shape": ["n", 96, 96, 3]}},
        "outputs": {"drone": (["n", 1], "logit of a drone being there", "1")},
    },
    "detector": {
        "net": Boxes,
        "roles": ["detector"],
        "description": "YOLOX-nano: boxes of drones in one image, and of birds, airplanes and helicopters",
        "data": DETECTOR_DATA,
        "size_multiple": 32,
        "golden_size": [320, 256],
        "thresholds": {
            "box_probability": 0.05,
            "overlap": 0.5,
            "evidence_gain": 2.0,
            "large_box_evidence": 3.5,
            "small_box_evidence": 4.0,
            "no_box_evidence": -3.0,
            "distance_logit_limit": 1.0,
        },
        "inputs": {"image": IMAGE},
        "outputs": {
            "boxes": (
                ["cells", 4 + len(CLASSES)],
                "centre right and down, width, height, and probability of each class",
                "input px, input px, input px, input px, 1, 1, 1, 1",
            )
        },
    },
    "flow": {
        "net": FlowNet,
        "roles": ["flow"],
        "description": "Optical flow on small images: best match anywhere, then a recurrent refinement",
        "image_scale": 0.125,
        "least_side_px": 60,
        "size_multiple": 8,
        "golden_size": [120, 160],
        "inputs": {
            "first": {**IMAGE, "meaning": "earlier RGB image, made smaller"},
            "second": {**IMAGE, "meaning": "later RGB image, made smaller"},
        },
        "outputs": {"flow": ([1, 2, "h", "w"], "from first to second, right and down", "input px")},
    },
}


def main() -> None:
    """Export one network."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", choices=NETWORKS)
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--iterations",
        type=int,
        default=1,
        help="of the flow: it trains with 3, DIS does the rest better",
    )
    parser.add_argument(
        "--begun-with",
        type=Path,
        metavar="CHECKPOINT",
        help="what the run was started with, its start.pt: the mean of both weights is exported",
    )
    parser.add_argument("--share", type=float, default=BEGUN_WITH_SHARE, help="of --begun-with in that mean")
    parser.add_argument("--accuracy", action="append", default=[], metavar="WHAT=FIGURE", help="measured accuracy")
    arguments = parser.parse_args()
    net: nn.Module = NETWORKS[arguments.network]["net"]()
    if isinstance(net, FlowNet):
        net.iterations = arguments.iterations
    state = torch.load(arguments.checkpoint, map_location="cpu")
    (net.detector if isinstance(net, Boxes) else net).load_state_dict(state["net"])
    if arguments.begun_with:
        draw_back(net, torch.load(arguments.begun_with, map_location="cpu")["net"], arguments.share)
    trained_by = TRAINED_BY.get(arguments.network, f"tools.training.train {arguments.network}")
    path = export(
        arguments.network,
        net,
        arguments.out,
        accuracy=dict(a.split("=", 1) for a in arguments.accuracy),
        command=f"{trained_by} ({state['spent'] / 60:.0f} minutes, {state['step']} steps), tools.training.export",
    )
    print(f"{path}: {path.with_suffix('.onnx').stat().st_size / 1e6:.1f} MB, {state['step']} steps, checked")


def export(network: str, net: nn.Module, out: Path, **written: Any) -> Path:
    """Write ``network``.onnx into ``out`` and its manifest, whose path is returned; ``written`` goes into the manifest.

    Raises SystemExit where ONNX Runtime's outputs are not torch's.
    """
    spec = NETWORKS[network]
    net.eval()
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{network}.onnx"
    manifest = _manifest(network, spec, written)
    feeds = golden_feeds(manifest)
    _write_onnx(net, manifest, feeds, list(spec["outputs"]), file)
    outputs = _compare(net, feeds, file)
    return write_manifest(manifest.model_dump(mode="json", exclude_defaults=True), file, outputs)


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


def _manifest(name: str, spec: dict[str, Any], written: dict[str, Any]) -> Manifest:
    outputs = {
        key: {"shape": s, "dtype": "float32", "meaning": m, "unit": u, "golden_mean": 0.0, "golden_deviation": 0.0}
        for key, (s, m, u) in spec["outputs"].items()
    }
    for key, columns in COLUMNS.items():
        if key in outputs and len(outputs[key]["shape"]) == 2:
            outputs[key]["columns"] = list(columns)
    kept = {k: v for k, v in spec.items() if k not in ("net", "outputs", "data")}
    document = {
        "name": name,
        "file": f"{name}.onnx",
        "sha256": "0" * 64,
        "licence": "Apache-2.0",
        "data": spec.get("data", DATA),
        **kept,
        **written,
        "outputs": outputs,
    }
    return Manifest.model_validate(document, strict=False)


def _write_onnx(
    net: nn.Module, manifest: Manifest, feeds: dict[str, NDArray[Any]], outputs: list[str], file: Path
) -> None:
    free = {0: "n"} if "crop" in manifest.contents else None
    axes = {n: free or ({1: "h", 2: "w"} if v.dtype == np.uint8 else {2: "h2", 3: "w2"}) for n, v in feeds.items()}
    axes |= {name: free or {2: "ho", 3: "wo"} for name in outputs}
    axes |= {name: {0: "cells"} for name in outputs if name == "boxes"}
    torch.onnx.export(
        net, tuple(torch.from_numpy(v) for v in feeds.values()), str(file), input_names=list(feeds),
        output_names=outputs, opset_version=17, dynamo=False, dynamic_axes=axes,
    )  # fmt: skip


def _compare(net: nn.Module, feeds: dict[str, NDArray[Any]], file: Path) -> dict[str, NDArray[Any]]:
    """ONNX Runtime's outputs, after checking them against torch's."""
    session = ort.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    ours = dict(zip(names, session.run(names, feeds), strict=True))
    with torch.no_grad():
        theirs = net(*(torch.from_numpy(v) for v in feeds.values()))
    for name, their in zip(names, theirs if isinstance(theirs, tuple) else (theirs,), strict=True):
        difference = float(np.abs(ours[name] - their.numpy()).max()) / (float(np.abs(ours[name]).max()) + 1e-9)
        if difference > ALLOWED_DIFFERENCE:
            raise SystemExit(f"{file}: output {name} differs from torch by {difference:.1e} of its largest value")
    return ours


if __name__ == "__main__":
    main()
