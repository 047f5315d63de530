"""One ONNX model in memory: opened with a checked hash, the wanted provider and a golden answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from flockd.config.perception import Provider
from flockd.errors import ModelError
from flockd.inference.fitting import entering, fit, leaving
from flockd.inference.manifest import Answer, Content, InputSpec, Manifest, OutputSpec, load_manifest
from flockd.inference.providers import Prepared, Shapes, engine_folder, is_slow_to_build, open_session
from flockd.inference.weights import fault_of_weights
from flockd.messages import Float32Array, UInt8Array

_GOLDEN_TOLERANCE = 0.02


class OnnxModel:
    """A model behind its manifest. ``run`` may be called from any thread."""

    def __init__(
        self,
        path: Path,
        *,
        threads: int,
        provider: Provider = "cpu",
        engines: Path | None = None,
        preparing: bool = False,
    ) -> None:
        """Open and check it; ``ModelError`` says what is wrong, and where.

        Args:
            path: the manifest.
            threads: on the CPU.
            provider: what computes it; never another in its place.
            engines: where providers keep what they build.
            preparing: whether a provider that is slow to build may do so now.
        """
        self.manifest, file = load_manifest(path)
        self._path = path
        made_for = self.manifest.providers
        if made_for and provider not in made_for:
            raise ModelError(
                f"{path}: {self.manifest.name} is made for {' and '.join(made_for)}, not for {provider}; name "
                "another model (flockd's own without _int8 are made for any), or another perception.provider"
            )
        _check_weights(file, path)
        self._engines = engine_folder(engines, provider, self.manifest.name, self.manifest.sha256)
        self._prepared = Prepared.load(self._engines)
        self._may_build = preparing or not is_slow_to_build(provider)
        if not self._may_build and self._prepared is None:
            raise ModelError(
                f"{path}: is not prepared for {provider}, which would build its engine for minutes; run "
                "`flockd models prepare` first"
            )
        if self._engines is not None:
            self._engines.mkdir(parents=True, exist_ok=True)
        self._session = open_session(file, path, threads=threads, provider=provider, folder=self._engines)
        self._running: set[ort.RunOptions] = set()
        self._check_tensors()
        self.check_golden()

    @property
    def provider(self) -> str:
        """What really runs it, by ONNX Runtime's own account, which may not be what was asked for."""
        return str(self._session.get_providers()[0])

    def run(self, feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The outputs by name. ``FloatingPointError`` when one is not finite.

        ``ValueError`` for inputs of a shape that an engine would first have to be built for, and ought not to now.
        """
        if not self._may_build and not (self._prepared and self._prepared.covers(shapes_of(feeds))):
            raise ValueError(f"model {self.manifest.name} is not prepared for inputs of {shapes_of(feeds)}")
        names = list(self.manifest.outputs)
        outputs = dict(zip(names, self._answers(names, feeds), strict=True))
        for name, value in outputs.items():
            if not np.isfinite(value).all():
                raise FloatingPointError(f"model {self.manifest.name}: output {name} is not finite")
        return outputs

    def answer(self, contents: Mapping[Content, Sequence[UInt8Array] | Float32Array]) -> dict[Answer, Float32Array]:
        """The outputs by what they give, in their units, for images (h, w, 3) RGB of the input's size."""
        feeds = {}
        for name, spec in self.manifest.inputs.items():
            content = contents[spec.carries or name]  # type: ignore[index] # the manifest's names are checked
            feeds[name] = content if isinstance(content, np.ndarray) else entering(spec, content)
        specs = self.manifest.outputs
        return {
            specs[name].gives or name: leaving(specs[name], value)  # type: ignore[misc]
            for name, value in self.run(feeds).items()
        }

    @property
    def engines(self) -> Path | None:
        """The folder of what its provider builds; None where it builds nothing."""
        return self._engines

    def keep_engines(self, shapes: Sequence[Shapes]) -> None:
        """Note that the engines in the folder cover these shapes and all between them."""
        if self._engines is not None:
            Prepared.over(shapes).save(self._engines)

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
        except Exception as error:  # noqa: BLE001 - ONNX Runtime's own exception types are private
            raise ModelError(
                f"{self._path}: {self.provider} cannot run {self.manifest.file} ({_reason(error)}); choose another "
                "perception.provider or restore the model file"
            ) from None
        for name, spec in self.manifest.outputs.items():
            mean, deviation = float(outputs[name].mean()), float(outputs[name].std())
            allowed = _GOLDEN_TOLERANCE * (abs(spec.golden_mean) + spec.golden_deviation) + 1e-6
            if abs(mean - spec.golden_mean) > allowed or abs(deviation - spec.golden_deviation) > allowed:
                raise ModelError(
                    f"{self._path}: outputs.{name}: the golden input gives mean {mean:.4g} and deviation "
                    f"{deviation:.4g} where {spec.golden_mean:.4g} and {spec.golden_deviation:.4g} are expected; "
                    "export the model and its manifest together"
                )

    def _check_tensors(self) -> None:
        found_inputs = {tensor.name: tensor for tensor in self._session.get_inputs()}
        found_outputs = {tensor.name: tensor for tensor in self._session.get_outputs()}
        inputs, outputs = self.manifest.inputs, self.manifest.outputs
        # Every input wants something; of the outputs, some may be of no use.
        for kind, wanted, found, fits in (
            ("inputs", inputs, found_inputs, set(inputs) == set(found_inputs)),
            ("outputs", outputs, found_outputs, set(outputs) <= set(found_outputs)),
        ):
            if not fits:
                raise ModelError(
                    f"{self._path}: {kind}: the manifest names {sorted(wanted)} but the model file has "
                    f"{sorted(found)}; make them agree"
                )
        for kind, specs, found in (("inputs", inputs, found_inputs), ("outputs", outputs, found_outputs)):
            for name, spec in specs.items():
                fault = _misfit(spec, found[name].type, found[name].shape)
                if fault:
                    raise ModelError(f"{self._path}: {kind}.{name}.{fault}; make them agree")


def shapes_of(feeds: Mapping[str, NDArray[Any]]) -> dict[str, list[int]]:
    """The inputs' shapes."""
    return {name: list(value.shape) for name, value in feeds.items()}


def _misfit(spec: InputSpec | OutputSpec, type_: str, shape: Sequence[int | str | None]) -> str | None:
    """Where a manifest's and a model file's tensor differ. What is free in the file, the manifest may fix."""
    of_file = {"tensor(float)": "float32"}.get(type_, type_.removeprefix("tensor(").removesuffix(")"))
    if of_file != spec.dtype:
        return f"dtype: the manifest says {spec.dtype} but the model file {of_file}"
    if isinstance(spec, OutputSpec) and not shape:
        return None  # exporters may leave out the shape of what comes out
    may_be_free = isinstance(spec, OutputSpec)
    if len(shape) == len(spec.shape) and all(
        not isinstance(there, int) or here == there or (may_be_free and isinstance(here, str))
        for here, there in zip(spec.shape, shape, strict=True)
    ):
        return None
    return f"shape: the manifest says {_listed(spec.shape)} but the model file {_listed(shape)}"


def _listed(shape: Sequence[int | str | None]) -> str:
    return "[" + ", ".join("?" if size is None else str(size) for size in shape) + "]"


def golden_image(size: tuple[int, int], seed: int = 0) -> UInt8Array:
    """A fixed smooth random picture, (height, width, 3) RGB; ``size`` is (width, height)."""
    noise = np.random.Generator(np.random.PCG64(seed)).integers(0, 256, (9, 7, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(noise, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def golden_feeds(manifest: Manifest) -> dict[str, NDArray[Any]]:
    """The golden input: a fixed picture for every image, zeros for the geometry."""
    width, height = manifest.golden_size
    feeds: dict[str, NDArray[Any]] = {}
    for index, (name, spec) in enumerate(manifest.inputs.items()):
        if (spec.carries or name) == "geometry":
            feeds[name] = np.zeros((1, 3, height // 2, width // 2), np.float32)
        else:
            feeds[name] = entering(spec, [golden_image((width, height), index)])
    return feeds


def feeds_for(manifest: Manifest, image: tuple[int, int], pictures: int = 1) -> dict[str, NDArray[Any]]:
    """What enters for images (width, height) of a camera, or for so many pictures of drones, with nothing in them."""
    fitting = fit(manifest, image)
    feeds: dict[str, NDArray[Any]] = {}
    for name, spec in manifest.inputs.items():
        content = spec.carries or name
        if content == "geometry":
            planes = np.zeros((3, image[1] // 2, image[0] // 2), np.float32)
            feeds[name] = fitting.enter_planes(planes, 2)[None]
        elif content == "picture":
            size = manifest.fixed_size or manifest.golden_size
            feeds[name] = entering(spec, [golden_image(size, seed) for seed in range(pictures)])
        else:
            feeds[name] = entering(spec, [fitting.enter(golden_image(image))])
    return feeds


def _reason(error: Exception) -> str:
    """ONNX Runtime's, without the places in its source."""
    return str(error).splitlines()[0].rpartition("Status Message: ")[2].rpartition("] ")[2]


def _check_weights(file: Path, manifest: Path) -> None:
    try:
        fault = fault_of_weights(file.read_bytes())
    except ValueError as error:
        raise ModelError(f"{manifest}: file: {file} cannot be loaded ({error}); restore it") from None
    if fault:
        raise ModelError(f"{manifest}: file: {file}: {fault}")
