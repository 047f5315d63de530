"""Providers that compute networks, ONNX Runtime's or OpenVINO, and the engines that they build before a flight."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import onnxruntime as ort

from flockd.core.choices import Provider
from flockd.core.config.perception import PerceptionConfig
from flockd.core.errors import ModelError, UnavailableError, shortage_of
from flockd.flight.inference.manifest import InputSpec, Manifest, OutputSpec, listed
from flockd.flight.inference.manifest_file import ManifestFile, models_folder
from flockd.flight.inference.runtimes import OnnxRuntime, OpenVino, Runtime

EXECUTION_PROVIDERS: dict[Provider, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}
"""OpenVINO is used without ONNX Runtime, whose provider for it runs only some of the networks."""
BUILD_ENGINES: frozenset[Provider] = frozenset({"tensorrt", "openvino"})
"""Providers that build an engine for a model and can keep it."""
SLOW_TO_BUILD: frozenset[Provider] = frozenset({"tensorrt"})
"""Providers that take minutes for an engine, and build another for each new shape of input: never in flight."""
_STAMP = "shapes.json"

Shapes = Mapping[str, Sequence[int]]
"""Shapes by the names of a model's inputs."""


def engines_folder(config: PerceptionConfig) -> Path:
    """The folder of a configuration's engines."""
    return Path(config.engines_dir) if config.engines_dir else models_folder(config) / "engines"


def engine_folder(engines: Path | None, provider: Provider, name: str, sha256: str) -> Path | None:
    """The folder of a model's engines for one provider and this version of its library; None: it keeps no engines."""
    if engines is None or provider not in BUILD_ENGINES:
        return None
    version = importlib.metadata.version("openvino") if provider == "openvino" else ort.__version__
    return engines / f"{name}-{sha256[:16]}-{provider}-{version}"


def available() -> tuple[Provider, ...]:
    """Providers of the installed libraries."""
    found = ort.get_available_providers()
    of_onnx_runtime = tuple(provider for provider, name in EXECUTION_PROVIDERS.items() if name in found)
    return (*of_onnx_runtime, "openvino") if importlib.util.find_spec("openvino") else of_onnx_runtime


def provider_of(manifest: Manifest, wanted: Provider) -> Provider:
    """The provider that computes a model if ``wanted`` is configured.

    Instead of OpenVINO, ONNX Runtime on the CPU computes models for crops: it is faster at batches of changing size.
    """
    takes_batches = any(isinstance(spec.shape[0], str) for spec in manifest.inputs.values())
    return "cpu" if wanted == "openvino" and takes_batches else wanted


def open_runtime(file: ManifestFile, *, threads: int, provider: Provider, folder: Path | None) -> Runtime:
    """Opens the model with exactly this provider; its engines are in ``folder``.

    Raises ModelError if the provider cannot be used, and UnavailableError without enough memory.
    """
    if provider not in available():
        missing, instead = "OpenVINO is not installed", "flockd[openvino]"
        if provider != "openvino":
            missing = f"this ONNX Runtime has no {EXECUTION_PROVIDERS[provider]}"
            instead = "onnxruntime-gpu in its place"
        raise ModelError(f"perception.provider: {missing}; install {instead}, or write {' or '.join(available())}")
    try:
        if provider == "openvino":
            return OpenVino(file.model, threads, folder)
        session = _session(file, threads, provider, folder)
    except Exception as error:  # noqa: BLE001 - the libraries' own exception types are private
        if (lacking := shortage_of(error)) is not None:
            raise UnavailableError(f"{file.model} cannot be loaded: out of {lacking}; raise the limits") from None
        reason = str(error).splitlines()[0]
        if provider == "cpu":
            raise file.error(("file",), f"{file.model} cannot be loaded ({reason}); restore it") from None
        name = EXECUTION_PROVIDERS.get(provider, OpenVino.provider)
        raise file.error(
            ("file",),
            f"{file.model} cannot be loaded by {name} ({reason}); fix what it says, or write perception.provider: cpu",
        ) from None
    # If a provider's libraries do not load, ONNX Runtime only warns and uses the CPU.
    runtime, wanted = OnnxRuntime(session), EXECUTION_PROVIDERS[provider]
    if runtime.provider != wanted:
        raise ModelError(
            f"perception.provider: {wanted} does not start here, and ONNX Runtime took {runtime.provider} in its "
            f"place; install the libraries that {provider} needs, or write cpu"
        )
    _check_tensors(file, session)
    return runtime


