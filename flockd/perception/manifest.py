"""What a model file is: one YAML manifest beside each ONNX file, checked before anything runs."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import Field, ValidationError

from flockd.config.parameters import PerceptionConfig, Positive, Section
from flockd.data import data_path
from flockd.errors import ModelError

Role = Literal["flow", "depth", "segmentation", "distance"]


class InputSpec(Section):
    """One input of the network."""

    shape: tuple[int | str, ...]
    dtype: Literal["uint8", "float32"]
    meaning: Annotated[str, Field(min_length=1)]
    unit: Annotated[str, Field(min_length=1)]


class OutputSpec(InputSpec):
    """One output of the network, and how the golden input's answer is recognised."""

    golden_mean: float
    golden_deviation: float


class Manifest(Section):
    """All that is known about one model."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]+$")]
    roles: Annotated[tuple[Role, ...], Field(min_length=1)]
    file: str
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    description: str
    image_scale: Positive = 1.0
    """The images are resized by this factor before they enter."""
    size_multiple: Annotated[int, Field(ge=1)] = 1
    """Height and width that enter are padded to a multiple of this."""
    inputs: dict[str, InputSpec]
    outputs: dict[str, OutputSpec]
    golden_size: tuple[int, int]
    """Width and height of the golden input image."""
    licence: str
    data: str
    accuracy: dict[str, str]
    command: str
    """The command that made it."""


def load_manifest(path: Path) -> tuple[Manifest, Path]:
    """The manifest at ``path`` and its model file's path, hash checked; ``ModelError`` in one sentence otherwise."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ModelError(f"{path}: cannot read the model's manifest ({error.strerror}); name one that exists") from None
    try:
        manifest = Manifest.model_validate_json(
            json.dumps(yaml.safe_load(text))
        )  # JSON: lists may be tuples, all else strict
    except yaml.YAMLError as error:
        raise ModelError(f"{path}: not a YAML file ({str(error).splitlines()[0]}); restore the manifest") from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "the file"
        raise ModelError(f"{path}: {key}: {first['msg']}; restore the manifest or mend this key") from None
    model = path.parent / manifest.file
    check_hash(manifest, model, path)
    return manifest, model


def check_hash(manifest: Manifest, model: Path, path: Path) -> None:
    """``ModelError`` when the model file is missing or differs from the manifest's SHA-256."""
    try:
        digest = hashlib.sha256(model.read_bytes()).hexdigest()
    except OSError as error:
        raise ModelError(
            f"{path}: file: cannot read {model} ({error.strerror}); put the model file back or name the right one"
        ) from None
    if digest != manifest.sha256:
        raise ModelError(
            f"{path}: sha256: {model} has {digest[:12]}... and not {manifest.sha256[:12]}..., so the model file was "
            "changed or damaged; restore it, or export it again with its manifest"
        )


def models_folder(config: PerceptionConfig) -> Path:
    """Where a configuration's models are known by their names: its own folder, else the one that comes with flockd.

    Raises ModelError when its own is not there.
    """
    if config.models_dir is None:
        return data_path("models")
    folder = Path(config.models_dir)
    if not folder.is_dir():
        raise ModelError(f"perception.models_dir: {folder} is no folder; name the one that holds the models' manifests")
    return folder


def manifest_path(folder: Path, name: str) -> Path:
    """Of a model by its name in a folder, or of one that is named by its manifest's path."""
    return Path(name) if name.endswith(".yaml") else folder / f"{name}.yaml"


def manifests_of(config: PerceptionConfig) -> tuple[Path, ...]:
    """The manifests of all models that a configuration names, each once. Raises ModelError for a missing folder."""
    names = (config.flow, config.depth, config.segmentation, config.distance)
    folder = models_folder(config)
    return tuple(dict.fromkeys(manifest_path(folder, name) for name in names if name not in {"dis", "none"}))


def find_manifests(folder: Path) -> tuple[Path, ...]:
    """All manifests in a folder, by name."""
    return tuple(sorted(folder.glob("*.yaml")))
