"""What the report's page says: its sentences and its tables, formatted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from flockd.flight.flocking.metrics import closest_distances
from flockd.review.flight_log.log import FlightLog
from flockd.review.flight_log.metadata import EXACT_STATES
from flockd.review.report.paper_results import TABLE_2, TABLE_3
from flockd.review.report.style import FEW
from flockd.review.report.summary import causes_text, sizes_text

Summary = Mapping[str, Any]


def page_texts(summary: Summary, log: FlightLog) -> dict[str, Any]:
    """All texts and table cells of the page, by their name in its template."""
    by_sight = summary["perception"] != EXACT_STATES
    return {
        "title": f"flockd flight report: {_setting(summary)}",
        "setting": _setting(summary),
        "truth": summary["has_truth"],
        "recomputed": summary["recorded"] is not None,
        "headline": _headline(summary),
        "colophon": _colophon(summary),
        "of_five": _of_five(summary),
        "table2_columns": _TABLE_2_NAMES,
        "table3_columns": _TABLE_3_NAMES,
        "lead": _lead(summary),
        "facts": _facts(summary, log),
        "by_sight": by_sight,
        "companion": log.companion is not None,
        "drones": summary["drones"],
        "distance_note": (
            "Distances here are horizontal and wear the colours of both drones; the closest distance above is in 3D."
            if summary["drones"] <= FEW
            else "Distances here are horizontal, each drone’s to its nearest; the closest distance above is in 3D."
        ),
        "circle_until": f"{summary['circle_until_s']:g}",
        "table2": _table2(summary),
        "table3": _table3(summary["table3"]),
        "flock": _flock(summary["flock"]) if summary["drones"] > 1 and summary["has_truth"] else [],
        "neighbours": _neighbours(summary["neighbours"]) if _knows_neighbours(summary) else [],
        "stages": _stages(summary["stages_ms"]),
        "definitions": _definitions(summary),
    }


def _setting(summary: Summary) -> str:
    """The scenario and seed; of recordings also their drones and when they began."""
    parts = [summary["scenario"]]
    if summary["seed"] is not None:
        parts.append(f"seed {summary['seed']}")
    if summary["recorded"] is not None:
        names = [name for name in summary["recorded"] if name != summary["scenario"]]
        parts += [f"recorded by {', '.join(names)}"] * bool(names)
    return ", ".join(parts)


def _colophon(summary: Summary) -> str:
    """When it was flown, and with which flockd."""
    parts = [f"begun {_minute(summary['began'])}"] if summary["began"] else []
    parts += [f"flockd {summary['version']}"] * bool(summary["version"])
    parts += ["interrupted before its end"] * bool(summary["interrupted"])
    return ", ".join(parts)


def _minute(iso: str) -> str:
    """An ISO 8601 time as people write it."""
    try:
        return f"{datetime.fromisoformat(iso).astimezone(UTC):%Y-%m-%d %H:%M} UTC"
    except ValueError:  # of a recording by another writer
        return iso


def _of_five(summary: Summary) -> str:
    """Where the paper's figures are of another flock."""
    drones = summary["drones"]
    if drones == _PAPERS_DRONES:
        return ""
    return f" The paper’s are of {_PAPERS_DRONES} drones, this flight is of {drones}."


_PAPERS_DRONES = 5