def _check_tensors(file: ManifestFile, session: ort.InferenceSession) -> None:
    """Raises ModelError if the ONNX file's inputs and outputs differ from the manifest's.

    In OpenVINO, which compiles a model for the shapes that it gets, the golden input shows it.
    """
    specs_of: tuple[tuple[str, Mapping[str, InputSpec | OutputSpec], Sequence[ort.NodeArg]], ...] = (
        ("inputs", file.manifest.inputs, session.get_inputs()),
        ("outputs", file.manifest.outputs, session.get_outputs()),
    )
    for key, specs, tensors in specs_of:
        found = {tensor.name: tensor for tensor in tensors}
        unused = key == "inputs" and len(found) > len(specs)  # the model needs every input; outputs may be unused
        if unused or not specs.keys() <= found.keys():
            fault = f"the manifest names {sorted(specs)} but the model file has {sorted(found)}"
            raise file.error((key,), f"{fault}; make them agree")
        for name, spec in specs.items():
            for what, here, there in _misfits(spec, found[name]):
                fault = f"the manifest says {here} but the model file {there}"
                raise file.error((key, name, what), f"{fault}; make them agree")


def _misfits(spec: InputSpec | OutputSpec, tensor: ort.NodeArg) -> Iterator[tuple[str, str, str]]:
    """What differs between a manifest's and a file's tensor. The manifest may fix a size that the file leaves free."""
    dtype = {"tensor(float)": "float32"}.get(tensor.type, tensor.type.removeprefix("tensor(").removesuffix(")"))
    if dtype != spec.dtype:
        yield "dtype", spec.dtype, dtype
    is_output, shape = isinstance(spec, OutputSpec), tensor.shape
    fits = len(shape) == len(spec.shape) and all(
        not isinstance(there, int) or here == there or (is_output and isinstance(here, str))
        for here, there in zip(spec.shape, shape, strict=True)
    )
    if not fits and (shape or not is_output):  # exporters may leave out shapes of outputs
        yield "shape", listed(spec.shape), listed(list(shape))


def _session(file: ManifestFile, threads: int, provider: Provider, folder: Path | None) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.enable_mem_pattern = False  # one block for all tensors takes 30 MB more and is no faster
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    in_8_bits = bool(file.manifest.providers)  # its few float layers gain nothing from another memory layout
    return ort.InferenceSession(
        str(file.model),
        options,
        providers=_providers(provider, folder),
        enable_fallback=0,
        disabled_optimizers=["NchwcTransformer"] if in_8_bits else None,
    )


def _providers(provider: Provider, folder: Path | None) -> list[tuple[str, dict[str, str]]]:
    """Providers with their options, the first one first."""
    # By default, CUDA tries all algorithms at each new shape.
    cuda = (EXECUTION_PROVIDERS["cuda"], {"cudnn_conv_algo_search": "HEURISTIC"})
    options: dict[str, str] = {}
    if provider == "tensorrt":
        if folder is not None:
            options = {
                "trt_engine_cache_enable": "1",
                "trt_engine_cache_path": str(folder),
                "trt_timing_cache_enable": "1",
                "trt_timing_cache_path": str(folder),
            }
        # CUDA runs the layers that TensorRT lacks.
        return [(EXECUTION_PROVIDERS["tensorrt"], options), cuda]
    return [cuda] if provider == "cuda" else [(EXECUTION_PROVIDERS[provider], options)]


@dataclass(frozen=True)
class Prepared:
    """The shapes of inputs that a model's engines were built for; the engines also cover all shapes between them."""

    shapes: Sequence[Shapes]

    @staticmethod
    def load(folder: Path | None) -> Prepared | None:
        """Reads the file that `save` wrote; None: no engines were prepared."""
        stamp = None if folder is None else folder / _STAMP
        return Prepared(json.loads(stamp.read_text(encoding="utf-8"))) if stamp and stamp.is_file() else None

    def save(self, folder: Path) -> None:
        """Writes the shapes beside the engines; call it once they are complete."""
        (folder / _STAMP).write_text(json.dumps(self.shapes), encoding="utf-8")

    def covers(self, shapes: Shapes) -> bool:
        """Whether the engines cover these shapes."""
        for name, shape in shapes.items():
            built = [one.get(name, ()) for one in self.shapes]
            if any(len(one) != len(shape) for one in built):
                return False
            if not all(min(sizes) <= size <= max(sizes) for size, *sizes in zip(shape, *built, strict=True)):
                return False
        return True
