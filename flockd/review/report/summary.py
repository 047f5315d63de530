"""The figures of one flight: the paper's Tables 2 and 3, the flock, the tracked neighbours and the timings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from flockd.core.config.flocking import FlockingParameters
from flockd.core.messages import BoolArray, FloatArray
from flockd.review.flight_log.builder import ASSOCIATED_M, match_neighbours
from flockd.review.flight_log.log import FlightLog, spread
from flockd.review.metrics import closest_distances, obj1, obj2, order, safety, union

TAIL_S = 10.0
"""The end of a flight, over which the flock counts as converged."""
CONVERGENCE_BAND = {"obj1": 0.05, "obj2": 0.2}
"""How near to its tail mean a sum must stay to have converged."""
RECALL_RANGE_M = 10.0
HOVERS_M_S = 0.1
"""Slower on the mean, a flock has no direction of flight that its drones could share."""
SAME_GOAL_M = 1e-6
NEAR_M = 1.0
"""To an obstacle."""

Json = dict[str, Any]


def summarise(log: FlightLog) -> Json:
    """All figures as plain JSON values; null where there is nothing to say.

    `table2`: absolute errors over all drones, steps and seen neighbours, before and from `circle_until_s`. `table3`:
    convergence of the companion with exact states ("truth") and of this flight ("vision"), null unless the flight goes
    on for 10 s after the circle. `flock`: the smallest distances between drone centres in three dimensions, between
    steps too (`closest_distances`), and `safety` at all steps; order (null of a flock that hovers) and union are
    horizontal means over the last 10 s, with the law's observation distance as interaction distance.
    `neighbours`: the share of all drones within 10 m, at all steps, of which there was a confirmed track, new false
    tracks, how much of the time a drone has one, and errors of the distances of all tracks within 3 m of a drone, one
    to one; of drones and steps that were recorded. A flight whose perception is "truth" has no perception:
    its `neighbours` are null and it is itself Table 3's "truth". Of a recording without truth (`has_truth`) all of
    these are null. `mission` is `mission_figures`, `obstacles` is `obstacle_figures`. `own_account` needs no truth:
    the recorded drones' own estimates. `gated`, `slowed_share`, `slowed_by` and `sizes` are as in `FlightMetadata`.
    `handed_over` says how many simulated drones' supervisors asked for Hold, since when, how near two drones came
    of which flockd flew at least one, and how often one that it flew hit an obstacle. `autopilot` names what real
    daemons flew, and `fleet` holds their figures; null where the simulator ran the pilots.
    """
    metadata, value = log.metadata, log.metadata.model_dump()
    errors, circling = estimation_errors(log), np.asarray(log.time_s < metadata.circle_until_s)
    return {
        **{key: value[key] for key in _FROM_METADATA},
        "has_truth": log.has_truth,
        "realtime_factor": metadata.duration_s / metadata.wall_s if metadata.wall_s else None,
        "table2": {
            window: {
                column: spread(np.abs(values[steps & metadata.by_sight]), *_STATISTICS)
                for column, values in errors.items()
            }
            for window, steps in (("before", circling), ("after", ~circling))
        },
        "table3": _table_3(log),
        "flock": _flock(log),
        "mission": mission_figures(log),
        "obstacles": obstacle_figures(log),
        "handed_over": _handed_over(log),
        "neighbours": _neighbours(log),
        "own_account": _own_account(log),
        "stages_ms": {
            stage: {"p50": _finite(np.percentile(samples, 50)), "p95": _finite(np.percentile(samples, 95))}
            for stage, samples in log.stages_ms.items()
            if len(samples)
        },
    }


_STATISTICS = ("mean", "median", "p95", "max")
_FROM_METADATA = (
    "scenario", "perception", "flow", "scale", "drones", "duration_s", "step_s", "seed", "wall_s", "circle_until_s",
    "desired_distance_m", "gated", "slowed_share", "slowed_by", "sizes",
    "recorded", "began", "version", "interrupted", "autopilot", "fleet",
)  # fmt: skip


_CAUSES = {
    "neighbour": "neighbours", "obstacle": "obstacles", "fence": "the fence", "camera": "a lost camera",
    "unseen": "directions without sight",
    "other": "other limits",
}  # fmt: skip


def causes_text(summary: Mapping[str, Any]) -> str:
    """What gates slowed drones down for, and for how much of the time; a moment may have several causes."""
    return ", ".join(f"{_CAUSES.get(cause, cause)} {100 * part:.1f} %" for cause, part in summary["slowed_by"].items())


def sizes_text(summary: Mapping[str, Any]) -> str:
    """How many drones learned the others' size in flight, and what; empty where none did."""
    sizes = [one["size_m"] for one in summary["sizes"].values()]
    if not sizes:
        return ""
    return f"{min(sizes):.2f} to {max(sizes):.2f} m, by {len(sizes)} of {summary['drones']} drones"


