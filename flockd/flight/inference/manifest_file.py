"""A manifest's YAML file, read as strictly as a configuration, and the model file that it names."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from pydantic import ValidationError

from flockd.core.choices import Role
from flockd.core.config.document import Place, key_text, read_document
from flockd.core.config.perception import DIS, NO_MODEL, PerceptionConfig
from flockd.core.config.validation_messages import problems_of
from flockd.core.data import data_path
from flockd.core.errors import ConfigError, ConfigProblem, ModelError, shortage_of
from flockd.flight.inference.manifest import Key, Manifest
from flockd.flight.inference.requirements import check_roles

MAX_MODEL_BYTES = 2 << 30
"""Largest protobuf, and so the largest ONNX file without external weights."""


@dataclass(frozen=True)
class ManifestFile:
    """A manifest, with the line of each of its keys for errors found later."""

    path: Path
    manifest: Manifest
    places: Mapping[Key, Place]

    @property
    def model(self) -> Path:
        """The ONNX file."""
        return self.path.parent / self.manifest.file

    def error(self, key: Key, message: str) -> ModelError:
        """An error with file, line, key and message; the line of a missing key is that of its section."""
        section = key
        while section not in self.places:
            section = section[:-1]
        return ModelError(str(ConfigProblem(str(self.path), self.places[section].line, key_text(key), message)))

    def check_model(self) -> None:
        """Raises ModelError if the ONNX file is missing or differs from the manifest's SHA-256."""
        model, wanted = self.model, self.manifest.sha256
        try:
            if model.exists() and not model.is_file():
                raise self.error(("file",), f"{model} is not an ordinary file; name the ONNX file")
            if model.stat().st_size > MAX_MODEL_BYTES:
                raise self.error(("file",), f"{model} is larger than 2 GiB, which no ONNX file is; name the right one")
            content = model.read_bytes()
        except OSError as error:
            if shortage_of(error):
                raise
            reason = f"cannot read {model} ({error.strerror})"
            raise self.error(("file",), f"{reason}; put the model file back or name the right one") from None
        digest = hashlib.sha256(content).hexdigest()
        if digest != wanted:
            raise self.error(
                ("sha256",),
                f"{model} has {digest[:12]}... and not {wanted[:12]}..., so the model file was changed or damaged; "
                "restore it, or export it again with its manifest",
            )


def read_manifest(path: Path) -> ManifestFile:
    """The manifest at ``path``; its model file is not opened.

    Raises ModelError with the first thing wrong: one sentence with file, line, key, value and what to do.
    """
    try:
        document = read_document(path, "manifest")
        manifest = Manifest.model_validate(document.values)
    except ConfigError as error:
        raise ModelError(str(error.problems[0])) from None
    except ValidationError as error:
        problems = document.problems or problems_of(error.errors(), Manifest, document.places)
        raise ModelError(str(min(problems))) from None
    if document.problems:
        raise ModelError(str(min(document.problems)))
    file = ManifestFile(path, manifest, document.places)
    for key, message in chain(manifest.faults(), check_roles(manifest)):
        raise file.error(key, message)
    return file


def load_manifest(path: Path) -> tuple[Manifest, Path]:
    """The manifest at ``path`` and its model file's path, hash checked. Raises ModelError; see `read_manifest`."""
    file = read_manifest(path)
    file.check_model()
    return file.manifest, file.model


def models_folder(config: PerceptionConfig) -> Path:
    """The folder of a configuration's models: `perception.models_dir`, else the folder that comes with flockd.

    Raises ModelError if `perception.models_dir` does not exist.
    """
    if config.models_dir is None:
        return data_path("models")
    folder = Path(config.models_dir)
    if not folder.is_dir():
        raise ModelError(f"perception.models_dir: {folder} is no folder; name the one that holds the models' manifests")
    return folder


def manifest_path(folder: Path, name: str) -> Path:
    """The path of a model's manifest; ``name`` is a name in the folder, or the path itself, which ends in `.yaml`."""
    return Path(name) if name.endswith(".yaml") else folder / f"{name}.yaml"


def manifests_of(config: PerceptionConfig) -> tuple[Path, ...]:
    """The manifests of all models that a configuration names, each once. Raises ModelError for a missing folder."""
    folder = models_folder(config)
    return tuple(dict.fromkeys(manifest_path(folder, name) for name in config.networks.values()))


def models_for(role: Role, folder: Path) -> tuple[str, ...]:
    """Names in a folder of models that fill a role, and the words that may replace a model, for people."""
    found = []
    for path in find_manifests(folder):
        try:
            if role in read_manifest(path).manifest.roles:
                found.append(path.stem)
        except ModelError:
            continue  # a command that names this model reports the error
    return (*found, *_WITHOUT_MODEL.get(role, ()))


_WITHOUT_MODEL: Mapping[str, tuple[str, ...]] = {
    "flow": (DIS,), "detector": (NO_MODEL,), "verification": (NO_MODEL,)
}  # fmt: skip


def find_manifests(folder: Path) -> tuple[Path, ...]:
    """All manifests in a folder, by name."""
    return tuple(sorted(folder.glob("*.yaml")))


def model_hashes(perception: PerceptionConfig) -> dict[str, str]:
    """SHA-256 of each model that a configuration uses, by its manifest's `name`. Raises ModelError."""
    manifests = [load_manifest(path)[0] for path in sorted(manifests_of(perception))]
    return {manifest.name: manifest.sha256 for manifest in manifests}
