"""Errors of what drones perceive of each other, measured in flights by sight with known truth.

`tools.measure.card --parts errors` writes it to config/perceived/shipped_networks.yaml. What is there as `detections`
is the default of a scenario's section of that name, so that flights on made-up detections err as those by sight did:
of `trained` airframes, all that the simulator makes, and of `unknown` ones, the real meshes. Of these no network learnt
ranges; `detector` and `verification` learnt some of the same public repositories, so that others are missed more often.

- **A track belongs to a drone within 3 m of it**, as for the errors that the card shows. Where 1 m or a quarter of the
  range was the limit, a worse range counted as a miss and as a false neighbour, and as no error of ranges: nearly all
  false ones of commit 05b87e6f were a drone's, in its bearing to 3 degrees.
- **Only in view of a working camera is a drone missed**. Made-up detections know of views too: who lands leaves them.
- **How long misses last is measured from 3 s after a drone has come near**, or once it was known, as all is measured
  from 3 s after a flight's beginning: tracks are not confirmed before.
- **Each flight counts alike**, however long: most samples are of five that know each other well and fly in formation.
- **Detections are missed more often than tracks**, which bridge what is short: `missed` of `detections` has, at each
  distance (m), the share with which a drone's own tracker misses as many drones as `by_distance` says there; beyond the
  last all are missed. Other errors are of confirmed tracks; trackers pass on those that last.
- **Ranges have one error at all distances**: of trained airframes that of 2 to 5 m is 4 to 5 % and that of 5 to 10 m
  9 to 10 %, of unknown ones that of 2 to 10 m 8 to 12 %. Nearer and farther there are few samples.

Drones that others hide count as missed too.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from flockd.core.data import data_path
from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry import build_rig
from flockd.review.flight_log.builder import ASSOCIATED_M, match_neighbours
from flockd.review.flight_log.log import FlightLog
from flockd.sim.flock.exact_states import TrackedNeighbours
from flockd.sim.scenario import DetectionsConfig, ScenarioConfig, load_scenario

EDGES_M = (0.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 14.0, 20.0)
NEAR_M = 10.0
"""Neighbours within it count for `detections`, as for the card's recall; misses are listed farther too."""
LEAST_SAMPLES = 30
"""Least samples at a distance for its share of misses."""
SETTLED_S = 3.0
"""Tracks are confirmed this late after a flight's begin, and after a drone has come near."""
SIGMAS_OF_P95 = 1.96
"""95 % of normal errors are nearer than so many standard deviations."""
REAL = "real"
"""Family of the airframes whose ranges no network has learnt."""


class Samples(NamedTuple):
    """What each drone perceived of each other in the steps of one flight: (S, N, N), NaN of a drone itself and of one
    that no working camera shows."""

    distance_m: FloatArray
    log_range: FloatArray
    """Errors; NaN where missed."""
    bearing_rad: FloatArray
    """Likewise, level, clockwise, off the mean of all that a drone sees in a step: what turns them alike is its
    heading, by which it flies too. NaN where it sees one alone."""
    false_m: list[float]
    """Distances of tracks that are no drone's, once a step each, ..."""
    false_begun: int
    """... of so many tracks, ..."""
    drone_steps: int
    """... in so many steps of a drone."""
    step_s: float

    @property
    def missed(self) -> FloatArray:
        """1 or 0; NaN of a drone itself."""
        return np.where(np.isfinite(self.distance_m), np.isnan(self.log_range), np.nan)

    @property
    def settled(self) -> BoolArray:
        """Which drones are near, and have been near for `SETTLED_S` or been tracked before (S, N, N)."""
        near, known = self.distance_m < NEAR_M, np.maximum.accumulate(np.isfinite(self.log_range), axis=0)
        steps = round(SETTLED_S / self.step_s)
        begun = np.concatenate([np.repeat(near[:1], steps, axis=0), near])
        stays = np.lib.stride_tricks.sliding_window_view(begun, steps + 1, axis=0).all(axis=-1)
        return np.asarray(near & (known | stays))

    @property
    def weight(self) -> float:
        """Weight of a sample, so that each flight counts the same."""
        return 1.0 / max(int(np.isfinite(self.distance_m).sum()), 1)