def estimation_errors(log: FlightLog) -> dict[str, FloatArray]:
    """Signed errors by Table 2's columns: (S, N) of the ego-motion, (S, N, N) of the distance; NaN without estimate.

    Translation in body axes C of the interval's start; the angles are the aerospace angles of R_est R_true^T; distance
    is horizontal (d^ij of Eq. 39).
    """
    into_C = np.swapaxes(log.attitude[:-1], -1, -2)
    true_rotation = into_C @ log.attitude[1:]
    true_translation = (into_C @ np.diff(log.position, axis=0)[..., None])[..., 0]
    rotation, translation = np.full_like(log.attitude, np.nan), np.full_like(log.position, np.nan)
    rotation[1:] = log.ego_rotation[1:] @ np.swapaxes(true_rotation, -1, -2)
    translation[1:] = log.ego_translation[1:] - true_translation
    true_distance = np.linalg.norm(_relative_positions(log)[..., :2], axis=-1)
    return {
        "translation_x_m": translation[..., 0],
        "translation_y_m": translation[..., 1],
        "yaw_deg": np.degrees(np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])),
        "pitch_deg": -np.degrees(np.arcsin(np.clip(rotation[..., 2, 0], -1, 1))),
        "roll_deg": np.degrees(np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2])),
        "distance_m": np.linalg.norm(log.neighbour_position[..., :2], axis=-1) - true_distance,
    }


def objective_sums(log: FlightLog, position: FloatArray, velocity: FloatArray) -> dict[str, FloatArray]:
    """The sums of obj1 and obj2 over the flock at each step, (S,), of true states (S, N, 3) on the log's time base."""
    distances = {key: getattr(log.metadata, key) for key in ("observation_distance_m", "desired_distance_m")}
    parameters = FlockingParameters(**distances)
    circling = log.time_s < log.metadata.circle_until_s
    plan, speed = position[..., :2], velocity[..., :2]
    steps = range(len(plan))
    with np.errstate(invalid="ignore", divide="ignore"):  # what the flock wants may be a standstill in the mean
        first = np.array([obj1(speed[s], log.desired[s], circling=bool(circling[s])).sum() for s in steps])
    return {"obj1": first, "obj2": np.array([obj2(plan[s], speed[s], parameters).sum() for s in steps])}


def mission_figures(log: FlightLog) -> Json:
    """Whether the flock's true middle is at its last goal at the end, since when, and how far away; null without one.

    `who`: the flock's middle, or the drone that leads it by hand, where only that has goals. The end is that of the
    mission, where the autopilots land or return then, else that of the flight. `time_s`: the first time that it was
    there, once that goal was the one to fly to.
    """
    mission = log.metadata.mission
    who = "the middle" if mission.led_by is None else f"drone{mission.led_by + 1}, by hand,"
    figures: Json = {"kind": mission.kind, "who": who, "arrived": None, "time_s": None}
    goals = np.flatnonzero(np.isfinite(log.goal).all(axis=1))
    if not len(goals) or not log.has_truth:
        return {**figures, "final_error_m": None}
    last = log.goal[goals[-1]]
    level = log.position[..., :2]
    away_m = np.linalg.norm((level.mean(axis=1) if mission.led_by is None else level[:, mission.led_by]) - last, axis=1)
    same = np.linalg.norm(log.goal - last, axis=1) <= SAME_GOAL_M
    others = goals[~same[goals]]
    since = goals[goals > (others[-1] if len(others) else -1)][0]
    there = np.flatnonzero((away_m <= mission.reached_m) & (np.arange(len(away_m)) >= since))
    return {
        **figures,
        "arrived": bool(away_m[goals[-1]] <= mission.reached_m),
        "time_s": float(log.time_s[there[0]]) if len(there) else None,
        "final_error_m": float(away_m[goals[-1]]),
    }


