"""What computes the networks: ONNX Runtime's execution providers, and the engines they build ahead of flight."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import onnxruntime as ort

from flockd.core.choices import Provider
from flockd.core.config.perception import PerceptionConfig
from flockd.core.errors import ModelError, UnavailableError, shortage_of
from flockd.flight.inference.manifest_file import ManifestFile, models_folder

EXECUTION_PROVIDERS: dict[Provider, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
}
_PACKAGES = {"cuda": "onnxruntime-gpu", "tensorrt": "onnxruntime-gpu", "openvino": "onnxruntime-openvino"}
_BUILDS: frozenset[Provider] = frozenset({"tensorrt", "openvino"})
"""These build an engine for a model and can keep it."""
_SLOW_TO_BUILD: frozenset[Provider] = frozenset({"tensorrt"})
"""These take minutes for one, and for each new shape of input another: never in flight."""
_STAMP = "prepared.json"

Shapes = Mapping[str, Sequence[int]]
"""By input."""


def engines_folder(config: PerceptionConfig) -> Path:
    """Where a configuration's engines are kept."""
    return Path(config.engines_dir) if config.engines_dir else models_folder(config) / "engines"


def engine_folder(engines: Path | None, provider: Provider, name: str, sha256: str) -> Path | None:
    """Where the engines of one model are, for one provider and this ONNX Runtime; None: it keeps none."""
    if engines is None or provider not in _BUILDS:
        return None
    return engines / f"{name}-{sha256[:16]}-{provider}-{ort.__version__}"


def available() -> tuple[Provider, ...]:
    """What the ONNX Runtime that is installed can compute with."""
    found = ort.get_available_providers()
    return tuple(provider for provider, name in EXECUTION_PROVIDERS.items() if name in found)


def open_session(file: ManifestFile, *, threads: int, provider: Provider, folder: Path | None) -> ort.InferenceSession:
    """A session that runs on the provider that was asked for, with its engines in ``folder``.

    Raises ModelError where that cannot be: never another provider in its place.
    """
    wanted = EXECUTION_PROVIDERS[provider]
    if provider not in available():
        raise ModelError(
            f"perception.provider: this ONNX Runtime has no {wanted}; install {_PACKAGES[provider]} in its place, or "
            f"write {' or '.join(available())}"
        )
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.enable_mem_pattern = False  # one block for all tensors of a run holds 30 MB more and is no faster
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    in_8_bits = file.manifest.providers == ("cpu",)  # the few layers in float gain nothing from a layout of their own
    try:
        session = ort.InferenceSession(
            str(file.model),
            options,
            providers=_providers(provider, threads, folder),
            enable_fallback=0,
            disabled_optimizers=["NchwcTransformer"] if in_8_bits else None,
        )
    except Exception as error:  # noqa: BLE001 - ONNX Runtime's own exception types are private
        if (lacking := shortage_of(error)) is not None:
            raise UnavailableError(f"{file.model} cannot be loaded: out of {lacking}; raise the limits") from None
        reason = str(error).splitlines()[0]
        if provider == "cpu":
            raise file.error(("file",), f"{file.model} cannot be loaded ({reason}); restore it") from None
        raise file.error(
            ("file",),
            f"{file.model} cannot be loaded by {wanted} ({reason}); fix what it says, or write "
            "perception.provider: cpu",
        ) from None
    # Where a provider's libraries do not load, ONNX Runtime only warns and takes the CPU.
    found = session.get_providers()
    if found[0] != wanted:
        raise ModelError(
            f"perception.provider: {wanted} does not start here, and ONNX Runtime took {found[0]} in its place; "
            f"install the libraries that {provider} needs, or write cpu"
        )
    return session


def _providers(provider: Provider, threads: int, folder: Path | None) -> list[tuple[str, dict[str, str]]]:
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
        # What TensorRT has no layer for runs beside it on the GPU.
        return [(EXECUTION_PROVIDERS["tensorrt"], options), cuda]
    if provider == "cuda":
        return [cuda]
    if provider == "openvino":
        options = {"device_type": "CPU", "num_of_threads": str(threads)}
        if folder is not None:
            options["cache_dir"] = str(folder)
    return [(EXECUTION_PROVIDERS[provider], options)]


@dataclass(frozen=True)
class Prepared:
    """The range of input shapes that a model's engines were built for."""

    smallest: Shapes
    largest: Shapes

    @staticmethod
    def load(folder: Path | None) -> Prepared | None:
        """What `save` wrote; None where nothing was prepared."""
        try:
            text = (folder / _STAMP).read_text(encoding="utf-8") if folder else ""
        except OSError:
            return None
        return Prepared(**json.loads(text)) if text else None

    def save(self, folder: Path) -> None:
        """Beside the engines, once they are whole."""
        stamp = {"smallest": _listed(self.smallest), "largest": _listed(self.largest)}
        (folder / _STAMP).write_text(json.dumps(stamp), encoding="utf-8")

    @staticmethod
    def over(shapes: Sequence[Shapes]) -> Prepared:
        """The range that some shapes span."""
        names = shapes[0]
        return Prepared(
            {name: [min(sizes) for sizes in zip(*(s[name] for s in shapes), strict=True)] for name in names},
            {name: [max(sizes) for sizes in zip(*(s[name] for s in shapes), strict=True)] for name in names},
        )

    def covers(self, shapes: Shapes) -> bool:
        """Whether an engine is there for these."""
        return all(
            name in self.smallest
            and len(shape) == len(self.smallest[name])
            and all(
                low <= size <= high
                for low, size, high in zip(self.smallest[name], shape, self.largest[name], strict=True)
            )
            for name, shape in shapes.items()
        )


def _listed(shapes: Shapes) -> dict[str, list[int]]:
    return {name: [int(size) for size in shape] for name, shape in shapes.items()}


def builds_engines(provider: Provider) -> bool:
    """Whether it can do work ahead of flight and keep it."""
    return provider in _BUILDS


def is_slow_to_build(provider: Provider) -> bool:
    """Whether models must be prepared for it before they fly."""
    return provider in _SLOW_TO_BUILD
