"""Make the 8-bit version of a network: half the time on a CPU. Rendered images calibrate its ranges.

python -m tools.training.quantise models/neighbours.yaml --data DATA/training --out models
python -m tools.training.quantise models/distance.yaml --data DATA/crops --out models
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from flockd.flight.inference import Manifest, load_manifest
from flockd.flight.inference.feeds import golden_feeds
from flockd.flight.inference.fitting import fit
from flockd.ground.manifest_writer import write_manifest
from tools.training.dataset import HEIGHT, WIDTH, ground_plane, open_pairs, ray_tangents

Feeds = dict[str, NDArray[Any]]
IMAGES, COMPARED = 32, 16
WITHOUT_HEIGHT = 0.3
"""Share of the images without the ground in their geometry."""
IN_8_BITS = ("Conv", "Relu", "Resize")
KEPT = ("head", "look")
"""Layers with this in their names stay as they are: they write metres and places. So do sums, which in 8 bits cost ten
times the accuracy that all else together does."""
AT_MOST = 0.1
"""Mean difference from the float network, as a share of the output's standard deviation, beyond which it is refused."""


def main() -> None:
    """Quantise one network."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("manifest", type=Path, help="of the float network")
    parser.add_argument("--data", type=Path, required=True, help="of render_training_data or render_drone_crops")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    path, differences = quantise(arguments.manifest, arguments.data, arguments.out)
    size = path.with_suffix(".onnx").stat().st_size
    print(f"{path}: {size / 1e6:.1f} MB; mean differences in deviations: {differences}")


def quantise(float_manifest: Path, data: Path, out: Path) -> tuple[Path, dict[str, float]]:
    """Write the 8-bit twin into ``out``: its manifest, and each output's mean difference in standard deviations.

    Raises SystemExit where one differs too much.
    """
    manifest, file = load_manifest(float_manifest)
    draw = _crops if "crop" in manifest.contents else _images
    feeds = list(draw(manifest, data, IMAGES + COMPARED))
    name = f"{manifest.name}_int8"
    out.mkdir(parents=True, exist_ok=True)
    twin = out / f"{name}.onnx"
    _quantise(file, feeds[:IMAGES], twin)
    differences = _differences(file, twin, feeds[IMAGES:])
    accuracy = {
        f"{output}, mean difference from {manifest.name}": f"{d} deviations" for output, d in differences.items()
    }
    document = manifest.model_dump(mode="json", exclude_defaults=True)
    document |= {
        "name": name,
        "file": twin.name,
        "description": f"{manifest.description}; in 8-bit numbers",
        "providers": ["cpu", "openvino"],
        "accuracy": accuracy,
        "command": f"{manifest.command}, tools.training.quantise",
    }
    names = list(manifest.outputs)
    golden = ort.InferenceSession(str(twin), providers=["CPUExecutionProvider"]).run(names, golden_feeds(manifest))
    return write_manifest(document, twin, dict(zip(names, golden, strict=True))), differences


class _Reader(CalibrationDataReader):
    def __init__(self, feeds: Sequence[Feeds]) -> None:
        self._rest = iter(feeds)

    def get_next(self) -> Feeds | None:
        """As ONNX Runtime asks for them."""
        return next(self._rest, None)


def _quantise(file: Path, feeds: Sequence[Feeds], twin: Path) -> None:
    """Weights of seven bits: sums of more overflow on processors without instructions made for this."""
    with tempfile.TemporaryDirectory() as folder:
        prepared = Path(folder) / "prepared.onnx"
        quant_pre_process(str(file), str(prepared), skip_symbolic_shape=True)
        nodes = onnx.load(str(prepared)).graph.node
        kept = [node.name for node in nodes if any(part in node.name for part in KEPT)]
        entries = _entries(nodes)
        steps = {"scale": np.array(1.0, np.float32), "zero_point": np.array(128, np.uint8)}
        quantize_static(
            str(prepared), str(twin), _Reader(feeds), quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8, per_channel=True, reduce_range=True,
            op_types_to_quantize=list(IN_8_BITS), nodes_to_exclude=kept,
            extra_options={"TensorQuantOverrides": {name: [steps] for name in entries}},
        )  # fmt: skip
        model = onnx.load(str(twin))
        for name in entries:
            _enter_as_it_is(model.graph, name)
        _spread_in_8_bits(model.graph)
        _drop_unused(model.graph)
        onnx.checker.check_model(model)
        onnx.save(model, str(twin))


def _entries(nodes: Sequence[onnx.NodeProto]) -> list[str]:
    """Inputs of the first layers: an 8-bit image minus 128, alone or with planes."""
    greys = {node.output[0] for node in nodes if _is_grey(node, nodes)}
    together = [node.output[0] for node in nodes if node.op_type == "Concat" and greys & set(node.input)]
    return together or sorted(greys)


def _is_grey(node: onnx.NodeProto, nodes: Sequence[onnx.NodeProto]) -> bool:
    return node.op_type == "Sub" and any(n.op_type == "Cast" and n.output[0] == node.input[0] for n in nodes)


def _enter_as_it_is(graph: onnx.GraphProto, name: str) -> None:
    """Feed the image's 8-bit numbers to the first layer as they are; quantise only the planes beside it."""
    made_by = {output: node for node in graph.node for output in node.output}
    (to_8_bits,) = (n for n in graph.node if n.op_type == "QuantizeLinear" and n.input[0] == name)
    entry, (_, scale, zero) = made_by[name], to_8_bits.input
    begin, parts, new = list(graph.node).index(to_8_bits), [], []
    for part in entry.input if entry.op_type == "Concat" else [name]:
        if part in made_by and _is_grey(made_by[part], graph.node):
            parts.append(made_by[made_by[part].input[0]].input[0])
        else:
            parts.append(f"{part}_8_bits")
            new.append(onnx.helper.make_node("QuantizeLinear", [part, scale, zero], [parts[-1]]))
    new.append(onnx.helper.make_node("Concat", parts, list(to_8_bits.output), axis=1))
    graph.node.remove(to_8_bits)
    for place, node in enumerate(new):
        graph.node.insert(begin + place, node)


