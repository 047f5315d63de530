"""Loads a drone's or a scenario's YAML into its typed configuration, or says everything that is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ValidationError

from flockd.core.choices import ROLES
from flockd.core.config.campaign import CampaignConfig
from flockd.core.config.document import Document, KeyPath, Place, Value, read_document
from flockd.core.config.drone import DroneConfig
from flockd.core.config.envelope import outside_envelope
from flockd.core.config.first_flight import as_flown
from flockd.core.config.perceived import PerceivedErrors
from flockd.core.config.scenario import ScenarioConfig
from flockd.core.config.validation_messages import path_in_file, problems_of
from flockd.core.errors import ConfigError, ConfigProblem

PATHS = {("perception", key) for key in ("models_dir", "engines_dir", *ROLES)} | {("telemetry", "zenoh_config")}
"""Keys of a drone whose values are paths; of a model's role only where it ends in `.yaml`, else it is a name."""
_BESIDE_DRONE = ("mission", "obstacles")
"""Sections of a drone that its scenario may have instead."""
OVERRIDE = "override"
"""Stands where else a file's name does."""

FileKind = Literal["drone", "scenario", "campaign"]
Model = TypeVar("Model", bound=BaseModel)
Overrides = Mapping[str, Value]


def load_drone(path: Path | str, overrides: Overrides | None = None) -> DroneConfig:
    """The configuration of one drone.

    `overrides` sets single values over the file's, by dotted key: `{"perception.flow": "dis"}`.
    Raises ConfigError with every problem found.
    """
    return validated(DroneConfig, _drone_document(Path(path), overrides or {}))


def load_real_drone(path: Path | str) -> tuple[DroneConfig, list[ConfigProblem]]:
    """What a real drone flies with, first flights' limits included, and where that is outside the proven envelope.

    Raises ConfigError with every problem found.
    """
    document = _drone_document(Path(path), {})
    config = as_flown(validated(DroneConfig, document))
    return config, outside_envelope(config, document.places)


def load_scenario(path: Path | str, overrides: Overrides | None = None) -> ScenarioConfig:
    """The configuration of one simulated flight, with the drone's file that its key `drone` names merged into it.

    `overrides` sets single values over the files', by dotted key: `{"seed": 3, "drone.perception.flow": "dis"}`.
    Raises ConfigError with every problem found in both files.
    """
    return validated(ScenarioConfig, _scenario_document(Path(path), overrides or {}))


def load_perceived_errors(path: Path | str) -> PerceivedErrors:
    """How perception errs, as `tools.training.fit_perception` writes it. Raises ConfigError with every problem
    found."""
    return validated(PerceivedErrors, read_document(Path(path)))


def load(path: Path | str) -> DroneConfig | ScenarioConfig:
    """A drone's or a scenario's configuration, whichever the file's keys belong to. Raises ConfigError."""
    return load_with_places(path)[0]


def kind_of(path: Path | str) -> FileKind:
    """Whose file it is, by its keys. Raises ConfigError where nothing can be read from it."""
    return _kind(read_document(Path(path)))


def load_with_places(path: Path | str) -> tuple[DroneConfig | ScenarioConfig, Mapping[KeyPath, Place]]:
    """The same, with the place of each value in the file, for checks of more than the file. Raises ConfigError."""
    path = Path(path)
    kind = kind_of(path)
    if kind == "drone":
        document = _drone_document(path, {})
        return validated(DroneConfig, document), document.places
    document = _scenario_document(path, {})
    return validated(ScenarioConfig, document), document.places


def load_campaign(path: Path | str) -> tuple[CampaignConfig, Mapping[KeyPath, Place]]:
    """A campaign's file, and the place of each value in it; of its scenario only the path. Raises ConfigError."""
    document = read_document(Path(path), "campaign")
    if "campaign" not in document.values and (kind := _kind(document)) != "campaign":
        fault = f"is {_KINDS[kind]}, and a campaign is needed here; name one with the keys `campaign` and `scenario`"
        raise ConfigError.at(path, fault)
    return validated(CampaignConfig, document), document.places


def fault_of(model: type[BaseModel], key: str, value: Value) -> str | None:
    """What is wrong with one value of a section, whatever its other keys are; None: nothing."""
    places: dict[KeyPath, Place] = {(): Place("", 0, "", ""), (key,): Place("", 0, key, "")}
    try:
        model.model_validate({key: value})
    except ValidationError as error:
        of_key = [detail for detail in error.errors() if detail["loc"][:1] == (key,)]
        return next((problem.message for problem in problems_of(of_key, model, places)), None)
    return None


def schema_of(kind: FileKind) -> dict[str, Any]:
    """The JSON schema of a configuration file, for editors and other tools."""
    if kind != "scenario":
        return (DroneConfig if kind == "drone" else CampaignConfig).model_json_schema()
    schema = ScenarioConfig.model_json_schema()
    drone = schema["properties"]["drone"]
    inline = {"$ref": drone.pop("$ref")}
    schema["properties"]["drone"] = {"title": "Drone", **drone, "anyOf": [{"type": "string"}, inline]}
    of_all = "Of all vehicles without one of their own, instead of that in `drone`."
    schema["properties"]["mission"] = {"$ref": "#/$defs/MissionParameters", "description": of_all}
    schema["properties"]["obstacles"] = {"$ref": "#/$defs/ObstacleParameters", "description": "Instead of `drone`'s."}
    return schema


