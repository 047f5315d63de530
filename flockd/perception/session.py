"""One ONNX model in memory: opened with a checked hash, the wanted provider and a golden answer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from flockd.errors import ModelError
from flockd.messages import UInt8Array
from flockd.perception.manifest import Manifest, load_manifest

_GOLDEN_TOLERANCE = 0.02


class OnnxModel:
    """A model behind its manifest. ``run`` may be called from any thread."""

    def __init__(self, path: Path, *, threads: int) -> None:
        self.manifest, file = load_manifest(path)
        self._path = path
        self._session = _open(file, path, threads)
        self._running: set[ort.RunOptions] = set()
        self._check_names()
        self.check_golden()

    @property
    def provider(self) -> str:
        """What really runs it, by ONNX Runtime's own account, which may not be what was asked for."""
        return str(self._session.get_providers()[0])

    def run(self, feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The outputs by name. ``FloatingPointError`` when one is not finite."""
        names = list(self.manifest.outputs)
        outputs = dict(zip(names, self._answers(names, feeds), strict=True))
        for name, value in outputs.items():
            if not np.isfinite(value).all():
                raise FloatingPointError(f"model {self.manifest.name}: output {name} is not finite")
        return outputs

    def terminate(self) -> None:
        """Ends the runs that are under way, from any thread; ONNX Runtime then raises an error of its own in them."""
        for options in tuple(self._running):
            options.terminate = True

    def _answers(self, names: list[str], feeds: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
        options = ort.RunOptions()
        self._running.add(options)
        try:
            answers: list[NDArray[Any]] = self._session.run(names, dict(feeds), options)
        finally:
            self._running.discard(options)
        return answers

    def check_golden(self) -> None:
        """Run the golden input; ``ModelError`` when the answer is not the manifest's."""
        try:
            outputs = self.run(golden_feeds(self.manifest))
        except FloatingPointError as error:
            raise ModelError(f"{self._path}: {error} on the golden input; restore the model file") from None
        for name, spec in self.manifest.outputs.items():
            mean, deviation = float(outputs[name].mean()), float(outputs[name].std())
            allowed = _GOLDEN_TOLERANCE * (abs(spec.golden_mean) + spec.golden_deviation) + 1e-6
            if abs(mean - spec.golden_mean) > allowed or abs(deviation - spec.golden_deviation) > allowed:
                raise ModelError(
                    f"{self._path}: outputs.{name}: the golden input gives mean {mean:.4g} and deviation "
                    f"{deviation:.4g} where {spec.golden_mean:.4g} and {spec.golden_deviation:.4g} are expected; "
                    "export the model and its manifest together"
                )

    def _check_names(self) -> None:
        found_inputs = {i.name for i in self._session.get_inputs()}
        found_outputs = {o.name for o in self._session.get_outputs()}
        for kind, wanted, found in (
            ("inputs", set(self.manifest.inputs), found_inputs),
            ("outputs", set(self.manifest.outputs), found_outputs),
        ):
            if wanted != found:
                raise ModelError(
                    f"{self._path}: {kind}: the manifest names {sorted(wanted)} but the model file has "
                    f"{sorted(found)}; make them agree"
                )


def golden_image(size: tuple[int, int], seed: int = 0) -> UInt8Array:
    """A fixed smooth random picture, (height, width, 3) RGB; ``size`` is (width, height)."""
    noise = np.random.Generator(np.random.PCG64(seed)).integers(0, 256, (9, 7, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(noise, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def golden_feeds(manifest: Manifest) -> dict[str, NDArray[Any]]:
    """The golden input: a fixed picture for every 8-bit input, zeros for every other."""
    width, height = manifest.golden_size
    feeds: dict[str, NDArray[Any]] = {}
    for index, (name, spec) in enumerate(manifest.inputs.items()):
        if spec.dtype == "uint8":
            feeds[name] = golden_image((width, height), index)[None]
        else:
            channels = spec.shape[1]
            if not isinstance(channels, int):
                raise ModelError(f"model {manifest.name}: inputs.{name}.shape: the channels must be a number")
            feeds[name] = np.zeros((1, channels, height // 2, width // 2), np.float32)
    return feeds


def _open(file: Path, manifest_path: Path, threads: int) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = ort.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - ONNX Runtime's own exception types are private
        reason = str(error).splitlines()[0]
        raise ModelError(f"{manifest_path}: file: {file} cannot be loaded ({reason}); restore it") from None
    return session
