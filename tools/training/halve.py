"""Store a network's weights as 16-bit floats: half the file. They are 32-bit floats again once it is loaded.

python -m tools.training.halve models/distance.yaml
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

from flockd.flight.inference import load_manifest
from flockd.flight.inference.feeds import golden_feeds
from tools.training.manifests import write_manifest

AT_MOST = 0.01
"""Mean difference of an output for the golden input, in its standard deviations, beyond which it is refused."""
HALVED = "_16"
"""Ends the names of weights that are stored so."""
_SMALL = 64
"""Weights of fewer numbers, as a layer's offsets, stay as they are."""


def main() -> None:
    """Halve one network in its place."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("manifest", type=Path)
    arguments = parser.parse_args()
    for output, difference in halve(arguments.manifest).items():
        print(f"{output}: mean difference {difference:.4f} deviations")


def halve(path: Path) -> dict[str, float]:
    """Rewrites the model file and its manifest; how much each output changes. Raises SystemExit where one does much."""
    manifest, file = load_manifest(path)
    feeds, model = golden_feeds(manifest), onnx.load(file)
    before = ort.InferenceSession(str(file)).run(list(manifest.outputs), feeds)
    casts = []
    for weights in model.graph.initializer:
        numbers = numpy_helper.to_array(weights)
        if weights.data_type == TensorProto.FLOAT and numbers.size >= _SMALL:
            name = weights.name
            weights.CopyFrom(numpy_helper.from_array(numbers.astype(np.float16), f"{name}{HALVED}"))
            casts.append(helper.make_node("Cast", [f"{name}{HALVED}"], [name], name=f"{name}_32", to=TensorProto.FLOAT))
    for place, node in enumerate(casts):
        model.graph.node.insert(place, node)
    halved = model.SerializeToString()
    after = ort.InferenceSession(halved).run(list(manifest.outputs), feeds)
    changes = {
        name: float(np.abs(now - was).mean() / was.std())
        for name, was, now in zip(manifest.outputs, before, after, strict=True)
    }
    if max(changes.values()) > AT_MOST:
        raise SystemExit(f"{file}: an output changes by more than {AT_MOST:g} deviations: {changes}")
    file.write_bytes(halved)
    outputs = dict(zip(manifest.outputs, after, strict=True))
    document = manifest.model_dump(mode="json", exclude_defaults=True)
    document["command"] += ", tools.training.halve"
    document["accuracy"] |= {
        f"{name}, mean difference from 32-bit weights": f"{change:.4f} deviations" for name, change in changes.items()
    }
    write_manifest(document, file, outputs)
    return changes


if __name__ == "__main__":
    main()