def obstacle_figures(log: FlightLog) -> Json:
    """How near the drones came to the obstacles; all null without any.

    `collisions` counts each drone's contacts: from when the sphere around it touches an obstacle until it is free
    again. `min_clearance_m` is the smallest distance from that sphere to an obstacle, inside negative, and
    `time_within_1m_s` how long it was below 1 m, summed over the drones.
    """
    contacts = _contacts(log)
    if contacts is None or log.metadata.drone_radius_m is None:
        return dict.fromkeys(("collisions", "min_clearance_m", "time_within_1m_s"))
    free_m = log.clearance - log.metadata.drone_radius_m
    return {
        "collisions": int(contacts.sum()),
        "min_clearance_m": float(free_m.min()),
        "time_within_1m_s": float((free_m < NEAR_M).sum() * log.metadata.step_s),
    }


def _contacts(log: FlightLog) -> BoolArray | None:
    """(S, N): in which steps which drones' contacts with obstacles begin; None without obstacles."""
    if not len(log.clearance) or log.metadata.drone_radius_m is None:
        return None
    touching = np.vstack([np.zeros((1, log.clearance.shape[1]), bool), log.clearance < log.metadata.drone_radius_m])
    return np.asarray(touching[1:] & ~touching[:-1])


def _handed_over(log: FlightLog) -> Json:
    if not log.has_truth:
        return dict.fromkeys(("drones", "first_s", "reasons", "min_distance_flown_m", "collisions_flown"))
    held = log.metadata.handed_over
    since_s = np.array([held[i].time_s if i in held else np.inf for i in range(log.position.shape[1])])
    flown = log.time_s[:, None] < since_s
    i, j = np.triu_indices(log.position.shape[1], 1)
    nearest = closest_distances(log.position)[:, i, j]
    return {
        "drones": len(held),
        "first_s": _finite(since_s.min()),
        "reasons": sorted({one.reason for one in held.values()}),
        "min_distance_flown_m": _finite(nearest[flown[:, i] | flown[:, j]].min(initial=np.inf)),
        "collisions_flown": None if (contacts := _contacts(log)) is None else int((contacts & flown).sum()),
    }


def _table_3(log: FlightLog) -> Json:
    totals: dict[str, dict[str, FloatArray]] = {}
    tail = tail_of(log)  # all of it has to follow the circle's end, where Eq. 44 changes its branch
    if log.has_truth and not tail.all() and np.all(log.time_s[tail] >= log.metadata.circle_until_s):
        totals["vision" if log.metadata.by_sight else "truth"] = objective_sums(log, log.position, log.velocity)
        if log.metadata.by_sight and len(log.truth_position):
            totals["truth"] = objective_sums(log, log.truth_position, log.truth_velocity)
    return {
        row: {name: _convergence(log, name, totals.get(row), totals.get("truth")) for name in CONVERGENCE_BAND}
        for row in ("truth", "vision")
    }


def _convergence(
    log: FlightLog, name: str, totals: dict[str, FloatArray] | None, truth: dict[str, FloatArray] | None
) -> Json:
    """From when on a sum stays near its tail mean (null: never), how much it still moves there, and how far from truth.

    All null without `totals`.
    """
    if totals is None:
        return {"time_s": None, "error": None, "shape_bias": None}
    tail = tail_of(log)
    mean = totals[name][tail].mean()
    off = np.abs(totals[name] - mean)
    outside = np.flatnonzero(off > CONVERGENCE_BAND[name])
    begin = outside[-1] + 1 if len(outside) else 0
    return {
        "time_s": float(log.time_s[begin]) if begin < len(log.time_s) else None,
        "error": float(off[tail].mean()),
        "shape_bias": None if truth is None else float(mean - truth[name][tail].mean()),
    }


_FLOCK = ("min_distance_m", "min_distance_after_10s_m", "order_tail", "union_tail", "safety")


def _flock(log: FlightLog) -> Json:
    if not log.has_truth:
        return dict.fromkeys(_FLOCK)
    steps = range(len(log.time_s))
    pairs = np.triu_indices(log.position.shape[1], 1)
    nearest = closest_distances(log.position)[:, *pairs].min(axis=1, initial=np.inf)
    tail = np.flatnonzero(tail_of(log))
    reach_m = log.metadata.observation_distance_m
    hovers = np.linalg.norm(log.velocity[tail, :, :2], axis=-1).mean() < HOVERS_M_S
    return {
        "min_distance_m": _finite(nearest.min(initial=np.inf)),
        "min_distance_after_10s_m": _finite(nearest[log.time_s >= 10.0].min(initial=np.inf)),
        "order_tail": None if hovers else _mean([order(log.velocity[s, :, :2]) for s in tail]),
        "union_tail": _mean([union(log.position[s, :, :2], reach_m) for s in tail]),
        "safety": _mean([safety(log.position[s]) for s in steps]),
    }