def samples_of(log: FlightLog, scenario: ScenarioConfig) -> Samples:
    """The samples of a flight by sight of this scenario, with known truth. Raises ValueError for another flight."""
    if not (log.has_truth and log.metadata.by_sight):
        raise ValueError(f"{log.metadata.scenario}: not a flight by sight with known truth")
    rig, drones = build_rig(scenario.drone.rig), np.arange(log.position.shape[1])
    later = np.flatnonzero(log.time_s >= SETTLED_S)
    distance = np.full((len(later), len(drones), len(drones)), np.nan)
    log_range, turn = distance.copy(), distance.copy()
    false_m: list[float] = []
    begun, drone_steps = set[tuple[int, int]](), int(log.recorded[later].sum())
    for (row, step), i in itertools.product(enumerate(later), drones):
        if not log.recorded[step, i]:
            continue
        others = np.delete(drones, i)
        true = log.position[step, others] - log.position[step, i]
        shown = rig.shows(true @ log.attitude[step, i], without=scenario.lost_cameras(int(i), float(log.time_s[step])))
        distance[row, i, others[shown]] = np.linalg.norm(true[shown], axis=1)
        number, *track = np.split(log.tracked[(log.tracked[:, 0] == step) & (log.tracked[:, 1] == i), 2:], [1], axis=1)
        matches = match_neighbours(track[0], true, ASSOCIATED_M)
        for k, other in matches:
            if shown[other]:
                seen, where = track[0][k], true[other]
                log_range[row, i, others[other]] = math.log(np.linalg.norm(seen) / np.linalg.norm(where))
                turn[row, i, others[other]] = math.atan2(seen[1], seen[0]) - math.atan2(where[1], where[0])
        false = np.delete(np.arange(len(number)), [k for k, _ in matches])
        false_m += np.linalg.norm(track[0][false], axis=1).tolist()
        begun |= {(int(i), int(number[k, 0])) for k in false}
    return Samples(distance, log_range, _beside_heading(turn), false_m, len(begun), drone_steps, log.metadata.step_s)


def _beside_heading(turn: FloatArray) -> FloatArray:
    """Bearing errors (S, N, N) without the part that all neighbours of a drone in a step share; NaN in, NaN out."""
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    seen = np.isfinite(turn).sum(axis=2, keepdims=True)
    mean = np.nansum(turn, axis=2, keepdims=True) / np.maximum(seen, 1)
    return np.where(seen >= 2, (turn - mean) * np.sqrt(seen / np.maximum(seen - 1, 1)), np.nan)


def fit(samples: Mapping[str, Samples], families: Mapping[str, int | str]) -> dict[str, Any]:
    """What the file holds, of flights and the airframes that all drones of a flight had, by its name.

    Raises ValueError where no flight has real airframes, or none has others.
    """
    of = {
        "trained": [one for name, one in samples.items() if families[name] != REAL],
        "unknown": [one for name, one in samples.items() if families[name] == REAL],
    }
    if lacking := [name for name, flights in of.items() if not flights]:
        raise ValueError(f"no flight with {lacking[0]} airframes; fly them too (`--airframe`)")
    by_distance = {name: _by_distance(flights) for name, flights in of.items()}
    return {
        "detections": {name: _detections(flights, by_distance[name]) for name, flights in of.items()},
        "by_distance": by_distance,
    }


