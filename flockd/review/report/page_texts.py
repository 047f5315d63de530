"""What the report's page says of a flight: its sentences, key figures and tables, formatted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

import numpy as np

from flockd.review.flight_log.log import FlightLog
from flockd.review.flight_log.metadata import EXACT_STATES
from flockd.review.metrics import closest_distances
from flockd.review.report.style import FEW
from flockd.review.report.summary import TABLE_2, TABLE_3, causes_text, sizes_text

Summary = Mapping[str, Any]
Rows = list[dict[str, Any]]

_WORDS = ("No", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine", "Ten", "Eleven", "Twelve")
_TOUCH_M = 1.0
"""Two drones of the paper's size (collision radius 0.5 m) touch below this."""
_NONE = "–"
_SCALES = {
    "network": "metric scale from the images alone",
    "height": "metric scale from attitude and height above ground",
}


def page_texts(summary: Summary, log: FlightLog) -> dict[str, Any]:
    """What the page's template fills in, by name: the summary's own values, and the texts and cells made of them."""
    by_sight, flock = summary["perception"] != EXACT_STATES, summary["drones"] > 1 and summary["has_truth"]
    longest = max((stage["p95"] for stage in summary["stages_ms"].values()), default=0.0) or 1.0
    return {
        **summary,
        "setting": _setting(summary),
        "headline": headline(summary),
        "colophon": _colophon(summary),
        "lead": _lead(summary),
        "facts": list(facts(summary, log)),
        "by_sight": by_sight,
        "companion": log.companion is not None,
        "few": FEW,
        "table2": _table2(summary),
        "table3": _table3(summary["table3"]),
        "flock": _rows(summary["flock"], _FLOCK) if flock else [],
        "neighbours": _rows(summary["neighbours"], _NEIGHBOURS) if flock and by_sight else [],
        "stages": [
            {"name": name.replace("_", " "), **stage, "share": stage["p95"] / longest}
            for name, stage in summary["stages_ms"].items()
        ],
    }


def _setting(summary: Summary) -> str:
    """The scenario and seed; of recordings also their drones and when they began."""
    parts = [summary["scenario"]]
    if summary["seed"] is not None:
        parts.append(f"seed {summary['seed']}")
    names = [name for name in summary["recorded"] or () if name != summary["scenario"]]
    return ", ".join([*parts, *[f"recorded by {', '.join(names)}"] * bool(names)])


def _colophon(summary: Summary) -> str:
    """When it was flown, and with which flockd."""
    began = summary["began"]
    with suppress(ValueError):  # of a recording by another writer: as it is there
        began = began and f"{datetime.fromisoformat(began).astimezone(UTC):%Y-%m-%d %H:%M} UTC"
    parts = [f"begun {began}"] * bool(began) + [f"flockd {summary['version']}"] * bool(summary["version"])
    return ", ".join(parts + ["interrupted before its end"] * bool(summary["interrupted"]))


def headline(summary: Summary) -> str:
    """What happened, in one sentence."""
    drones, flock = summary["drones"], summary["flock"]
    means = "with exact states" if summary["perception"] == EXACT_STATES else "by sight"
    means += f" ({summary['perception']})" * (summary["perception"] not in {EXACT_STATES, "learned"})
    means += ", without safety gates" * (summary["gated"] is False)
    count = _WORDS[drones] if drones < len(_WORDS) else str(drones)
    start = f"{count} {'drone' if drones == 1 else 'drones'} flew {summary['duration_s']:g} s {means}"
    if drones == 1 or not summary["has_truth"]:
        return start
    if flock["min_distance_m"] < _TOUCH_M:
        return f"{start}, but came within {flock['min_distance_m']:.2f} m of each other"
    return f"{start}, but did not stay one flock" if flock["union_tail"] < 1 else f"{start} and stayed one flock"


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


def facts(summary: Summary, log: FlightLog) -> Iterator[dict[str, str]]:
    """The key figures, each with its name, value, unit and a remark."""
    flock, neighbours, obstacles = summary["flock"], summary["neighbours"], summary["obstacles"]
    mission, held = summary["mission"], summary["handed_over"]
    if summary["drones"] > 1 and summary["has_truth"]:
        yield _fact("Closest two drones", flock["min_distance_m"], 2, f"in 3D, {_closest(log)}", "m")
        hovers = flock["order_tail"] is None
        yield _fact("Order", flock["order_tail"], 3, "the flock hovers" if hovers else "1: all fly in one direction")
        yield _fact("Union", flock["union_tail"], 2, "1: the flock is connected")
    if summary["has_truth"]:
        heights = -log.position[..., 2]
        yield _fact("Heights", f"{heights.min():.1f}–{heights.max():.1f}", 1, "above the start’s ground", "m")
    if mission["arrived"] is not None:
        when = "never reached" if mission["time_s"] is None else f"reached at {mission['time_s']:g} s"
        remark = f"{mission['who'].rstrip(',')}, at the end; {when}"
        yield _fact("From the last goal", mission["final_error_m"], 2, remark, "m")
    if obstacles["collisions"] is not None:
        yield _fact("Collisions", obstacles["collisions"], 0, "with obstacles, once per contact")
        near = f"the smallest to an obstacle; {obstacles['time_within_1m_s']:g} s within 1 m, all drones together"
        yield _fact("Clearance", obstacles["min_clearance_m"], 2, near, "m")
    if summary["slowed_share"]:
        remark = f"of the time, by safety gates: {causes_text(summary)}"
        yield _fact("Slowed", 100 * summary["slowed_share"], 1, remark, "%")
    if held["drones"]:
        remark = f"drones; the first at {held['first_s']:.1f} s: {held['reasons'][0]}"
        yield _fact("Asked for Hold", held["drones"], 0, remark)
    if neighbours["recall_within_10m"] is not None:
        yield _fact("Neighbours known", 100 * neighbours["recall_within_10m"], 1, "of those within 10 m", "%")
        yield _fact("False neighbours", neighbours["false_per_drone_minute"], 2, "per drone and minute")
    if learned := sizes_text(summary):
        size, _, remark = learned.partition(" m, ")
        yield _fact("Size learned", size, 2, f"of the others, tip to tip, {remark}", "m")
    if not summary["has_truth"]:
        known, most = summary["own_account"]["own_motion_ratio"], summary["own_account"]["most_neighbours_tracked"]
        yield _fact("Own motion", known and 100 * known, 1, "of the steps, from the second on", "%")
        yield _fact("Neighbours tracked", most, 0, "at most at one time")
    if summary["realtime_factor"] is not None:
        yield _fact("Simulation speed", summary["realtime_factor"], 2, "as fast as reality", "×")


