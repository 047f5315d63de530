"""Detectors as Ultralytics and YOLOX export them become flockd's: small networks that always find the same drone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from onnx.external_data_helper import convert_model_to_external_data

from flockd.cli import main
from flockd.flight.inference import OnnxModel
from flockd.ground.calibration.fragment import rig_text
from tests import make
from tests.ground.pictures.photographs import FOCAL_PX, RENDERED, SIZE, truth

SIDE = 64
CELLS = 8 * 8 + 4 * 4 + 2 * 2
"""Of the strides 8, 16 and 32."""
DRONE = (20.0, 41.0, 16.0, 8.0)
"""Centre right and down, width, height, pixels of the input."""
P = 0.75
AGPL = {"license": "AGPL-3.0 License (https://ultralytics.com/license)", "names": "{0: 'bird', 1: 'drone'}"}


def written(
    file: Path,
    output: NDArray[np.float32],
    *,
    image: Sequence[int | str] = (1, 3, SIDE, SIDE),
    shape: Sequence[int | str] | None = None,
    half: bool = False,
    exp: bool = False,
    said: dict[str, str] | None = None,
) -> Path:
    """A network whose output is always this, and metadata ``said``; ``shape``: the output's as the file says."""
    kind, number = (TensorProto.FLOAT16, np.float16) if half else (TensorProto.FLOAT, np.float32)
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["always", "nothing"], ["output0"]),
        *([helper.make_node("Exp", ["mean"], ["unused"])] if exp else []),
    ]
    graph = helper.make_graph(
        nodes, "net",
        [helper.make_tensor_value_info("images", kind, image)],
        [helper.make_tensor_value_info("output0", kind, shape or output.shape)],
        [numpy_helper.from_array(np.array(value, number), name) for name, value in (("always", output), ("zero", 0))],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, said or {})
    onnx.save(model, str(file))
    return file


def yolov8(place: Sequence[float] = DRONE, score: float = P) -> NDArray[np.float32]:
    """(1, 4 + 2, cells): centre, size, and the probabilities of bird and drone."""
    out = np.full((1, 6, CELLS), 3.0, np.float32)
    out[0, 4:] = 0.01
    out[0, :4, 50], out[0, 5, 50] = place, score
    out[0, :4, 9], out[0, 4, 9] = (50, 12, 20, 20), 0.9  # a bird
    return out


def yolov5() -> NDArray[np.float32]:
    """(1, 3 * cells, 5 + 2): centre, size, objectness, and the classes' probabilities."""
    out = np.full((1, 3 * CELLS, 7), 3.0, np.float32)
    out[0, :, 4:] = 0.01
    out[0, 200] = [*DRONE, 2 * P / 1.6, 0.1, 0.8]
    out[0, 7] = [50, 12, 20, 20, 0.9, 0.9, 0.1]
    return out


def yolo26() -> NDArray[np.float32]:
    """(1, 300, 6): corners, score, class."""
    right, down, width, height = DRONE
    out = np.zeros((1, 300, 6), np.float32)
    out[0, 0] = [40, 2, 60, 22, 0.9, 0]
    out[0, 1] = [right - width / 2, down - height / 2, right + width / 2, down + height / 2, P, 1]
    return out


def yolox(*, decoded: bool) -> NDArray[np.float32]:
    """(1, cells, 5 + 2): of the cell in column 2 and row 5 of stride 8, whose corner is at (16, 40)."""
    out = np.zeros((1, CELLS, 7), np.float32)
    place = DRONE if decoded else [4.0 / 8, 1.0 / 8, np.log(16 / 8), np.log(8 / 8)]
    out[0, 5 * 8 + 2] = [*place, 2 * P / 1.6, 0.1, 0.8]
    return out


def imported(file: Path, *options: object, drone: str = "drone", licence: str = "AGPL-3.0") -> int:
    own = ["--licence", licence] if licence else []
    out = file.parent / "mine"
    return main([*map(str, ("models", "import", file, "--drone", drone, *own, "--out", out, *options))])


