"""One ONNX model in memory; its file, provider and golden output are checked when it is opened."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockd.core.choices import Provider
from flockd.core.errors import FlockdError, UnavailableError, shortage_of
from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.inference.feeds import golden_feeds, shapes_of
from flockd.flight.inference.fitting import entering, leaving
from flockd.flight.inference.manifest_file import ManifestFile, read_manifest
from flockd.flight.inference.providers import (
    SLOW_TO_BUILD,
    Prepared,
    engine_folder,
    open_runtime,
    provider_of,
)

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
        deadline: Deadline = no_deadline,
    ) -> None:
        """Opens and checks the model. Raises ModelError with file, line, key and what to do.

        Args:
            path: the manifest.
            threads: for one run on the CPU.
            provider: computes the model, with the exception of crops (`provider_of`); it is never replaced silently.
            engines: the folder of engines.
            preparing: whether a provider that is slow to build engines may do so now.
            deadline: for the run on the golden input.
        """
        file = read_manifest(path)
        file.check_model()
        self.manifest = file.manifest
        made_for = self.manifest.providers
        if made_for and provider not in made_for:
            raise file.error(
                ("providers",),
                f"{self.manifest.name} is made for {' and '.join(made_for)}, not for {provider}; name another model "
                "(flockd's own without _int8 are made for any), or another perception.provider",
            )
        provider = provider_of(self.manifest, provider)
        self.engines = engine_folder(engines, provider, self.manifest.name, self.manifest.sha256)
        """The folder of its engines; None: its provider builds none."""
        self._prepared = Prepared.load(self.engines)
        self._may_build = preparing or provider not in SLOW_TO_BUILD
        if not self._may_build and self._prepared is None:
            message = f"is not prepared for {provider}, which would build its engine for minutes"
            raise file.error(("file",), f"{self.manifest.file} {message}; run `flockd models prepare` first")
        if self.engines is not None:
            self.engines.mkdir(parents=True, exist_ok=True)
        self._runtime = open_runtime(file, threads=threads, provider=provider, folder=self.engines)
        self._check_golden(file, provider, deadline)

    @property
    def provider(self) -> str:
        """The provider that computes it, as the library reports; see `provider_of`."""
        return self._runtime.provider

    def run(self, feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The outputs by name.

        Raises FloatingPointError if one is not finite, and ValueError for inputs of a shape without an engine.
        """
        if not self._may_build and not (self._prepared and self._prepared.covers(shapes_of(feeds))):
            raise ValueError(f"model {self.manifest.name} is not prepared for inputs of {shapes_of(feeds)}")
        names = list(self.manifest.outputs)
        outputs = dict(zip(names, self._runtime.run(names, feeds), strict=True))
        for name, value in outputs.items():
            if not np.isfinite(value).all():
                raise FloatingPointError(f"model {self.manifest.name}: output {name} is not finite")
        return outputs

    def infer(self, contents: Mapping[str, Sequence[UInt8Array] | NDArray[Any]]) -> dict[str, Float32Array]:
        """The outputs by their content, in their units; ``contents`` has the inputs by theirs.

        Images are n times (h, w, 3) RGB of the input's size, planes (n, c, h, w). Raises as ``run`` does.
        """
        feeds = {}
        for name, spec in self.manifest.inputs.items():
            content = contents[spec.carries or name]
            feeds[name] = np.asarray(content) if spec.kind == "planes" else entering(spec, content)
        specs = self.manifest.outputs
        return {specs[name].gives or name: leaving(specs[name], value) for name, value in self.run(feeds).items()}

    def terminate(self) -> None:
        """Ends the current runs, from any thread; they raise errors of the library."""
        self._runtime.terminate()

    def _check_golden(self, file: ManifestFile, provider: Provider, deadline: Deadline) -> None:
        """Raises ModelError if mean or deviation of an output for the golden input differs from the manifest's."""
        outputs: dict[str, NDArray[Any]] = {}
        try:
            deadline(lambda: outputs.update(self.run(golden_feeds(self.manifest))), self.terminate)
        except Exception as error:  # noqa: BLE001 - the libraries' own exception types are private
            raise cannot_run(file, self.provider, error) from None
        made_for = self.manifest.providers
        tolerance = _GOLDEN_TOLERANCE if not made_for or made_for[0] == provider else _ROUNDED_TOLERANCE
        for name, spec in self.manifest.outputs.items():
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
