"""Checks that a model file agrees with its manifest: its tensors, and its outputs for the golden input."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from numpy.typing import NDArray

from flockd.core.choices import Provider
from flockd.core.errors import FlockdError, UnavailableError, shortage_of
from flockd.flight.inference.manifest import Fault, InputSpec, Manifest, OutputSpec, listed
from flockd.flight.inference.manifest_file import ManifestFile

_GOLDEN_TOLERANCE = 0.02
"""Largest difference of mean and deviation: providers round differently."""
_ROUNDED_TOLERANCE = 0.05
"""The same for a network in 8 bits on another provider than the first in its manifest, as layers round differently."""

Deadline = Callable[[Callable[[], None], Callable[[], None]], None]
"""Runs the first function; if it takes too long, calls the second, which stops it, and raises TimeoutError.

This folder has no clock: the caller that opens a model passes a deadline.
"""


def no_deadline(work: Callable[[], None], stop: Callable[[], None]) -> None:
    """Runs ``work``, however long it takes."""
    work()


class Tensor(Protocol):
    """An input or an output as ONNX Runtime describes it."""

    name: str
    type: str
    shape: Sequence[int | str | None]


def check_tensors(file: ManifestFile, inputs: Sequence[Tensor], outputs: Sequence[Tensor]) -> None:
    """Raises ModelError if the ONNX file's inputs and outputs differ from the manifest's."""
    for fault in _misfits(file.manifest, {t.name: t for t in inputs}, {t.name: t for t in outputs}):
        raise file.error(fault.key, f"{fault.message}; make them agree")


def _misfits(manifest: Manifest, inputs: Mapping[str, Tensor], outputs: Mapping[str, Tensor]) -> Iterator[Fault]:
    # The model needs every input; outputs may be unused.
    for key, wanted, found, fits in (
        ("inputs", manifest.inputs, inputs, set(manifest.inputs) == set(inputs)),
        ("outputs", manifest.outputs, outputs, set(manifest.outputs) <= set(outputs)),
    ):
        if not fits:
            yield Fault((key,), f"the manifest names {sorted(wanted)} but the model file has {sorted(found)}")
    for key, specs, tensors in (("inputs", manifest.inputs, inputs), ("outputs", manifest.outputs, outputs)):
        for name, spec in specs.items():
            fault = _misfit(spec, tensors[name].type, tensors[name].shape)
            if fault:
                yield Fault((key, name, *fault.key), fault.message)


def _misfit(spec: InputSpec | OutputSpec, type_: str, shape: Sequence[int | str | None]) -> Fault | None:
    """The difference between a manifest's and a model file's tensor. The manifest may fix a size that the file leaves
    free."""
    of_file = {"tensor(float)": "float32"}.get(type_, type_.removeprefix("tensor(").removesuffix(")"))
    if of_file != spec.dtype:
        return Fault(("dtype",), f"the manifest says {spec.dtype} but the model file {of_file}")
    if isinstance(spec, OutputSpec) and not shape:
        return None  # exporters may leave out shapes of outputs
    may_be_free = isinstance(spec, OutputSpec)
    if len(shape) == len(spec.shape) and all(
        not isinstance(there, int) or here == there or (may_be_free and isinstance(here, str))
        for here, there in zip(spec.shape, shape, strict=True)
    ):
        return None
    return Fault(("shape",), f"the manifest says {listed(spec.shape)} but the model file {listed(list(shape))}")


def check_golden(file: ManifestFile, provider: Provider, outputs: Mapping[str, NDArray[Any]]) -> None:
    """Raises ModelError if mean or deviation of an output for the golden input differs from the manifest's."""
    made_for = file.manifest.providers
    tolerance = _GOLDEN_TOLERANCE if not made_for or made_for[0] == provider else _ROUNDED_TOLERANCE
    for name, spec in file.manifest.outputs.items():
        found, expected = (outputs[name].mean(), outputs[name].std()), (spec.golden_mean, spec.golden_deviation)
        allowed = tolerance * (abs(spec.golden_mean) + spec.golden_deviation) + 1e-6
        if not all(abs(one - other) <= allowed for one, other in zip(found, expected, strict=True)):
            said, wanted = ("mean {:.4g} and deviation {:.4g}".format(*pair) for pair in (found, expected))
            difference = f"the golden input gives {said}, not {wanted}"
            raise file.error(("outputs", name), f"{difference}; export the model and its manifest together")


def cannot_run(file: ManifestFile, provider: str, error: Exception) -> FlockdError:
    """The error for a model that does not run on the golden input."""
    if (lacking := shortage_of(error)) is not None:
        return UnavailableError(f"{file.model} cannot be run: out of {lacking}; raise the limits")
    if isinstance(error, TimeoutError):
        return file.error(
            ("file",),
            f"{file.manifest.file} did not finish the golden input in time ({error}); restore the model file or "
            "choose another perception.provider",
        )
    if isinstance(error, FloatingPointError):
        return file.error(("file",), f"{error} on the golden input; restore the model file")
    reason = str(error).splitlines()[0].rpartition("Status Message: ")[2].rpartition("] ")[2]
    return file.error(
        ("file",),
        f"{provider} cannot run {file.manifest.file} ({reason}); choose another perception.provider or restore the "
        "model file",
    )