@pytest.mark.parametrize(
    ("kind", "output", "options", "colour"),
    [
        ("YOLOv8, YOLO11", yolov8(), {}, "rgb"),
        ("YOLOv8, YOLO11", yolov8(), {"half": True}, "rgb"),
        ("YOLOv5", yolov5(), {}, "rgb"),
        ("YOLO26, or exported with nms", yolo26(), {}, "rgb"),
        ("YOLOX", yolox(decoded=False), {}, "bgr"),
        ("YOLOX", yolox(decoded=True), {"exp": True}, "bgr"),
        ("YOLOv8, YOLO11", yolov8(), {"image": ("batch", 3, SIDE, SIDE)}, "rgb"),
    ],
    ids=["v8", "half", "v5", "end to end", "x", "x decoded", "free batch"],
)
def test_each_kind_gives_the_drone_where_it_is(
    kind: str, output: Any, options: dict[str, Any], colour: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(tmp_path / "Best 1.onnx", output, **options, said=AGPL)
    before = file.read_bytes()
    assert imported(file, "--json") == 0
    captured = capsys.readouterr()
    told = json.loads(captured.out)
    path = tmp_path / "mine" / "best_1.yaml"
    assert (told["manifest"], told["kind"], told["drone"]) == (str(path), kind, "drone")
    assert "says 'AGPL-3.0 License (https://ultralytics.com/license)': whoever gets a drone, or" in captured.err
    assert file.read_bytes() == before
    model = OnnxModel(path, threads=1)
    rows = model.infer({"image": [np.zeros((SIDE, SIDE, 3), np.uint8)]})["boxes"]
    best = rows[rows[:, 4].argmax()]
    assert best == pytest.approx([*DRONE, P], rel=2e-3)
    assert np.sort(rows[:, 4])[-2] < 0.1, "the bird is no drone"
    assert model.manifest.inputs["images"].colour == colour
    assert model.manifest.inputs["images"].white == (1.0 if colour == "rgb" else 255.0)
    assert model.manifest.licence == "AGPL-3.0"
    assert imported(file) == 2, "it exists"
    assert imported(file, "--force") == 0


def test_an_imported_detector_detects(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It says where the drone of a rendered photograph is: that box is the detection's."""
    left, top, width, height = truth()[1]["2.5_m_0.jpg"]
    scale = SIDE / max(SIZE)
    place = scale * np.array([left + width / 2, top + height / 2, width + 6, height + 4])
    assert imported(written(tmp_path / "mine.onnx", yolov8(place.tolist(), 0.9)), drone="1", licence="MIT") == 0
    drone = tmp_path / "drone.yaml"
    mounted = [make.camera("front", SIZE, FOCAL_PX)]
    drone.write_text(f"{rig_text(mounted, ())}perception: {{detector: mine/mine.yaml}}\n", encoding="utf-8")
    arguments = ("detect", RENDERED / "2.5_m_0.jpg", "--config", drone)
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["pictures"][0]["detections"]
    assert found["box"] == pytest.approx([left - 3, top - 2, left + width + 3, top + height + 2], abs=0.5)


@pytest.mark.parametrize(
    ("output", "options", "said", "code", "sentence"),
    [
        (yolov8(), {"drone": "uav"}, AGPL, 2, "has no class 'uav' but has bird, drone; write --drone with a name, or"),
        (yolov8(), {}, {"names": "{'a': 'drone'}"}, 2, "no class 'drone' but does not name its classes; write --drone"),
        (yolov8(), {"drone": "2"}, {}, 2, "no class '2' but does not name its classes; write --drone with a name, or"),
        (yolov8(), {"licence": ""}, AGPL, 2, "write it with --licence (the file says 'AGPL-3.0 License"),
        (yolov8(), {}, {"task": "segment", **AGPL}, 78, "is a network for the task 'segment'; export one that detects"),
        (np.zeros((1, 7, 99), np.float32), {}, AGPL, 78, "gives output0 [1, 7, 99] for an image of 64 x 64, as no"),
        (yolov8(score=7.0), {}, AGPL, 78, "scores from 0.01 to 7, which are no probabilities"),
        (yolov8() / np.float32(SIDE), {}, AGPL, 78, "boxes around 0.781, which are not pixels of its input"),
        (yolov8() * np.float32(np.inf), {}, AGPL, 78, "gives numbers that are not finite"),
    ],
    ids=["name", "names", "number", "licence", "task", "shape", "scores", "shares", "infinite"],
)
def test_what_cannot_be_imported_is_said_in_one_sentence(
    output: Any, options: dict[str, str], said: dict[str, str], code: int, sentence: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    assert imported(written(tmp_path / "best.onnx", output, said=said), **options) == code
    captured = capsys.readouterr()
    assert sentence in captured.err
    assert (captured.out, captured.err.count("\n")) == ("", 1)
    assert not (tmp_path / "mine").exists()


@pytest.mark.parametrize(
    ("image", "shape", "sentence"),
    [
        ((1, 3, "height", "width"), (1, 6, "cells"), "of free size or several at once; export it again with a fixed"),
        ((4, 3, SIDE, SIDE), (4, 6, CELLS), "of free size or several at once"),
        ((1, SIDE, SIDE, 3), (1, 6, CELLS), "and not one image of (1, 3, height, width)"),
    ],
)
def test_free_sizes_and_other_layouts_are_refused(
    image: Any, shape: Any, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = yolov8() if shape[0] == 1 else np.repeat(yolov8(), 4, axis=0)
    assert imported(written(tmp_path / "best.onnx", output, image=image, shape=shape, said=AGPL)) == 78
    assert sentence in capsys.readouterr().err


def test_a_whole_file_that_cannot_be_opened_here_is_not_called_damaged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(tmp_path / "best.onnx", yolov8(), said=AGPL)
    for change, told in (
        (lambda model: setattr(model, "ir_version", 99), "Your model ir_version 99 is higher than"),
        (
            lambda model: setattr(model.opset_import[0], "version", 99),
            "best.onnx: cannot be loaded by this onnxruntime",
        ),
        (lambda model: convert_model_to_external_data(model, size_threshold=0), "should be stored in"),
    ):
        model = onnx.load(file)
        change(model)  # type: ignore[no-untyped-call]
        (tmp_path / "changed").mkdir(exist_ok=True)
        (tmp_path / "changed" / "best.onnx").write_bytes(model.SerializeToString())
        assert imported(tmp_path / "changed" / "best.onnx") == 78
        said = capsys.readouterr().err
        assert told in said
        assert "; export it again into one file, for an older version (opset=17)\n" in said


def test_what_is_no_onnx_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "best.onnx").write_bytes(b"a network")
    assert imported(tmp_path / "best.onnx") == 78
    assert "is no ONNX file, or a damaged one" in capsys.readouterr().err
    (tmp_path / "best.onnx").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:abc\n")
    assert imported(tmp_path / "best.onnx") == 78
    assert "best.onnx: is a pointer of Git LFS; fetch the file with `git lfs pull`" in capsys.readouterr().err
    assert imported(tmp_path / "other.onnx") == 2
    assert "other.onnx: does not exist; check the path" in capsys.readouterr().err
    file = written(tmp_path / "mine.onnx", yolov8(), said=AGPL)
    assert main(["models", "import", str(file), "--drone", "drone", "--licence", "MIT", "--out", str(tmp_path)]) == 2
    assert "is the file itself; name another folder with --out" in capsys.readouterr().err
