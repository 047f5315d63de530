"""Converts a detector that Ultralytics or YOLOX exported to a network for `perception.detector`.

Their outputs differ. Nodes at the end of the graph convert them to flockd's boxes, as of `models/detector.yaml`, so
that no code that flies depends on them.
"""

from __future__ import annotations

import ast
import hashlib
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from flockd.core.data import LFS_POINTER, data_path
from flockd.core.errors import ModelError, UsageError
from flockd.flight.inference import load_manifest
from flockd.flight.inference.feeds import golden_feeds
from flockd.flight.inference.manifest_file import read_manifest
from flockd.flight.inference.providers import open_runtime
from flockd.flight.inference.session import cannot_run
from flockd.ground.manifest_writer import write_manifest, write_unchecked

STRIDES = (8, 16, 32, 64)
"""Strides of the grids of cells, pixels; most networks have the first three."""
COLUMNS = ("centre_right_px", "centre_down_px", "width_px", "height_px", "drone_probability")
_EXPORT = "export it again with a fixed size, as with imgsz=640 and without dynamic"
_TYPES: dict[int, str] = {TensorProto.FLOAT: "float32", TensorProto.FLOAT16: "float16"}


@dataclass(frozen=True)
class Imported:
    """The result of an import."""

    manifest: Path
    kind: str
    drone: str
    """Name or number of the class of drones."""
    classes: int | None
    """Number of classes; None: the file does not say."""
    terms: str
    """The file's own note about the AGPL, Ultralytics' licence for its networks; else empty."""


def import_detector(file: Path, drone: str, licence: str | None, folder: Path, *, overwrite: bool = False) -> Imported:
    """Writes the network and its manifest into ``folder``, and opens them once as a flight does.

    Args:
        file: ONNX.
        drone: the class of drones, by its name in the file or its number from 0.
        licence: of the weights.
        folder: is made where it does not exist.
        overwrite: what is there under the same name.

    Raises ModelError for a file of no known kind, UsageError for a wrong class, licence or folder; OSError.
    """
    model = _read(file)
    said = {one.key: one.value for one in model.metadata_props}
    if said.get("task", "detect") != "detect":
        raise ModelError(f"{file}: is a network for the task {said['task']!r}; export one that detects")
    if not licence:
        found = f" (the file says {said['license']!r})" if "license" in said else ""
        raise UsageError(f"{file}: does not say the licence of its weights; write it with --licence{found}")
    name = re.sub("[^a-z0-9_-]", "_", file.stem.lower())
    targets = [folder / f"{name}{suffix}" for suffix in (".onnx", ".yaml")]
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder}: is a file; name a folder with --out")
    for target in targets:
        if target.resolve() == file.resolve():
            raise UsageError(f"{target}: is the file itself; name another folder with --out")
        if target.exists() and not overwrite:
            raise UsageError(f"{target}: exists; name another folder with --out, or overwrite it with --force")
    kind = _kind_of(file, model)
    names = _class_names(said)
    classes = kind.classes or len(names) or None
    number = _class_number(file, drone, names, classes)
    manifest = _manifest(file, kind, name, names.get(number, f"class {number}"), licence, said)
    _append_boxes(model, kind, number)
    with TemporaryDirectory() as made:
        there = Path(made) / f"{name}.onnx"
        onnx.save(model, str(there))
        written = write_manifest(manifest, there, _checked(file, manifest, there))
        folder.mkdir(parents=True, exist_ok=True)
        for source, target in zip((there, written), targets, strict=True):
            shutil.copyfile(source, target)
    own = said.get("license", "")
    return Imported(
        targets[1], kind.name, names.get(number, str(number)), classes, own if "AGPL" in own.upper() else ""
    )


@dataclass(frozen=True)
class _Kind:
    """Layout of the boxes in a network's output."""

    name: str
    image: onnx.ValueInfoProto
    size: tuple[int, int]
    """Width and height of its input, pixels."""
    output: str
    columns: int
    """Numbers of a box."""
    classes: int | None
    """None: the shape does not tell."""
    transposed: bool = False
    """Whether a box is a column of the output, instead of a row."""
    objectness: bool = False
    strides: tuple[int, ...] = ()
    """Strides of the grids in whose cells boxes are still to be decoded."""
    corners: bool = False
    """Whether a box has its corners, one score and the number of its class, without overlaps (end to end)."""
    input: dict[str, Any] = field(default_factory=lambda: {"white": 1.0})
    """How images enter."""