def _detections(flights: Sequence[Samples], by_distance: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The parameters of simulated detections, by these flights."""
    near, step_s = _errors(flights, 0.0, NEAR_M), flights[0].step_s
    missed = [np.where(one.settled, one.missed, np.nan) for one in flights]
    share = float(np.mean([np.nanmean(one) for one in missed]))
    missed_time_s = _lasts_s([one - share for one in missed], flights)
    false_m, begun = [metres for one in flights for metres in one.false_m], sum(one.false_begun for one in flights)
    at_once = [len(one.false_m) / one.drone_steps for one in flights]
    return {
        "missed": missed_at(by_distance, missed_time_s),
        "range_error": round(near["log_range"]["p95"] / SIGMAS_OF_P95, 4),
        "bearing_error_rad": round(near["bearing_rad"]["p95"] / SIGMAS_OF_P95, 4),
        "error_time_s": _lasts_s([one.log_range for one in flights], flights),
        "missed_time_s": missed_time_s,
        "false_at_once": round(float(np.mean(at_once)), 5),
        "false_time_s": round(step_s * max(len(false_m) / max(begun, 1), 1.0), 2),
        "false_m": np.percentile(false_m or [NEAR_M / 2], [10, 50, 90]).round(1).tolist(),
    }


def _by_distance(flights: Sequence[Samples]) -> list[dict[str, Any]]:
    found = [{"from_m": low, "to_m": high, **_errors(flights, low, high)} for low, high in itertools.pairwise(EDGES_M)]
    return [one for one in found if one["samples"]]


def _errors(flights: Sequence[Samples], from_m: float, to_m: float) -> dict[str, Any]:
    """Errors of drones at these distances, m."""
    chosen = [(one.distance_m >= from_m) & (one.distance_m < to_m) for one in flights]
    missed, *errors = (
        np.concatenate([getattr(one, name)[c] for one, c in zip(flights, chosen, strict=True)])
        for name in ("missed", "log_range", "bearing_rad")
    )
    if not len(missed):
        return {"samples": 0}
    weights = np.concatenate([np.full(int(c.sum()), one.weight) for one, c in zip(flights, chosen, strict=True)])
    found: dict[str, Any] = {"samples": len(missed), "missed": round(float(np.average(missed, weights=weights)), 4)}
    for name, values in zip(("log_range", "bearing_rad"), errors, strict=True):
        seen = np.isfinite(values)
        if seen.any():
            statistics = {
                "bias": _quantile(values[seen], 0.5, weights[seen]),
                "median": _quantile(np.abs(values[seen]), 0.5, weights[seen]),
                "p95": _quantile(np.abs(values[seen]), 0.95, weights[seen]),
            }
            found[name] = {key: round(value, 4) for key, value in statistics.items()}
    return found


def _quantile(values: FloatArray, share: float, weights: FloatArray) -> float:
    return float(np.quantile(values, share, weights=weights, method="inverted_cdf"))


def _lasts_s(series: Sequence[FloatArray], flights: Sequence[Samples]) -> float:
    """Time constant, s, of first-order Gauss-Markov errors with the same correlation between steps; ignores NaN."""
    pairs = np.concatenate([
        math.sqrt(of.weight) * np.stack([one[:-1], one[1:]])[:, np.isfinite(one[:-1] + one[1:])]
        for one, of in zip(series, flights, strict=True)
    ], axis=1)  # fmt: skip
    correlation = 2.0 * np.sum(pairs[0] * pairs[1]) / max(np.sum(pairs**2), 1e-12)
    return round(-flights[0].step_s / math.log(min(max(float(correlation), 0.01), 0.99)), 2)


def missed_at(by_distance: Sequence[dict[str, Any]], lasts_s: float) -> list[list[float]]:
    """Distances, m, each with the share of missed detections; the last is the largest measured distance."""
    enough = [one for one in by_distance if one["samples"] >= LEAST_SAMPLES]
    shares = detections_missed([one["missed"] for one in enough], lasts_s)
    middles = [(one["from_m"] + one["to_m"]) / 2 for one in enough]
    return [list(pair) for pair in zip([*middles, enough[-1]["to_m"]], [*shares, shares[-1]], strict=True)]


def detections_missed(of_tracks: Sequence[float], lasts_s: float) -> list[float]:
    """With which shares of detections missed a drone's own tracker misses these shares of drones, for so long each."""
    shares = [0.0, 0.05, *np.arange(0.1, 1.05, 0.1)]
    found = np.interp(of_tracks, [_tracks_missed(share, lasts_s) for share in shares], shares)
    return [round(float(share), 3) for share in found]


def _tracks_missed(share: float, lasts_s: float, steps: int = 600) -> float:
    """The share of untracked drones, of eight that hover around the own one."""
    scenario = load_scenario(data_path("config") / "encounter.yaml")
    scenario = scenario.model_copy(update={"vehicles": scenario.vehicles[:1] * 9})
    errors = DetectionsConfig(missed=share, missed_time_s=lasts_s, false_at_once=0.0)
    angles = np.arange(8) * np.pi / 4
    places = 4.0 * np.stack([np.cos(angles), np.sin(angles), np.zeros(8)], axis=1)
    positions = np.concatenate([np.zeros((1, 3)), places])
    tracker, step_s = TrackedNeighbours(scenario, errors, 0), scenario.drone.step_s
    known = [
        sum(one.confirmed for one in tracker.step(step_s * k, positions, np.zeros_like(positions)))
        for k in range(steps)
    ]
    return 1.0 - float(np.mean(known[4:])) / len(places)


def write(
    flights: Mapping[str, tuple[Path, ScenarioConfig]], families: Mapping[str, int | str], commit: str, path: Path
) -> None:
    """Fit the logs of flights, each with what was flown, by their names, and write the file."""
    samples = {name: samples_of(FlightLog.load(log), scenario) for name, (log, scenario) in flights.items()}
    head = "# Written by `python -m tools.measure.card --parts errors`; do not edit. Flights, with their seeds:\n"
    found = {"flights": list(flights), "commit": commit[:8], **fit(samples, families)}
    path.write_text(head + yaml.safe_dump(found, sort_keys=False, width=160), encoding="utf-8")
