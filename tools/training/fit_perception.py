"""Fits the errors of perception, by distance, to flights by sight.

    python -m tools.training.fit_perception FLIGHT [FLIGHT ...] --out config/perceived/shipped_networks.yaml

A FLIGHT is the folder that `flockd sim` or `flockd report` writes, or its flight.npz: one of which the truth is known.
Steps of the first three seconds do not count, in which tracks are not yet confirmed.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from flockd.core.messages import BoolArray, FloatArray
from flockd.review.flight_log.builder import match_neighbours
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.flight_folder import LOG_NAME
from tools.training.manifests import WithoutAliases

EDGES_M = (0.0, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 9.5, 13.0, 17.0, 20.0)
LEAST_SAMPLES = 30
"""A distance with fewer is left out."""
LEAST_SEEN = 10
"""Where fewer of them were perceived, errors are as at the distance before."""
SETTLED_S = 3.0
MAX_LAG_S = 60.0
LEAST_RATIO = 2.91
"""Least ratio of a 95th percentile to its median; about that of normal errors."""
HIDDEN_EDGES = (0.02, 0.2, 0.4, 0.6, 0.8, 1.01)
DRONE_RADIUS_M, ELEVATION_DEG = 0.35, 45.0
HIDDEN_LIMIT = 0.5
"""Where flights have too few hidden neighbours to tell."""


class Samples(NamedTuple):
    """Neighbours in steps of one flight; (S, N, N) but for `own`, (S, N, 2), and what is of false neighbours."""

    distance: FloatArray
    hidden: FloatArray
    counts: BoolArray
    """Whose distance is known, not of a drone from itself."""
    log_range: FloatArray
    """Errors; NaN where missed."""
    bearing: FloatArray
    velocity: FloatArray
    """(S, N, N, 2)"""
    own: FloatArray
    false_m: FloatArray
    """Distances of false neighbours, each in each step."""
    false_begun: int
    step_s: float


def main() -> None:
    """Reads the command line, fits and writes the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("flights", nargs="+", type=Path, metavar="FLIGHT")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--name", default="shipped networks", help="what the flights' perception is called")
    args = parser.parse_args()
    files = [path / LOG_NAME if path.is_dir() else path for path in args.flights]
    logs = [FlightLog.load(file) for file in files]
    for file, log in zip(files, logs, strict=True):
        if not (log.has_truth and log.metadata.by_sight):
            parser.error(f"{file}: not a flight by sight with known truth; name one that `flockd sim` flew")
    samples = [samples_of(log) for log in logs]
    fitted = fit(samples)
    provenance = [_provenance(log) for log in logs]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    head = "# Written by `python -m tools.training.fit_perception`; do not edit.\n"
    named = {"perception": args.name, "provenance": provenance}
    text = yaml.safe_dump(named, sort_keys=False, width=120)
    text += yaml.dump(fitted, Dumper=WithoutAliases, sort_keys=False, width=120, default_flow_style=None)
    args.out.write_text(head + text, encoding="utf-8")
    print(f"{args.out}: {sum(int(s.counts.sum()) for s in samples)} neighbours in steps of {len(logs)} flights")
    print(text)