def _read(file: Path) -> onnx.ModelProto:
    try:
        model = onnx.load(str(file))
        onnx.checker.check_model(model)
        return onnx.shape_inference.infer_shapes(model)
    except OSError as error:
        raise ModelError(f"{file}: cannot be read ({error.strerror}); name the ONNX file") from None
    except (DecodeError, onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        if file.read_bytes().startswith(LFS_POINTER):
            raise ModelError(f"{file}: is a pointer of Git LFS; fetch the file with `git lfs pull`") from None
        if re.search("ir_version .* higher|should be stored in", told := str(error).splitlines()[0]):
            raise _not_here(file, told) from None
        raise ModelError(f"{file}: is no ONNX file, or a damaged one; export it again as ONNX") from None


def _not_here(file: Path, told: str) -> ModelError:
    """Of a whole file that cannot be opened here."""
    return ModelError(f"{file}: {told.rstrip('.')}; export it again into one file, for an older version (opset=17)")


def _shape(tensor: onnx.ValueInfoProto) -> list[int | str]:
    return [axis.dim_value or axis.dim_param or "?" for axis in tensor.type.tensor_type.shape.dim]


def _kind_of(file: Path, model: onnx.ModelProto) -> _Kind:
    """The kind of a network, by the shapes of its input and output. Raises ModelError."""
    weights = {one.name for one in model.graph.initializer}
    images = [one for one in model.graph.input if one.name not in weights]
    shape = _shape(images[0]) if images else []
    if len(images) != 1 or len(shape) != 4 or shape[1] != 3 or images[0].type.tensor_type.elem_type not in _TYPES:
        found = ", ".join(f"{one.name} {_shape(one)}" for one in images) or "none"
        raise ModelError(f"{file}: takes {found}, and not one image of (1, 3, height, width); {_EXPORT}")
    batch, _, height, width = shape
    if not isinstance(height, int) or not isinstance(width, int) or (isinstance(batch, int) and batch != 1):
        raise ModelError(f"{file}: takes images of {shape} of free size or several at once; {_EXPORT}")
    outputs = [one for one in model.graph.output if len(_shape(one)) == 3]
    shapes = {one.name: _shape(one)[1:] for one in outputs}
    for name, (first, last) in shapes.items():
        if not isinstance(first, int) or not isinstance(last, int):
            raise ModelError(f"{file}: gives {name} of free size {[first, last]}; {_EXPORT}")
        for strides in (STRIDES[:3], STRIDES):
            cells = sum((height // stride) * (width // stride) for stride in strides)
            of = {"image": images[0], "size": (width, height), "output": name}
            if last == cells and first > 4:
                return _Kind("YOLOv8, YOLO11", **of, columns=first, classes=first - 4, transposed=True)
            if first == 3 * cells and last > 5:
                return _Kind("YOLOv5", **of, columns=last, classes=last - 5, objectness=True)
            if first == cells and last > 5:
                decoded = any(node.op_type == "Exp" for node in model.graph.node)
                return _Kind(
                    "YOLOX", **of, columns=last, classes=last - 5, objectness=True,
                    strides=() if decoded else strides, input={"colour": "bgr"},
                )  # fmt: skip
        if last == 6:
            return _Kind("YOLO26, or exported with nms", **of, columns=6, classes=None, corners=True)
    found = ", ".join(f"{one.name} {_shape(one)}" for one in model.graph.output)
    raise ModelError(
        f"{file}: gives {found} for an image of {width} x {height}, as no network of YOLOv5, YOLOv8, YOLO11, YOLO26 or "
        "YOLOX that detects; export one of these"
    )


def _class_names(said: dict[str, str]) -> dict[int, str]:
    """The classes as Ultralytics writes them into the file: {0: 'drone'}, or ['drone']."""
    try:
        names = ast.literal_eval(said.get("names", "{}"))
        pairs = enumerate(names) if isinstance(names, list) else names.items() if isinstance(names, dict) else ()
        return {int(number): str(name) for number, name in pairs}
    except (ValueError, SyntaxError):
        return {}


def _class_number(file: Path, drone: str, names: dict[int, str], classes: int | None) -> int:
    wanted = [number for number, name in names.items() if name.casefold() == drone.strip().casefold()]
    if wanted:
        return wanted[0]
    if drone.isdecimal() and int(drone) < (classes or int(drone) + 1):
        return int(drone)
    known = f"has {', '.join(names.values())}" if names else "does not name its classes"
    last = "" if classes is None else f", 0 to {classes - 1}"
    raise UsageError(
        f"{file}: has no class {drone!r} but {known}; write --drone with a name, or a number{last}"
    ) from None


def _append_boxes(model: onnx.ModelProto, kind: _Kind, number: int) -> None:
    """Replaces the outputs by `boxes` (n, 5) of `COLUMNS`, for the class of this number."""
    graph, count = model.graph, iter(range(1000))

    def constant(value: NDArray[Any]) -> str:
        graph.initializer.append(numpy_helper.from_array(value, f"flockd_{next(count)}"))
        return str(graph.initializer[-1].name)

    def node(kind_of_node: str, *inputs: str, **attributes: Any) -> str:
        output = f"flockd_{next(count)}"
        graph.node.append(helper.make_node(kind_of_node, list(inputs), [output], **attributes))
        return output

    def numbers(*values: float) -> str:
        return constant(np.array(values, np.float32))

    def columns(*which: int) -> str:
        return node("Gather", rows, constant(np.array(which, np.int64)), axis=1)

    rows = node("Cast", kind.output, to=TensorProto.FLOAT)
    shape = [kind.columns, -1] if kind.transposed else [-1, kind.columns]
    rows = node("Reshape", rows, constant(np.array(shape, np.int64)))
    rows = node("Transpose", rows, perm=[1, 0]) if kind.transposed else rows
    places, sizes, score = columns(0, 1), columns(2, 3), columns(4)
    if kind.corners:
        places, sizes = node("Mul", node("Add", places, sizes), numbers(0.5)), node("Sub", sizes, places)
        off = node("Abs", node("Sub", columns(5), numbers(number)))
        score = node("Mul", score, node("Cast", node("Less", off, numbers(0.5)), to=TensorProto.FLOAT))
    elif kind.objectness:
        score = node("Mul", score, columns(5 + number))
    else:
        score = columns(4 + number)
    if kind.strides:
        cells, strides = (constant(part) for part in _grid(kind.size, kind.strides))
        places = node("Mul", node("Add", places, cells), strides)
        sizes = node("Mul", node("Exp", sizes), strides)
    graph.node.append(helper.make_node("Concat", [places, sizes, score], ["boxes"], axis=1))
    del graph.output[:]
    graph.output.append(helper.make_tensor_value_info("boxes", TensorProto.FLOAT, ["boxes", len(COLUMNS)]))


def _grid(size: tuple[int, int], strides: Sequence[int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row (n, 2) and stride (n, 1) of YOLOX's cells, in their order (Z. Ge et al., "YOLOX", 2021)."""
    cells, of = [], []
    for stride in strides:
        right, down = np.meshgrid(np.arange(size[0] // stride), np.arange(size[1] // stride))
        cells.append(np.stack([right.ravel(), down.ravel()], 1))
        of.append(np.full((right.size, 1), stride))
    return np.concatenate(cells).astype(np.float32), np.concatenate(of).astype(np.float32)


def _manifest(file: Path, kind: _Kind, name: str, drone: str, licence: str, said: dict[str, str]) -> dict[str, Any]:
    """The manifest without hash and golden output, with the thresholds of flockd's own detector."""
    ours, _ = load_manifest(data_path("models") / "detector.yaml")
    dtype = _TYPES[kind.image.type.tensor_type.elem_type]
    width, height = kind.size
    unit = f"grey levels 0-{kind.input.get('white', 255):g}"
    return {
        "name": name,
        "roles": ["detector"],
        "file": f"{name}.onnx",
        "description": f"{kind.name}: boxes of {drone} in one image",
        "thresholds": dict(ours.thresholds),
        "inputs": {
            kind.image.name: {
                "carries": "image", "shape": [1, 3, height, width], "dtype": dtype, "layout": "nchw",
                "meaning": "image", "unit": unit, **kind.input,
            }
        },
        "outputs": {
            "boxes": {
                "shape": ["boxes", len(COLUMNS)], "dtype": "float32", "columns": list(COLUMNS),
                "meaning": f"centre right and down, width, height, and probability of {drone}",
                "unit": "input px, input px, input px, input px, 1", "golden_mean": 0.0, "golden_deviation": 0.0,
            }
        },
        "golden_size": [width, height],
        "licence": licence,
        "data": said.get("description", "not known"),
        "accuracy": {},
        "sha256": 64 * "0",
        "command": f"flockd models import {file.name}, SHA-256 {hashlib.sha256(file.read_bytes()).hexdigest()}",
    }  # fmt: skip


def _checked(file: Path, manifest: dict[str, Any], there: Path) -> dict[str, NDArray[Any]]:
    """The output for the golden image. Raises ModelError if it is impossible for this kind of network."""
    opened = read_manifest(write_unchecked(manifest, there))
    try:
        runtime = open_runtime(opened, threads=1, provider="cpu", folder=None)
    except ModelError as error:
        raise _not_here(file, "cannot be loaded by this onnxruntime") from error
    try:
        (boxes,) = runtime.run(["boxes"], golden_feeds(opened.manifest))
    except Exception as error:  # noqa: BLE001 - the library's own exception types are private
        raise cannot_run(opened, "cpu", error) from None
    side = max(opened.manifest.golden_size)
    fault = None
    if not np.isfinite(boxes).all():
        fault = "numbers that are not finite"
    elif boxes[:, 4].min() < -1e-3 or boxes[:, 4].max() > 1 + 1e-3:
        fault = f"scores from {boxes[:, 4].min():.3g} to {boxes[:, 4].max():.3g}, which are no probabilities"
    elif not 2 < np.abs(boxes[:, :2]).max() < 4 * side:
        fault = f"boxes around {np.abs(boxes[:, :2]).max():.3g}, which are not pixels of its input"
    if fault is not None:
        raise ModelError(f"{file}: gives {fault}; export it again as Ultralytics or YOLOX do, without changes")
    return {"boxes": boxes}
