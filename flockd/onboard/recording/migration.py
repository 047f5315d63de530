"""Reads what recordings of earlier versions hold: settings that are gone or renamed, and outputs of another form.

Only for recordings, whose contents nobody can edit. Files that people write are checked without it, so that a key that
has no effect is refused there.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from pydantic import BaseModel

from flockd.core.config import DroneConfig
from flockd.flight.geometry import log_polar, log_polar_covariance
from flockd.onboard.recording.codec import Json, from_json, to_json

DROPPED: Final[Mapping[str, str]] = {
    "tracking.size_memory": "the average of a neighbour's size was off in every shipped configuration",
    "tracking.confirm_evidence": "tracks are confirmed by their existence probability",
    "tracking.keep_evidence": "tracks stay confirmed by their existence probability",
    "tracking.min_gate_m": "the association gate follows from covariances alone",
}
"""Keys of 0.1.0 without a successor: the reason, for people."""

RENAMED: Final[Mapping[str, str]] = {"desired": "mission"}
"""Keys of 0.1.0, or whole sections, that only have another name or place now: the new one."""


ADDED: Final[Mapping[str, Json]] = {"perception.verification": "none", "perception.height": "barometer"}
"""Keys that came later, with the value that does what was done before them, where the recording has their section."""


@dataclass(frozen=True)
class Migrated:
    """A recorded configuration, as this flockd reads it."""

    document: Json
    notes: tuple[str, ...]
    """What was changed, each in one sentence; empty where nothing was."""


def migrate_configuration(
    document: Json,
    model: type[BaseModel] = DroneConfig,
    dropped: Mapping[str, str] = DROPPED,
    renamed: Mapping[str, str] = RENAMED,
) -> Migrated:
    """Drop and rename the keys of the tables that ``model`` does not have; all others stay for its own checks.

    ``document`` is JSON and is not changed.
    """
    migrated, notes = json.loads(json.dumps(document)), []
    for old, new in renamed.items():
        is_old = not _knows(model, old) and _holds(migrated, old)
        if is_old and _knows(model, new) and _may_get(migrated, new):
            _put(migrated, new, _take(migrated, old))
            notes.append(f"{old} is now {new}")
    for key, reason in dropped.items():
        if not _knows(model, key) and _holds(migrated, key):
            value = _take(migrated, key)
            notes.append(f"{key} ({json.dumps(value)}) was dropped: {reason}")
    for key, value in ADDED.items():
        section = key.rpartition(".")[0]
        if _knows(model, key) and _holds(migrated, section) and _may_get(migrated, key):
            _put(migrated, key, value)
            notes.append(f"{key} is {json.dumps(value)}, as before there was this key")
    return Migrated(migrated, tuple(notes))


def migrate_output(output: Json) -> Json:
    """A recorded `PilotOutput` as JSON: `sightings` of 0.1.0, Cartesian, become log-polar `detections`.

    Raises ValueError for sightings that cannot be converted.
    """
    if not isinstance(output, Mapping) or "sightings" not in output:
        return output
    kept = {name: value for name, value in output.items() if name not in ("sightings", "sighting_tracks")}
    try:
        detections = [_detection(sighting) for sighting in output["sightings"]]
        return {**kept, "detections": detections, "detection_tracks": output["sighting_tracks"]}
    except (KeyError, TypeError) as error:
        raise ValueError(f"its sightings cannot be converted to detections ({error!r})") from error


def _detection(sighting: Mapping[str, Any]) -> Json:
    position = np.array([from_json(float, one) for one in sighting["position"]])
    range_sigma_m = from_json(float, sighting["range_sigma_m"])
    bearing_sigma_rad = from_json(float, sighting["bearing_sigma_rad"])
    bearing, log_range = log_polar(position)
    # To first order, the standard deviation of ln r is that of r over r.
    covariance = log_polar_covariance(bearing, range_sigma_m / math.exp(log_range), bearing_sigma_rad)
    polar = {"bearing": to_json(bearing), "log_range": log_range, "covariance": to_json(covariance)}
    replaced = ("position", "range_sigma_m", "bearing_sigma_rad")
    return {**polar, **{name: value for name, value in sighting.items() if name not in replaced}}


def _knows(model: type[BaseModel], key: str) -> bool:
    """Whether a configuration of this type has a key, as in `tracking.gate_sigma`."""
    section: Any = model
    for name in key.split("."):
        fields = getattr(section, "model_fields", {})
        if name not in fields:
            return False
        section = _section(fields[name].annotation)
    return True


def _section(annotation: Any) -> Any:
    """The section that a field holds, also where it may be None."""
    parts = getattr(annotation, "__args__", (annotation,))
    return next((part for part in parts if hasattr(part, "model_fields")), None)


def _holds(document: Json, key: str) -> bool:
    for name in key.split("."):
        if not isinstance(document, Mapping) or name not in document:
            return False
        document = document[name]
    return True


def _may_get(document: Json, key: str) -> bool:
    """Whether the key is not there, and its sections are sections where they are there; else the model's checks say."""
    *sections, name = key.split(".")
    for section in sections:
        if not isinstance(document, Mapping):
            return False
        document = document.get(section, {})
    return isinstance(document, Mapping) and name not in document


def _take(document: Json, key: str) -> Json:
    *sections, name = key.split(".")
    for section in sections:
        document = document[section]
    return document.pop(name)


def _put(document: Json, key: str, value: Json) -> None:
    *sections, name = key.split(".")
    for section in sections:
        document = document.setdefault(section, {})
    document[name] = value
