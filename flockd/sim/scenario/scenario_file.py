"""Loads a scenario's YAML with its drone's file into its typed configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from flockd.core.config.document import Document, KeyPath, Place, read_document
from flockd.core.config.drone import DroneConfig
from flockd.core.config.loader import Overrides, drone_document, kind_of, override, require, validated
from flockd.core.errors import ConfigError
from flockd.sim.scenario.scenario_config import ScenarioConfig

_BESIDE_DRONE = ("mission", "obstacles")
"""Sections of a drone that its scenario may have instead."""


def load_scenario(path: Path | str, overrides: Overrides | None = None) -> ScenarioConfig:
    """The configuration of one simulated flight, with the drone's file that its key `drone` names merged into it.

    `overrides` sets single values over the files', by dotted key: `{"seed": 3, "drone.perception.flow": "dis"}`.
    Raises ConfigError with every problem found in both files.
    """
    return validated(ScenarioConfig, _scenario_document(Path(path), overrides or {}))


def load(path: Path | str) -> DroneConfig | ScenarioConfig:
    """A drone's or a scenario's configuration, whichever the file's keys belong to. Raises ConfigError."""
    return load_with_places(path)[0]


def load_with_places(path: Path | str) -> tuple[DroneConfig | ScenarioConfig, Mapping[KeyPath, Place]]:
    """The same, with the place of each value in the file, for checks of more than the file. Raises ConfigError."""
    path = Path(path)
    if kind_of(read_document(path)) == "drone":
        document = drone_document(path, {})
        return validated(DroneConfig, document), document.places
    document = _scenario_document(path, {})
    return validated(ScenarioConfig, document), document.places


def scenario_schema() -> dict[str, Any]:
    """The JSON schema of a scenario's file: its drone may be a path, and sections of the drone stand beside it."""
    schema = ScenarioConfig.model_json_schema()
    drone = schema["properties"]["drone"]
    inline = {"$ref": drone.pop("$ref")}
    schema["properties"]["drone"] = {"title": "Drone", **drone, "anyOf": [{"type": "string"}, inline]}
    of_all = "Of all vehicles without one of their own, instead of that in `drone`."
    schema["properties"]["mission"] = {"$ref": "#/$defs/MissionParameters", "description": of_all}
    schema["properties"]["obstacles"] = {"$ref": "#/$defs/ObstacleParameters", "description": "Instead of `drone`'s."}
    return schema


def _scenario_document(path: Path, overrides: Overrides) -> Document:
    document = read_document(path)
    require(document, "scenario")
    _merge_drone(document, path.parent)
    for key in _BESIDE_DRONE:
        _merge_section(document, key)
    override(document, overrides)
    return document


def _merge_drone(document: Document, folder: Path) -> None:
    """Puts the drone's values and places where the scenario's file names the drone's file.

    A scenario may also hold the drone's values itself, as `flockd config show` prints them. Raises ConfigError.
    """
    place = document.places.get(("drone",), replace(document.places[()], key="drone"))
    name = document.values.get("drone")
    if isinstance(name, dict):
        return
    if not isinstance(name, str) or not name:
        fault = "must be the path of the drone's own YAML file" if "drone" in document.values else "is missing"
        raise ConfigError([place.problem(f"{fault}; write it as in `drone: simulator.yaml`")])
    try:
        drone = drone_document(folder / name, {})
    except ConfigError as error:
        told = place.problem(f"names {name}, which cannot be used; correct it or name another")
        raise ConfigError([told, *error.problems]) from error
    document.values["drone"] = drone.values
    document.places.update({("drone", *path): place for path, place in drone.places.items()})
    document.problems.extend(drone.problems)


def _merge_section(document: Document, key: str) -> None:
    """Puts a scenario's section in place of its drone's, with its places: one drone's file flies many missions."""
    drone = document.values["drone"]
    if not isinstance(drone, dict) or key not in document.values:
        return
    document.values["drone"] = {**drone, key: document.values.pop(key)}
    places = {path: place for path, place in document.places.items() if path[:2] != ("drone", key)}
    document.places.clear()
    document.places.update({("drone", *path) if path[:1] == (key,) else path: at for path, at in places.items()})
