"""Reads the form in which version 0.1.0 recorded: that of the recorded regressions, which are never recorded again."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from flockd.flight.geometry import log_polar, log_polar_covariance
from flockd.onboard.recording.codec import Json, from_json, to_json

_DROPPED = ("size_memory", "confirm_evidence", "keep_evidence", "min_gate_m")
"""Keys of `tracking` without a successor."""


def migrate_configuration(document: Json) -> Json:
    """A recorded configuration with today's keys, where it has the section `desired`, which is `mission` now.

    All else stays for the configuration's own checks; ``document`` is not changed.
    """
    if not isinstance(document, Mapping) or "desired" not in document or "mission" in document:
        return document
    migrated = {"mission" if name == "desired" else name: value for name, value in document.items()}
    if isinstance(tracking := document.get("tracking"), Mapping):
        migrated["tracking"] = {name: value for name, value in tracking.items() if name not in _DROPPED}
    if isinstance(perception := document.get("perception"), Mapping):
        migrated["perception"] = {"verification": "none", **perception}
    return migrated


def migrate_output(output: Json) -> Json:
    """A recorded `PilotOutput` as JSON: Cartesian `sightings` become log-polar `detections`.

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
