"""How drones err in what they perceive of each other, measured in flights by sight of which the truth is known.

`tools.measure.card --parts errors` writes it to config/perceived/shipped_networks.yaml. What is there as `detections`
is the default of a scenario's section of that name, so that flights on made-up detections err as those by sight did.
Errors are of confirmed tracks, and hidden neighbours and those above or below count as missed too.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from flockd.core.messages import BoolArray, FloatArray
from flockd.review.flight_log.builder import match_neighbours
from flockd.review.flight_log.log import FlightLog

EDGES_M = (0.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 14.0, 20.0)
NEAR_M = 10.0
"""Within it neighbours count for `detections`, as for the recall that the card shows."""
SETTLED_S = 3.0
"""Tracks are not yet confirmed before."""
SIGMAS_OF_P95 = 1.96
"""95 % of normal errors are nearer than so many standard deviations."""


class Samples(NamedTuple):
    """What each drone perceived of each other in the steps of one flight: (S, N, N), NaN of a drone itself."""

    distance_m: FloatArray
    log_range: FloatArray
    """Errors; NaN where missed."""
    bearing_rad: FloatArray
    """Likewise, level, clockwise, off the mean of all that a drone sees in a step: what turns them alike is its
    heading, by which it flies too. NaN where it sees one alone."""
    false_m: list[float]
    """Distances of tracks that are no drone's, once a step each, ..."""
    false_begun: int
    """... of so many tracks."""
    step_s: float

    @property
    def missed(self) -> FloatArray:
        """1 or 0; NaN of a drone itself."""
        return np.where(np.isfinite(self.distance_m), np.isnan(self.log_range), np.nan)


def samples_of(log: FlightLog) -> Samples:
    """Of a flight by sight with known truth. Raises ValueError for another."""
    if not (log.has_truth and log.metadata.by_sight):
        raise ValueError(f"{log.metadata.scenario}: not a flight by sight with known truth")
    later = log.time_s >= SETTLED_S
    true, seen = (log.position[:, None] - log.position[:, :, None])[later], log.neighbour_position[later]
    distance = np.linalg.norm(true, axis=-1)
    distance[(distance == 0.0) | ~log.recorded[later][:, :, None]] = np.nan
    turn = np.arctan2(seen[..., 1], seen[..., 0]) - np.arctan2(true[..., 1], true[..., 0])
    false_m: list[float] = []
    for step, i in itertools.product(np.flatnonzero(later), range(log.position.shape[1])):
        tracks = log.tracked[(log.tracked[:, 0] == step) & (log.tracked[:, 1] == i), 3:]
        others = np.delete(log.position[step], i, axis=0) - log.position[step, i]
        matched = [track for track, _ in match_neighbours(tracks, others)]
        false_m += np.linalg.norm(np.delete(tracks, matched, axis=0), axis=1).tolist()
    return Samples(
        distance, np.log(np.linalg.norm(seen, axis=-1) / distance), _beside_heading(turn), false_m,
        int(log.false_tracks[later].sum()), log.metadata.step_s,
    )  # fmt: skip


def _beside_heading(turn: FloatArray) -> FloatArray:
    """(S, N, N) of directions that all of a drone's in a step are turned by alike; NaN in, NaN out."""
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    seen = np.isfinite(turn).sum(axis=2, keepdims=True)
    mean = np.nansum(turn, axis=2, keepdims=True) / np.maximum(seen, 1)
    return np.where(seen >= 2, (turn - mean) * np.sqrt(seen / np.maximum(seen - 1, 1)), np.nan)