def samples_of(log: FlightLog) -> Samples:
    """What a flight tells."""
    later = log.time_s >= SETTLED_S
    relative = (log.position[:, None] - log.position[:, :, None])[later]
    distance = np.linalg.norm(relative, axis=-1)
    n = distance.shape[1]
    counts = ~np.eye(n, dtype=bool) & log.recorded[later][:, :, None]
    estimated = log.neighbour_position[later]
    level, true_level = estimated[..., :2], relative[..., :2]
    turn = np.arctan2(level[..., 1], level[..., 0]) - np.arctan2(true_level[..., 1], true_level[..., 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        log_range = np.log(np.linalg.norm(estimated, axis=-1) / distance)
    false_m = [_false_distances(log, int(step)) for step in np.flatnonzero(later)]
    return Samples(
        distance=distance,
        hidden=_hidden_shares(relative, distance),
        counts=counts & (np.abs(relative[..., 2]) < np.sin(np.radians(ELEVATION_DEG)) * distance),
        log_range=log_range,
        bearing=np.degrees((turn + np.pi) % (2 * np.pi) - np.pi),
        velocity=(log.neighbour_velocity[later] - log.velocity[later][:, None])[..., :2],
        own=(log.own_velocity_estimate - log.velocity)[later][..., :2],
        false_m=np.concatenate(false_m) if false_m else np.empty(0),
        false_begun=int(log.false_tracks[later].sum()),
        step_s=log.metadata.step_s,
    )


def _false_distances(log: FlightLog, step: int) -> FloatArray:
    """How far away the tracks are, of all drones in one step, that match no true drone."""
    found = []
    tracked = log.tracked[log.tracked[:, 0] == step]
    for i in range(log.position.shape[1]):
        places = tracked[tracked[:, 1] == i, 3:]
        true = np.delete(log.position[step], i, axis=0) - log.position[step, i]
        matched = {estimate for estimate, _ in match_neighbours(places, true)}
        found += [float(np.linalg.norm(p)) for k, p in enumerate(places) if k not in matched]
    return np.array(found)


def _hidden_shares(relative: FloatArray, distance: FloatArray) -> FloatArray:
    """(S, N, N): of drone j as drone i sees it, about: discs hide each other by how deep they reach into each other."""
    n = distance.shape[1]
    apart = np.where(distance > 0, distance, np.inf)
    rays, radius = relative / apart[..., None], DRONE_RADIUS_M / apart
    hidden = np.zeros_like(distance)
    for k in range(n):
        between = np.linalg.norm(rays - rays[:, :, k, None], axis=-1)
        both = radius + radius[:, :, k, None]
        share = np.clip((both - between) / (2 * radius + 1e-12), 0.0, 1.0)
        nearer = (distance[:, :, k, None] < distance) & (distance[:, :, k, None] > 0)
        hidden += np.where(nearer, share, 0.0)
    return np.minimum(hidden, 1.0)


def fit(samples: Sequence[Samples]) -> dict[str, Any]:
    """The keys of `PerceivedErrors` but for name and provenance."""
    clear = [s.counts & (s.hidden < HIDDEN_EDGES[0]) for s in samples]
    distance, missed, log_range, bearing = (
        np.concatenate([values[c] for values, c in zip(of_all, clear, strict=True)])
        for of_all in (
            [s.distance for s in samples], [np.isnan(s.log_range) for s in samples], [s.log_range for s in samples],
            [s.bearing for s in samples],
        )
    )  # fmt: skip
    velocity = np.concatenate([s.velocity[c] for s, c in zip(samples, clear, strict=True)])
    entries: list[dict[str, Any]] = []
    spreads: dict[str, Any] = {}
    for low, high in itertools.pairwise(EDGES_M):
        here = (distance >= low) & (distance < high)
        seen = here & ~missed
        if here.sum() < LEAST_SAMPLES:
            continue
        if seen.sum() >= LEAST_SEEN or not entries:
            bias = float(np.median(log_range[seen]))
            spreads = {
                "range_bias": round(bias, 5),
                "range_error": _spread(log_range[seen] - bias),
                "bearing_error_deg": _spread(bearing[seen]),
                "velocity_error_m_s": _spread(velocity[seen]),
            }
        mean_m, missing = round(float(distance[here].mean()), 2), round(float(missed[here].mean()), 5)
        entries.append({"distance_m": mean_m, "missed": missing, **spreads, "samples": int(here.sum())})
    step_s = samples[0].step_s
    own = np.concatenate([s.own.reshape(-1, 2) for s in samples])
    ranges = [np.where(s.counts, s.log_range, np.nan) for s in samples]
    far_m, share = ([entry[key] for entry in entries] for key in ("distance_m", "missed"))
    # Whoever is far or hidden is missed for long: that is no error that lasts.
    misses = [
        np.where(c, np.isnan(s.log_range) - np.interp(s.distance, far_m, share), np.nan)
        for s, c in zip(samples, clear, strict=True)
    ]
    return {
        "by_distance": entries,
        "range_limit_m": round(float(distance.max()), 1),
        "elevation_limit_deg": ELEVATION_DEG,
        "hidden_limit": _hidden_limit(samples),
        "drone_radius_m": DRONE_RADIUS_M,
        "error_time_s": _time_constant(ranges, step_s),
        "missed_time_s": _time_constant(misses, step_s),
        "own_velocity_error_m_s": _spread(own[np.isfinite(own)]),
        "own_velocity_time_s": _time_constant([s.own for s in samples], step_s),
        "false_neighbours": _false_neighbours(samples, step_s),
    }


def _false_neighbours(samples: Sequence[Samples], step_s: float) -> dict[str, Any]:
    distances = np.concatenate([s.false_m for s in samples])
    drone_steps = sum(s.own.shape[0] * s.own.shape[1] for s in samples)
    begun = max(sum(s.false_begun for s in samples), 1)
    spread = np.percentile(distances, [10, 50, 90]) if len(distances) else np.zeros(3)
    return {
        "at_once": round(len(distances) / drone_steps, 5),
        "lifetime_s": round(max(len(distances) * step_s / begun, step_s), 2),
        "distances_m": [round(float(value), 1) for value in spread],
    }


def _spread(errors: FloatArray) -> dict[str, float]:
    median, p95 = np.percentile(np.abs(errors), [50, 95])
    return {"median": round(float(median), 5), "p95": round(float(max(p95, LEAST_RATIO * median)), 5)}


def _hidden_limit(samples: Sequence[Samples]) -> float:
    """The share hidden from which on most are missed, with a line for each share on the way."""
    hidden = np.concatenate([s.hidden[s.counts] for s in samples])
    missed = np.concatenate([np.isnan(s.log_range[s.counts]) for s in samples])
    limit = None
    for low, high in itertools.pairwise(HIDDEN_EDGES):
        here = (hidden >= low) & (hidden < high)
        share = missed[here].mean() if here.any() else np.nan
        print(f"hidden {low:.2f} to {high:.2f}: {here.sum()} samples, {share:.3f} missed")
        if limit is None and here.sum() >= LEAST_SAMPLES and share > 0.5:
            limit = low
    return HIDDEN_LIMIT if limit is None else limit


def _time_constant(series: Sequence[FloatArray], step_s: float) -> float:
    """From the correlation from step to step of series along their first axis, NaN where there is nothing."""
    products, squares = 0.0, 0.0
    for values in series:
        centred = values - np.nanmean(values)
        products += float(np.nansum(centred[1:] * centred[:-1]))
        both = np.isfinite(centred[1:]) & np.isfinite(centred[:-1])
        squares += float((0.5 * (centred[1:] ** 2 + centred[:-1] ** 2))[both].sum())
    correlation = products / squares if squares > 0 else 0.0
    return round(min(-step_s / math.log(min(max(correlation, 0.05), 0.999)), MAX_LAG_S), 2)


def _provenance(log: FlightLog) -> str:
    m = log.metadata
    began = "" if m.began is None else f", {m.began[:10]}"
    version = m.version or "unknown"
    return f"{m.scenario}, seed {m.seed}, {m.drones} drones, {m.duration_s:g} s, {m.flow}, version {version}{began}"


if __name__ == "__main__":
    main()
