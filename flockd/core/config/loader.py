"""Loads a drone's YAML into its typed configuration, or reports all of its faults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeVar

from pydantic import BaseModel, ValidationError

from flockd.core.choices import ROLES
from flockd.core.config.document import Document, Place, Value, read_document
from flockd.core.config.drone import DroneConfig
from flockd.core.config.real_drone import as_flown, outside_envelope
from flockd.core.config.validation_messages import problems_of
from flockd.core.errors import ConfigError, ConfigProblem

PATHS = {("perception", key) for key in ("models_dir", "engines_dir", *ROLES)} | {("telemetry", "zenoh_config")}
"""Keys of a drone whose values are paths; the value of a model's role only if it ends in `.yaml`, else it is a name."""
OVERRIDE = "override"
"""Replaces the file's name in a problem of an override."""

FileKind = Literal["drone", "scenario", "campaign"]
Model = TypeVar("Model", bound=BaseModel)
Overrides = Mapping[str, Value]


_KINDS: Mapping[FileKind, tuple[str, tuple[str, ...]]] = {
    "campaign": ("a campaign", ("campaign", "scenario")),
    "scenario": ("a scenario", ("vehicles", "drone")),
    "drone": ("a drone's own file", ("rig",)),
}
"""The name of each kind of file, and its keys without a default; the first of them is unique to the kind."""


def load_drone(path: Path | str, overrides: Overrides | None = None) -> DroneConfig:
    """The configuration of one drone.

    `overrides` sets single values over the file's, by dotted key: `{"perception.flow": "dis"}`.
    Raises ConfigError with every problem found.
    """
    return validated(DroneConfig, drone_document(Path(path), overrides or {}))


def load_real_drone(path: Path | str) -> tuple[DroneConfig, list[ConfigProblem]]:
    """The configuration that a real drone flies with, with the limits of first flights, and its problems with the safe
    envelope.

    Raises ConfigError with every problem found.
    """
    document = drone_document(Path(path), {})
    config = as_flown(validated(DroneConfig, document))
    return config, outside_envelope(config, document.places)


def kind_of(document: Document) -> FileKind:
    """The kind of a file, by its keys; if that is not clear, a scenario."""
    keys = document.values.keys()
    if not keys & {"scenario", "drone"} and keys <= DroneConfig.model_fields.keys():
        return "drone"
    return next((kind for kind, (_, needed) in _KINDS.items() if needed[0] in keys), "scenario")


def require(document: Document, wanted: FileKind) -> None:
    """Raises ConfigError for a file of another kind, with the file to name instead."""
    kind = kind_of(document)
    words, (own, *_) = _KINDS[kind]
    if kind == wanted or own not in document.values:
        return
    drone, (wanted_words, needed) = document.values.get("drone"), _KINDS[wanted]
    if kind == "campaign":
        hint = "`flockd campaign` flies it"
    elif wanted == "drone" and isinstance(drone, str):
        hint = f"name that: {Path(document.file).parent / drone}"
    else:
        hint = f"name one with the key{'s' * (len(needed) > 1)} `{'` and `'.join(needed)}`"
    raise ConfigError.at(document.file, f"is {words}, and {wanted_words} is needed here; {hint}")


def drone_document(path: Path, overrides: Overrides) -> Document:
    """A drone's file, not validated. Raises ConfigError if it cannot be read or is of another kind."""
    document = read_document(path)
    require(document, "drone")
    override(document, overrides)
    return document


def _anchor(document: Document) -> None:
    """Makes relative paths absolute: they start at the folder of their file, whatever the working directory.

    Paths of overrides stay relative to the working directory.
    """
    for path, place in document.places.items():
        section: Value = document.values
        for part in path[:-1]:
            section = section.get(str(part)) if isinstance(section, dict) else None
        if path[-2:] not in PATHS or place.file == OVERRIDE or not isinstance(section, dict):
            continue
        written, key = section.get(str(path[-1])), str(path[-1])
        if isinstance(written, str) and (key not in ROLES or written.endswith(".yaml")):
            section[key] = str((Path(place.file).parent / written).resolve())


def override(document: Document, overrides: Overrides) -> None:
    """Sets single values; their problems name the override, not the file. Raises ConfigError for an entry of a list."""
    for key, value in overrides.items():
        path = tuple(key.split("."))
        values = document.values
        for length in range(1, len(path)):
            document.places.setdefault(path[:length], replace(document.places[path[: length - 1]], key=key))
            inner = values.setdefault(path[length - 1], {})
            if isinstance(inner, list | tuple):
                told = f"{'.'.join(path[:length])} is a list, whose entries cannot be set one by one; write all of it"
                raise ConfigError([ConfigProblem(OVERRIDE, 0, key, told)])
            if not isinstance(inner, dict):
                break  # not a section: validation reports it
            values = inner
        else:
            values[path[-1]] = value
            document.places[path] = Place(OVERRIDE, 0, key, "")


def validated(model: type[Model], document: Document) -> Model:
    """The file as its type. Raises ConfigError with every problem found."""
    _anchor(document)
    try:
        config = model.model_validate(document.values)
    except ValidationError as error:
        problems = problems_of(error.errors(), model, document.places)
        # An unreadable value was reported already: it is not also reported as missing.
        told = {(one.line, one.key) for one in document.problems}
        fresh = [one for one in problems if (one.line, one.key) not in told]
        raise ConfigError([*document.problems, *fresh]) from error
    if document.problems:
        raise ConfigError(document.problems)
    return config