def _neighbours(log: FlightLog) -> Json:
    if not (log.metadata.by_sight and log.has_truth):
        return dict.fromkeys(("recall_within_10m", "false_per_drone_minute", "false_share", "associated_error_m"))
    drones = log.position.shape[1]
    distances = np.linalg.norm(_relative_positions(log), axis=-1)
    near = (distances <= RECALL_RANGE_M) & ~np.eye(drones, dtype=bool) & log.recorded[..., None]
    seen = np.asarray(np.isfinite(log.neighbour_position).all(axis=-1))
    drone_minutes = log.recorded.sum() * log.metadata.step_s / 60
    errors_m, has_false = _tracks(log)
    return {
        "recall_within_10m": _mean(seen[near]),
        "false_share": _mean(has_false[log.recorded]),
        "associated_error_m": spread(np.abs(errors_m), *_STATISTICS),
        "false_per_drone_minute": float(log.false_tracks.sum() / drone_minutes) if drone_minutes else None,
    }


def _tracks(log: FlightLog) -> tuple[FloatArray, BoolArray]:
    """Errors (k,) m of the distances of all tracks within `ASSOCIATED_M` of a drone, and (S, N) which drones have a
    track that is no drone's."""
    errors: list[float] = []
    has_false = np.zeros(log.position.shape[:2], bool)
    relative = _relative_positions(log)
    rows = log.tracked[np.lexsort((log.tracked[:, 1], log.tracked[:, 0]))]
    keys, starts = np.unique(rows[:, :2].astype(int), axis=0, return_index=True)
    for (step, observer), tracks in zip(keys, np.split(rows[:, 3:], starts)[1:], strict=True):
        true = np.delete(relative[step, observer], observer, axis=0)
        associated = match_neighbours(tracks, true, ASSOCIATED_M)
        has_false[step, observer] = len(associated) < len(tracks)
        for track, drone in associated:
            errors.append(float(np.linalg.norm(tracks[track]) - np.linalg.norm(true[drone])))
    return np.array(errors), has_false


def _own_account(log: FlightLog) -> Json:
    """How often the own motion was estimated, from the second step on, and how many neighbours were tracked at once."""
    estimating = log.recorded & log.metadata.by_sight
    _, counts = np.unique(log.tracked[:, :2], axis=0, return_counts=True)
    return {
        "own_motion_ratio": _mean(np.isfinite(log.ego_translation[1:, :, 0])[estimating[1:]]),
        "most_neighbours_tracked": int(counts.max(initial=0)) if estimating.any() and len(log.tracked) else None,
    }


def _relative_positions(log: FlightLog) -> FloatArray:
    """(S, N, N, 3) m NED: [s, i, j] is drone j relative to drone i."""
    return np.asarray(log.position[:, None] - log.position[:, :, None], dtype=float)


def tail_of(log: FlightLog) -> BoolArray:
    """(S,): the steps of the last 10 s; all steps of a shorter flight."""
    begin_s = log.time_s[-1] + log.metadata.step_s - TAIL_S
    return np.asarray(log.time_s > begin_s - 1e-6, dtype=bool)  # the step that begins just then belongs to it


def _mean(values: FloatArray | BoolArray | list[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _finite(value: np.floating[Any]) -> float | None:
    return float(value) if np.isfinite(value) else None


TABLE_2: Final = {
    "before": {
        "translation_x_m": 0.1518,
        "translation_y_m": 0.2324,
        "yaw_deg": 1.8459,
        "pitch_deg": 1.7812,
        "roll_deg": 1.5739,
        "distance_m": 0.1683,
    },
    "after": {
        "translation_x_m": 0.0099,
        "translation_y_m": 0.0155,
        "yaw_deg": 0.7560,
        "pitch_deg": 0.6231,
        "roll_deg": 0.7804,
        "distance_m": 0.0333,
    },
}
"""Maximum errors before and after the circle ends at 66 s."""

TABLE_3: Final = {
    "truth": {"obj1": {"time_s": 67.0, "error": 0.0000}, "obj2": {"time_s": 67.0, "error": 0.0206}},
    "vision": {"obj1": {"time_s": 67.0, "error": 0.0000}, "obj2": {"time_s": 67.0, "error": 0.1273}},
}
"""When the sums of Eq. 44 and 45 over the flock converge, and to within what."""