def _kind(document: Document) -> FileKind:
    """Whichever the keys belong to; a scenario, where that is not clear."""
    kinds: dict[FileKind, type[BaseModel]] = {
        "scenario": ScenarioConfig, "drone": DroneConfig, "campaign": CampaignConfig,
    }  # fmt: skip
    return max(kinds, key=lambda kind: len(document.values.keys() & kinds[kind].model_fields.keys()))


_KINDS: Mapping[FileKind, str] = {"drone": "a drone's own file", "scenario": "a scenario", "campaign": "a campaign"}


def _refuse_campaign(document: Document, wanted: FileKind) -> None:
    if "campaign" in document.values and _kind(document) == "campaign":
        fault = f"is a campaign, and {_KINDS[wanted]} is needed here; `flockd campaign` flies it"
        raise ConfigError.at(document.file, fault)


def _drone_document(path: Path, overrides: Overrides) -> Document:
    document = read_document(path)
    _refuse_campaign(document, "drone")
    if document.values.keys() & {"scenario", "vehicles"} and _kind(document) == "scenario":
        drone = document.values.get("drone")
        hint = f"{path.parent / drone}" if isinstance(drone, str) else "one with the key `rig`"
        fault = f"is a scenario, and a drone's own file is needed here; name that: {hint}"
        raise ConfigError.at(path, fault)
    _override(document, overrides)
    return document


def _scenario_document(path: Path, overrides: Overrides) -> Document:
    document = read_document(path)
    _refuse_campaign(document, "scenario")
    if "rig" in document.values and _kind(document) == "drone":
        fault = "is a drone's own file, and a scenario is needed here; name one with the keys `vehicles` and `drone`"
        raise ConfigError.at(path, fault)
    _merge_drone(document, path.parent)
    for key in _BESIDE_DRONE:
        _merge_section(document, key)
    _override(document, overrides)
    return document


def _merge_drone(document: Document, folder: Path) -> None:
    """Puts the drone's values and places where the scenario's file names the drone's file.

    A scenario may also hold the drone's values itself, as `flockd config show` prints them.
    """
    key = ("drone",)
    if key in document.spoiled:
        return
    place = document.places.get(key, replace(document.places[()], key="drone"))
    name = document.values.get("drone")
    if isinstance(name, dict):
        return
    if not isinstance(name, str) or not name:
        fault = "must be the path of the drone's own YAML file" if "drone" in document.values else "is missing"
        document.problems.append(place.problem(f"{fault}; write it as in `drone: simulator.yaml`"))
        document.spoiled.add(key)
        return
    try:
        drone = _drone_document(folder / name, {})
    except ConfigError as error:
        document.problems.append(place.problem(f"names {name}, which cannot be used; correct it or name another"))
        document.problems.extend(error.problems)
        document.spoiled.add(key)
        return
    document.values["drone"] = drone.values
    document.places.update({(*key, *path): place for path, place in drone.places.items()})
    document.problems.extend(drone.problems)
    document.spoiled.update((*key, *path) for path in drone.spoiled)


def _merge_section(document: Document, key: str) -> None:
    """Puts a scenario's section in place of its drone's, with its places: one drone's file flies many missions."""
    drone = document.values.get("drone")
    if ("drone",) in document.spoiled:
        document.values.pop(key, None)  # what it would be put into is not known, which is told already
        return
    if not isinstance(drone, dict) or key not in document.values:
        return
    section = document.values.pop(key)
    old = [path for path in document.places if path[:2] == ("drone", key)]
    for path in old:
        del document.places[path]
    document.spoiled -= {path for path in document.spoiled if path[:2] == ("drone", key)}
    of_scenario = [path for path in document.places if path[:1] == (key,)]
    document.places.update({("drone", *path): document.places.pop(path) for path in of_scenario})
    document.spoiled |= {("drone", *path) for path in document.spoiled if path[:1] == (key,)}
    document.values["drone"] = {**drone, key: section}


def _anchor(document: Document) -> None:
    """Makes relative paths absolute: they count from the folder of the file they stand in, wherever flockd is run.

    Those of an override stay as they are, for its writer to know what they count from.
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


def _override(document: Document, overrides: Overrides) -> None:
    """Sets single values; a problem with one names the override, not the file."""
    for key, value in overrides.items():
        path = tuple(key.split("."))
        if _is_under(path[:-1], document.spoiled):
            continue
        values = document.values
        for length in range(1, len(path)):
            document.places.setdefault(path[:length], replace(document.places[path[: length - 1]], key=key))
            inner = values.setdefault(path[length - 1], {})
            if not isinstance(inner, dict):
                break  # not a section: validation reports it
            values = inner
        else:
            values[path[-1]] = value
            document.places[path] = Place(OVERRIDE, 0, key, "")
            document.spoiled.discard(path)


def validated(model: type[Model], document: Document) -> Model:
    """The file as its type. Raises ConfigError with every problem found."""
    _anchor(document)
    try:
        config = model.model_validate(document.values)
    except ValidationError as error:
        remaining = [
            detail
            for detail in error.errors()
            if not _is_under(path_in_file(detail, document.places), document.spoiled)
        ]
        raise ConfigError([*document.problems, *problems_of(remaining, model, document.places)]) from error
    if document.problems:
        raise ConfigError(document.problems)
    return config


def _is_under(path: tuple[str | int, ...], spoiled: set[tuple[str | int, ...]]) -> bool:
    return any(path[:length] in spoiled for length in range(len(path) + 1))
