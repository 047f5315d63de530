"""One ONNX model in memory; its file, provider and golden output are checked when it is opened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockd.core.choices import Provider
from flockd.core.messages import Float32Array, UInt8Array
from flockd.flight.inference.checks import (
    Deadline,
    cannot_run,
    check_golden,
    check_tensors,
    no_deadline,
)
from flockd.flight.inference.feeds import golden_feeds, shapes_of
from flockd.flight.inference.fitting import entering, leaving
from flockd.flight.inference.manifest_file import Check, ManifestFile, nothing_more, read_manifest
from flockd.flight.inference.providers import (
    SLOW_TO_BUILD,
    Prepared,
    Shapes,
    engine_folder,
    open_runtime,
    provider_of,
)


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
        check: Check = nothing_more,
        deadline: Deadline = no_deadline,
    ) -> None:
        """Opens and checks the model. Raises ModelError with file, line, key and what to do.

        Args:
            path: the manifest.
            threads: for one run on the CPU.
            provider: computes the model, with the exception of crops (`provider_of`); it is never replaced silently.
            engines: the folder of engines.
            preparing: whether a provider that is slow to build engines may do so now.
            check: further requirements of the manifest.
            deadline: for the run on the golden input.
        """
        file = read_manifest(path, check)
        file.check_model()
        self.manifest = file.manifest
        self._refuse_provider(file, provider)
        provider = provider_of(self.manifest, provider)
        self._engines = engine_folder(engines, provider, self.manifest.name, self.manifest.sha256)
        self._prepared = Prepared.load(self._engines)
        self._may_build = preparing or provider not in SLOW_TO_BUILD
        if not self._may_build and self._prepared is None:
            message = f"is not prepared for {provider}, which would build its engine for minutes"
            raise file.error(("file",), f"{self.manifest.file} {message}; run `flockd models prepare` first")
        if self._engines is not None:
            self._engines.mkdir(parents=True, exist_ok=True)
        self._runtime = open_runtime(file, threads=threads, provider=provider, folder=self._engines)
        check_tensors(file, self._runtime.inputs, self._runtime.outputs)
        self._check_golden(file, provider, deadline)

    @property
    def provider(self) -> str:
        """The provider that computes it, as the library reports; see `provider_of`."""
        return self._runtime.provider

    @property
    def engines(self) -> Path | None:
        """The folder of its engines; None: its provider builds none."""
        return self._engines

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

    def infer(self, contents: Mapping[str, Sequence[UInt8Array] | Float32Array]) -> dict[str, Float32Array]:
        """The outputs by their content, in their units; ``contents`` has the inputs by theirs.

        Images are (h, w, 3) RGB of the input's size, planes (n, c, h, w). Raises as ``run`` does.
        """
        feeds = {}
        for name, spec in self.manifest.inputs.items():
            content = contents[spec.carries or name]
            feeds[name] = content if isinstance(content, np.ndarray) else entering(spec, content)
        specs = self.manifest.outputs
        return {specs[name].gives or name: leaving(specs[name], value) for name, value in self.run(feeds).items()}

    def keep_engines(self, shapes: Sequence[Shapes]) -> None:
        """Records that the engines in the folder cover these shapes and all between them."""
        if self._engines is not None:
            Prepared(shapes).save(self._engines)

    def terminate(self) -> None:
        """Ends the current runs, from any thread; they raise errors of the library."""
        self._runtime.terminate()

    def _refuse_provider(self, file: ManifestFile, provider: Provider) -> None:
        made_for = self.manifest.providers
        if made_for and provider not in made_for:
            raise file.error(
                ("providers",),
                f"{self.manifest.name} is made for {' and '.join(made_for)}, not for {provider}; name another model "
                "(flockd's own without _int8 are made for any), or another perception.provider",
            )

    def _check_golden(self, file: ManifestFile, provider: Provider, deadline: Deadline) -> None:
        outputs: dict[str, NDArray[Any]] = {}
        try:
            deadline(lambda: outputs.update(self.run(golden_feeds(self.manifest))), self.terminate)
        except Exception as error:  # noqa: BLE001 - the libraries' own exception types are private
            raise cannot_run(file, self.provider, error) from None
        check_golden(file, provider, outputs)