def fit(samples: Mapping[str, Samples], families: Mapping[str, int | str]) -> dict[str, Any]:
    """What the file holds, of flights and, where known, the airframes that all drones of a flight had, by its name."""
    flights = list(samples.values())
    near = [one.distance_m < NEAR_M for one in flights]
    all_near = _errors(flights, near)
    false_m, begun = [metres for one in flights for metres in one.false_m], sum(one.false_begun for one in flights)
    drone_steps, step_s = sum(np.isfinite(one.distance_m).any(axis=2).sum() for one in flights), flights[0].step_s
    by_distance = []
    for low, high in itertools.pairwise(EDGES_M):
        errors = _errors(flights, [(one.distance_m >= low) & (one.distance_m < high) for one in flights])
        by_distance += [{"from_m": low, "to_m": high, **errors}] if errors["samples"] else []
    far_m, share = (
        [0.5 * (one["from_m"] + one["to_m"]) for one in by_distance],
        [one["missed"] for one in by_distance],
    )
    # Who is far is missed for long: that is no error that lasts.
    misses = [
        np.where(c, one.missed - np.interp(one.distance_m, far_m, share), np.nan)
        for one, c in zip(flights, near, strict=True)
    ]
    by_airframe = {}
    for family in sorted(set(families.values()), key=str):
        of_it = [one.distance_m < (NEAR_M if families.get(name) == family else 0.0) for name, one in samples.items()]
        by_airframe[family] = _errors(flights, of_it)
    return {
        "detections": {
            "missed": all_near["missed"],
            "range_error": round(all_near["log_range"]["p95"] / SIGMAS_OF_P95, 4),
            "bearing_error_rad": round(all_near["bearing_rad"]["p95"] / SIGMAS_OF_P95, 4),
            "error_time_s": _lasts_s([one.log_range for one in flights], step_s),
            "missed_time_s": _lasts_s(misses, step_s),
            "false_at_once": round(float(len(false_m) / drone_steps), 5),
            "false_time_s": round(step_s * max(len(false_m) / max(begun, 1), 1.0), 2),
            "false_m": np.percentile(false_m or [NEAR_M / 2], [10, 50, 90]).round(1).tolist(),
        },
        "by_distance": by_distance,
        "by_airframe": by_airframe,
    }


def _errors(flights: list[Samples], chosen: list[BoolArray]) -> dict[str, Any]:
    """Of the samples that are chosen in each flight."""
    missed, *errors = (
        np.concatenate([getattr(one, name)[c] for one, c in zip(flights, chosen, strict=True)])
        for name in ("missed", "log_range", "bearing_rad")
    )
    found: dict[str, Any] = {"samples": len(missed), "missed": round(float(missed.mean()), 4) if len(missed) else None}
    for name, values in zip(("log_range", "bearing_rad"), errors, strict=True):
        seen = values[np.isfinite(values)]
        if len(seen):
            median, p95 = np.percentile(np.abs(seen), [50, 95])
            statistics = {"bias": np.median(seen), "median": median, "p95": p95}
            found[name] = {key: round(float(value), 4) for key, value in statistics.items()}
    return found


def _lasts_s(series: list[FloatArray], step_s: float) -> float:
    """Time constant of first-order Gauss-Markov errors with the same correlation from step to step; NaN is left out."""
    pairs = np.concatenate(
        [np.stack([one[:-1], one[1:]])[:, np.isfinite(one[:-1] + one[1:])] for one in series], axis=1
    )
    correlation = 2.0 * np.sum(pairs[0] * pairs[1]) / np.sum(pairs**2)
    return round(-step_s / math.log(min(max(float(correlation), 0.01), 0.99)), 2)


def write(logs: Mapping[str, Path], families: Mapping[str, int | str], commit: str, path: Path) -> None:
    """Fit the logs, each with the name of its flight, and write the file."""
    fitted = fit({name: samples_of(FlightLog.load(log)) for name, log in logs.items()}, families)
    head = "# Written by `python -m tools.measure.card --parts errors`; do not edit. Flights, with their seeds:\n"
    text = yaml.safe_dump({"flights": list(logs), "commit": commit[:8], **fitted}, sort_keys=False, width=160)
    path.write_text(head + text, encoding="utf-8")