def _spread_in_8_bits(graph: onnx.GraphProto) -> None:
    """Turn channels into pixels before dequantising: a quarter of the memory."""
    made_by = {output: node for node in graph.node for output in node.output}
    for spread in [node for node in graph.node if node.op_type == "DepthToSpace"]:
        back = made_by.get(spread.input[0])
        if back is None or back.op_type != "DequantizeLinear":
            continue
        place = list(graph.node).index(spread)
        after = onnx.helper.make_node(
            "DequantizeLinear", [f"{spread.output[0]}_8_bits", *back.input[1:]], list(spread.output)
        )
        spread.input[0], spread.output[0] = back.input[0], after.input[0]
        graph.node.insert(place + 1, after)


def _drop_unused(graph: onnx.GraphProto) -> None:
    """Remove nodes and weights without a reader."""
    told = {output.name for output in graph.output}
    while True:
        read = told.union(*(node.input for node in graph.node))
        unused = [node for node in graph.node if not read & set(node.output)]
        for node in unused:
            graph.node.remove(node)
        if not unused:
            break
    for weight in [weight for weight in graph.initializer if weight.name not in read]:
        graph.initializer.remove(weight)


def _images(manifest: Manifest, folder: Path, count: int) -> Iterator[Feeds]:
    """Inputs drawn from the pairs."""
    pairs = open_pairs(folder)
    rng = np.random.Generator(np.random.PCG64(0))
    fitting = fit(manifest, (WIDTH, HEIGHT))
    for pair in rng.integers(pairs.count, size=count):
        images = [fitting.enter(np.asarray(image)) for image in pairs["image"][int(pair)]]
        focal = float(pairs["focal"][pair])
        ground = ground_plane(focal, pairs["R_ned_camera"][pair, 0], float(pairs["height"][pair, 0]))
        planes = np.concatenate([ray_tangents(focal), ground[None] * np.float32(rng.random() >= WITHOUT_HEIGHT)])
        contents = {"image": images[0], "first": images[0], "second": images[1], "geometry": planes}
        yield {name: contents[spec.carries or name][None] for name, spec in manifest.inputs.items()}


def _crops(manifest: Manifest, folder: Path, count: int) -> Iterator[Feeds]:
    """Inputs of sixteen crops each."""
    (name,) = manifest.inputs
    rng = np.random.Generator(np.random.PCG64(0))
    files = sorted(folder.glob("*.npz"))[:count]
    if not files:
        raise SystemExit(f"{folder}: no crops here; make them with `python -m tools.training.render_drone_crops`")
    for index in range(count):
        with np.load(files[index % len(files)]) as arrays:
            yield {name: rng.choice(arrays["picture"], 16)}


def _differences(file: Path, twin: Path, feeds: Sequence[Feeds]) -> dict[str, float]:
    """Differences of each output, in its standard deviations."""
    ours, theirs = (ort.InferenceSession(str(one), providers=["CPUExecutionProvider"]) for one in (twin, file))
    names = [output.name for output in theirs.get_outputs()]
    pairs = [(ours.run(names, feed), theirs.run(names, feed)) for feed in feeds]
    differences = {}
    for index, name in enumerate(names):
        our, their = (np.stack([outputs[which][index] for outputs in pairs]) for which in (0, 1))
        differences[name] = round(float(np.abs(our - their).mean() / their.std()), 4)
    worst = max(differences, key=lambda name: differences[name])
    if not differences[worst] <= AT_MOST:
        twin.unlink()
        raise SystemExit(f"{twin}: output {worst} differs by {differences[worst]} of its deviation: keep this in float")
    return differences


if __name__ == "__main__":
    main()