def _fact(name: str, value: float | str | None, digits: int, remark: str, unit: str = "") -> dict[str, str]:
    shown = value if isinstance(value, str) else _number(value, digits)
    return {"name": name, "value": shown, "remark": remark, "unit": unit if shown != _NONE else ""}


def _closest(log: FlightLog) -> str:
    """Which two drones came closest, and when."""
    gaps = closest_distances(log.position)
    gaps[:, np.eye(gaps.shape[1], dtype=bool)] = np.inf
    step, one, other = np.unravel_index(np.argmin(gaps), gaps.shape)
    return f"drones {one + 1} and {other + 1} at {log.time_s[step]:.1f} s"


def _number(value: float | None, digits: int) -> str:
    return _NONE if value is None else f"{value:.{digits}f}"


_STATISTICS = {"mean": "mean", "median": "median", "p95": "95th percentile", "max": "maximum"}


def _table2(summary: Summary) -> Rows:
    """Ours beside the paper's maxima; only the windows in which something was estimated."""
    until = f"{summary['circle_until_s']:g}"
    after = f"Straight on, t ≥ {until} s" if summary["circle_until_s"] > 0 else "The whole flight"
    windows = []
    for window, name in (("before", f"On the circle, t < {until} s"), ("after", after)):
        ours, paper = summary["table2"][window], TABLE_2[window]
        if all(ours[key]["max"] is None for key in paper):
            continue
        rows: Rows = [
            _row(
                label, [_cell(ours[key][statistic], most) for key, most in paper.items()], "main" * (label == "maximum")
            )
            for statistic, label in _STATISTICS.items()
        ]
        rows.append(_row("the paper’s maximum", [_cell(most) for most in paper.values()], "paper"))
        windows.append({"name": name, "rows": rows})
    return windows


def _table3(table: Mapping[str, Any]) -> Rows:
    """Both ways of steering, ours and the paper's; only the flights that went on long enough to converge."""
    rows: Rows = []
    kinds = [(total, kind) for total in ("obj1", "obj2") for kind in ("time_s", "error", "shape_bias")]
    for flight, name in (("truth", "With exact states"), ("vision", "By sight")):
        ours, paper = table[flight], TABLE_3[flight]
        if ours["obj1"]["error"] is not None:
            of_paper = [paper[total].get(kind) for total, kind in kinds]
            cells = [_cell(ours[of][kind], most, kind) for (of, kind), most in zip(kinds, of_paper, strict=True)]
            theirs = [_cell(most, None, kind) for (_, kind), most in zip(kinds, of_paper, strict=True)]
            rows += [_row(name, cells, "main"), _row("the paper’s", theirs, "paper")]
    return rows


def _row(name: str, cells: Rows, kind: str) -> dict[str, Any]:
    return {"name": name, "cells": cells, "kind": kind}


def _cell(value: float | None, paper: float | None = None, kind: str = "error") -> dict[str, Any]:
    # The paper prints four digits, so ours is rounded to four before it is measured against them.
    met = value is not None and paper is not None and round(value, 4) <= paper
    if kind == "time_s":
        return {"text": "never" if value is None else f"{value:.1f}", "met": met}
    return {"text": _number(value, 4), "met": met}


_FLOCK = {
    "min_distance_m": ("smallest distance in 3D, m", 3),
    "min_distance_after_10s_m": ("smallest distance in 3D after 10 s, m", 3),
    "order_tail": ("order, last 10 s", 4),
    "union_tail": ("union, last 10 s", 4),
    "safety": ("safety", 4),
}
_NEIGHBOURS = {
    "recall_within_10m": ("share known of those within 10 m", 4),
    "false_per_drone_minute": ("false neighbours per drone and minute", 3),
}
"""By their key in the summary: name and digits."""


def _rows(values: Mapping[str, Any], names: Mapping[str, tuple[str, int]]) -> Rows:
    return [{"name": name, "value": _number(values[key], digits)} for key, (name, digits) in names.items()]