_WORDS = ("No", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine", "Ten", "Eleven", "Twelve")

# Two drones of the paper's size (collision radius 0.5 m) touch below this.
_TOUCH_M = 1.0


def _headline(summary: Summary) -> str:
    drones, flock = summary["drones"], summary["flock"]
    count = _WORDS[drones] if drones < len(_WORDS) else str(drones)
    start = f"{count} {'drone' if drones == 1 else 'drones'} flew {summary['duration_s']:g} s {_means(summary)}"
    if drones == 1 or not summary["has_truth"]:
        return start
    if flock["min_distance_m"] < _TOUCH_M:
        return f"{start}, but came within {flock['min_distance_m']:.2f} m of each other"
    if flock["union_tail"] < 1:
        return f"{start}, but did not stay one flock"
    return f"{start} and stayed one flock"


def _means(summary: Summary) -> str:
    gates = ", without safety gates" if summary["gated"] is False else ""
    if summary["perception"] == EXACT_STATES:
        return f"with exact states{gates}"
    sight = "by sight" if summary["perception"] == "learned" else f"by sight ({summary['perception']})"
    return sight + gates


_SCALES = {
    "network": "metric scale from the images alone",
    "height": "metric scale from attitude and height above ground",
}


def _lead(summary: Summary) -> str:
    step = f"A step every {summary['step_s']:g} s"
    if summary["fleet"]:
        speed = summary["fleet"]["speed_factor"]
        step += f"; a daemon each, with {summary['autopilot']}, at {speed:g} times real time."
    else:
        step += "." if summary["wall_s"] is None else f"; {summary['wall_s']:.0f} s of computing."
    if summary["perception"] == EXACT_STATES:
        return f"Every drone was given the true positions and velocities of all others. {step}"
    who = "Each drone" if summary["drones"] > 1 else "It"
    what = "its own motion" if summary["drones"] == 1 and summary["has_truth"] else "its neighbours and its own motion"
    means = f"perception: {summary['perception']}; flow: {summary['flow']}; {_SCALES[summary['scale']]}"
    return f"{who} knew {what} from its cameras ({means}). {step}{_whose(summary)}"


def _whose(summary: Summary) -> str:
    """Where not every drone of the flight was recorded, and where there is no truth."""
    recorded = summary["recorded"]
    if not summary["has_truth"]:
        return " The recording holds no truth, so all of this is the drone’s own estimate."
    if recorded is None or len(recorded) == summary["drones"]:
        return ""
    return f" What was estimated and timed here is by {', '.join(recorded)} alone; the truth is of all drones."


def _facts(summary: Summary, log: FlightLog) -> list[dict[str, str]]:
    flock, neighbours = summary["flock"], summary["neighbours"]
    facts = []
    if summary["drones"] > 1 and summary["has_truth"]:
        facts += [
            _fact("Closest two drones", _number(flock["min_distance_m"], 2), f"in 3D, {_closest(log)}", "m"),
            _fact(
                "Order",
                _number(flock["order_tail"], 3),
                "the flock hovers" if flock["order_tail"] is None else "1 is all flying one way",
            ),
            _fact("Union", _number(flock["union_tail"], 2), "1 is one connected flock"),
        ]
    if summary["has_truth"]:
        heights = -log.position[..., 2]
        facts.append(_fact("Heights", f"{heights.min():.1f}–{heights.max():.1f}", "above the start’s ground", "m"))
    mission = summary["mission"]
    if mission["arrived"] is not None:
        when = "never reached" if mission["time_s"] is None else f"reached at {mission['time_s']:g} s"
        facts.append(
            _fact(
                "From the last goal",
                _number(mission["final_error_m"], 2),
                f"{mission['who'].rstrip(',')}, at the end; {when}",
                "m",
            )
        )
    obstacles = summary["obstacles"]
    if obstacles["collisions"] is not None:
        near = f"{obstacles['time_within_1m_s']:g} s within 1 m, all drones together"
        facts += [
            _fact("Collisions", _number(obstacles["collisions"], 0), "with obstacles, once per contact"),
            _fact("Clearance", _number(obstacles["min_clearance_m"], 2), f"the smallest to an obstacle; {near}", "m"),
        ]
    if summary["slowed_share"]:
        remark = f"of the time, by safety gates: {causes_text(summary)}"
        facts.append(_fact("Slowed", _number(100 * summary["slowed_share"], 1), remark, "%"))
    held = summary["handed_over"]
    if held["drones"]:
        remark = f"drones; the first at {held['first_s']:.1f} s: {held['reasons'][0]}"
        facts.append(_fact("Asked for Hold", _number(held["drones"], 0), remark))
    if neighbours["recall_within_10m"] is not None:
        facts += [
            _fact("Neighbours known", _number(100 * neighbours["recall_within_10m"], 1), "of those within 10 m", "%"),
            _fact("False neighbours", _number(neighbours["false_per_drone_minute"], 2), "per drone and minute"),
        ]
    if learned := sizes_text(summary):
        size, _, remark = learned.partition(" m, ")
        facts.append(_fact("Size learned", size, f"of the others, tip to tip, {remark}", "m"))
    if not summary["has_truth"]:
        account = summary["own_account"]
        known = account["own_motion_ratio"]
        most = account["most_neighbours_tracked"]
        facts += [
            _fact("Own motion", _number(known and 100 * known, 1), "of the steps, from the second on", "%"),
            _fact("Neighbours tracked", _number(most, 0), "at most at one time"),
        ]
    if summary["realtime_factor"] is not None:
        facts.append(_fact("Speed", _number(summary["realtime_factor"], 2), "of real time", "×"))
    return facts


def _fact(name: str, value: str, remark: str, unit: str = "") -> dict[str, str]:
    return {"name": name, "value": value, "remark": remark, "unit": unit if value != _NONE else ""}


def _closest(log: FlightLog) -> str:
    """Which two drones came closest, and when."""
    gaps = closest_distances(log.position)
    gaps[:, np.eye(gaps.shape[1], dtype=bool)] = np.inf
    step, one, other = np.unravel_index(np.argmin(gaps), gaps.shape)
    return f"drones {one + 1} and {other + 1} at {log.time_s[step]:.1f} s"


_NONE = "–"


def _number(value: float | None, digits: int) -> str:
    return _NONE if value is None else f"{value:.{digits}f}"


def _table2(summary: Summary) -> list[dict[str, Any]]:
    """Ours beside the paper's maxima; only the windows in which something was estimated."""
    until = f"{summary['circle_until_s']:g}"
    windows = []
    after = f"Straight on, t ≥ {until} s" if summary["circle_until_s"] > 0 else "The whole flight"
    for window, name in (("before", f"On the circle, t < {until} s"), ("after", after)):
        columns = summary["table2"][window]
        if all(columns[key]["max"] is None for key in _TABLE_2_COLUMNS):
            continue
        rows = [
            {
                "name": label,
                "cells": [_cell(columns[key][statistic], TABLE_2[window][key]) for key in _TABLE_2_COLUMNS],
                "kind": "main" if statistic == "max" else "",
            }
            for statistic, label in _STATISTICS.items()
        ]
        paper = [_cell(TABLE_2[window][key]) for key in _TABLE_2_COLUMNS]
        windows.append(
            {"name": name, "rows": [*rows, {"name": "the paper’s maximum", "cells": paper, "kind": "paper"}]}
        )
    return windows


_TABLE_2_COLUMNS = ("translation_x_m", "translation_y_m", "yaw_deg", "pitch_deg", "roll_deg", "distance_m")
_TABLE_2_NAMES = ("x, m", "y, m", "yaw, °", "pitch, °", "roll, °", "distance, m")
_TABLE_3_NAMES = ("obj1 time, s", "obj1 error", "obj1 bias", "obj2 time, s", "obj2 error", "obj2 bias")
_STATISTICS = {"mean": "mean", "median": "median", "p95": "95th percentile", "max": "maximum"}


def _table3(table: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Both ways of steering, ours and the paper's; only the flights that went on long enough to converge."""
    rows: list[dict[str, Any]] = []
    for flight, name in (("truth", "With exact states"), ("vision", "By sight")):
        ours, paper = table[flight], TABLE_3[flight]
        if ours["obj1"]["error"] is None:
            continue
        kinds = [(total, statistic) for total in ("obj1", "obj2") for statistic in ("time_s", "error", "shape_bias")]
        rows.append(
            {
                "name": name,
                "cells": [_convergence_cell(kind, ours[total][kind], paper[total].get(kind)) for total, kind in kinds],
                "kind": "main",
            }
        )
        rows.append(
            {
                "name": "the paper’s",
                "cells": [_convergence_cell(kind, paper[total].get(kind)) for total, kind in kinds],
                "kind": "paper",
            }
        )
    return rows


def _convergence_cell(kind: str, value: float | None, paper: float | None = None) -> dict[str, Any]:
    if kind != "time_s":
        return _cell(value, paper)
    return {**_cell(value, paper), "text": "never" if value is None else f"{value:.1f}"}


def _cell(value: float | None, paper: float | None = None) -> dict[str, Any]:
    # The paper prints four digits, so ours is rounded to four before it is measured against them.
    met = value is not None and paper is not None and round(value, 4) <= paper
    return {"text": _number(value, 4), "met": met}


def _knows_neighbours(summary: Summary) -> bool:
    return summary["perception"] != EXACT_STATES and summary["drones"] > 1 and bool(summary["has_truth"])


def _rows(values: Mapping[str, Any], names: Sequence[tuple[str, str, int]]) -> list[dict[str, str]]:
    return [{"name": name, "value": _number(values[key], digits)} for key, name, digits in names]


def _flock(flock: Mapping[str, Any]) -> list[dict[str, str]]:
    return _rows(
        flock,
        (
            ("min_distance_m", "smallest distance in 3D, m", 3),
            ("min_distance_after_10s_m", "smallest distance in 3D after 10 s, m", 3),
            ("order_tail", "order, last 10 s", 4),
            ("union_tail", "union, last 10 s", 4),
            ("connectivity_tail", "connectivity, last 10 s", 4),
            ("safety", "safety", 4),
        ),
    )


def _neighbours(neighbours: Mapping[str, Any]) -> list[dict[str, str]]:
    return _rows(
        neighbours,
        (
            ("recall_within_10m", "share known of those within 10 m", 4),
            ("false_per_drone_minute", "false neighbours per drone and minute", 3),
        ),
    )


def _stages(stages: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    longest = max((stage["p95"] for stage in stages.values()), default=0.0)
    return [
        {
            "name": name.replace("_", " "),
            "p50": _number(stage["p50"], 1),
            "p95": _number(stage["p95"], 1),
            "share": f"{100 * stage['p95'] / longest if longest > 0 else 0:.1f}",
        }
        for name, stage in stages.items()
    ]


def _definitions(summary: Summary) -> list[tuple[str, str]]:
    drones, distance_m = summary["drones"], summary["desired_distance_m"]
    of_flock = ""
    if drones == _PAPERS_DRONES and distance_m == _PAPERS_DISTANCE_M:
        of_flock = " Five drones cannot all be 3.5 m apart: their sum settles at 15.27, not 0."
    elif drones > _MOST_EQUIDISTANT:
        of_flock = f" {drones} drones cannot all be {distance_m:g} m apart in a plane: their sum does not settle at 0."
    return [(term, meaning.format(obj2_of_flock=of_flock)) for term, meaning in _DEFINITIONS]


_PAPERS_DISTANCE_M = 3.5
_MOST_EQUIDISTANT = 3
"""Points in a plane that can all be equally far from each other."""

_DEFINITIONS = (
    (
        "x, y, yaw, pitch, roll",
        "Error of a drone’s own motion over one step, R_FC and T_FC with P_C = R_FC P_F + T_FC, in the body axes at "
        "the start of the step.",
    ),
    ("distance", "Error of the horizontal distance to a tracked neighbour."),
    (
        "obj1",
        "Eq. 44: before the circle ends −V·e / (2 |e|²), which is −0.5 at the desired velocity e; then the L1 distance "
        "from it.",
    ),
    (
        "obj2",
        "Eq. 45: over all others within the observation distance, how far the distance is from the desired one plus "
        "the L1 difference in velocity.{obj2_of_flock}",
    ),
    (
        "convergence",
        "The tail is the last 10 s. Time: the first from which the sum stays within 0.05 (obj1) or 0.2 (obj2) of its "
        "tail mean. Error: the mean absolute deviation from the tail mean over the tail. Bias: the tail mean less that "
        "of the flight with exact states.",
    ),
    ("closest", "Distances are between the drones’ middles, in three dimensions."),
    (
        "order",
        "Mean cosine between the velocities of all pairs over the last 10 s: 1 is all flying one way. A flock that "
        "hovers, slower than 0.1 m/s on the mean, has none.",
    ),
    ("union", "(N − groups) / (N − 1) over the last 10 s, linked within the observation distance: 1 is one flock."),
    (
        "connectivity",
        "Second eigenvalue of the same graph’s Laplacian over N: 1 where all are linked to all.",
    ),
    ("safety", "1 less the share of pairs closer than 1 m, twice a collision radius of 0.5 m, over all steps."),
    ("separation", "Below D_II two drones push each other away (Eq. 41)."),
    (
        "neighbours known",
        "Of the true drones within 10 m, at all steps, the share of which there was a confirmed track.",
    ),
    ("false neighbours", "New confirmed tracks that belong to no drone."),
    ("speed", "Flight time over computing time for the whole simulated flock."),
)
