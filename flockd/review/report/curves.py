"""The report's curves over time: those of the paper's Fig. 6 and 7, and the errors of its Fig. 5.

Each function takes a flight log and returns a matplotlib figure in the light palette.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from flockd.core.messages import BoolArray, FloatArray
from flockd.review.flight_log.log import FlightLog
from flockd.review.metrics import closest_distances
from flockd.review.report.style import BAND, FEW, INK, MUTED, STYLE, colour_of, drone_handles
from flockd.review.report.summary import TABLE_2, estimation_errors, objective_sums


def flight_curves(log: FlightLog) -> Figure:
    """Airspeed, course, heights, distances, and the sums of obj1 and obj2, the flight beside its exact-state companion.

    One drone has no distances and no shape.
    """
    title = "By sight" if log.metadata.by_sight else "With exact states"
    flights = [(title, log.position, log.velocity)]
    exact = log.companion
    if exact:
        flights.append(("With exact states", *exact))
    drones = log.position.shape[1]
    labels = [label for label in _CURVES if drones > 1 or label not in _CURVES_OF_PAIRS]
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 2.1 * len(labels)), layout="constrained")
        rows = figure.subplots(len(labels), len(flights), sharex=True, sharey="row", squeeze=False)
        for column, (title, position, velocity) in enumerate(flights):
            _flight_column(dict(zip(labels, rows[:, column], strict=True)), log, position, velocity)
            rows[0, column].set_title(title)
            rows[-1, column].set_xlabel("time, s")
        for axes, label in zip(rows[:, 0], labels, strict=True):
            axes.set_ylabel(label)
        figure.align_ylabels(rows[:, 0])
        _legend(figure, log, Line2D([], [], label="desired", **_DESIRED))
    return figure


_CURVES: Final = ("airspeed, m/s", "course, °", "height, m", "distance, m", "Σ obj1", "Σ obj2")
_CURVES_OF_PAIRS: Final = ("distance, m", "Σ obj2")


_DESIRED: Final[dict[str, Any]] = {"color": INK, "linestyle": (0, (4, 3)), "linewidth": 1.0}


def _flight_column(axes: Mapping[str, Axes], log: FlightLog, position: FloatArray, velocity: FloatArray) -> None:
    time_s, desired = log.time_s, log.desired
    speed, course = axes["airspeed, m/s"], axes["course, °"]
    sums = objective_sums(log, position, velocity)

    flock_lines(speed, time_s, np.linalg.norm(velocity[..., :2], axis=2))
    speed.plot(time_s, np.linalg.norm(desired, axis=1), **_DESIRED)
    speed.set_ylim(bottom=0)

    asked_deg = np.degrees(np.unwrap(np.arctan2(desired[:, 1], desired[:, 0])))
    course_deg = np.degrees(np.arctan2(velocity[..., 1], velocity[..., 0]))
    # The turn of the course nearest to the desired one, so that no line jumps by 360.
    flock_lines(course, time_s, asked_deg[:, None] + (course_deg - asked_deg[:, None] + 180) % 360 - 180)
    course.plot(time_s, asked_deg, **_DESIRED)
    course.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 3, 4.5, 9, 10]))

    flock_lines(axes["height, m"], time_s, -position[..., 2])

    for steps in _windows(log):  # obj1 is another figure on the circle and after it, so no line joins the two
        axes["Σ obj1"].plot(time_s[steps], sums["obj1"][steps], color=INK)

    if "distance, m" in axes:
        distance = axes["distance, m"]
        separation_m = log.metadata.separation_distance_m
        _distance_lines(distance, time_s, position)
        distance.axhline(separation_m, **_REFERENCE)
        distance.annotate(
            f"separation below {separation_m:g} m", (1.0, separation_m), xycoords=("axes fraction", "data"),
            xytext=(-2, 3), textcoords="offset points", ha="right", fontsize=8,
        )  # fmt: skip
        distance.set_ylim(bottom=0)
        axes["Σ obj2"].plot(time_s, sums["obj2"], color=INK)
    for axis in axes.values():
        _mark_circle(axis, log)


def _distance_lines(axes: Axes, time_s: FloatArray, position: FloatArray) -> None:
    """Horizontal distance of each pair in both drones' colours; of many drones, each one's distance to its nearest.

    From each step to the next it is the least.
    """
    drones = position.shape[1]
    distances = closest_distances(position[..., :2])
    if drones > FEW:
        nearest = np.where(np.eye(drones, dtype=bool), np.inf, distances).min(axis=2)
        flock_lines(axes, time_s, nearest)
        return
    for i, j in combinations(range(drones), 2):
        axes.plot(
            time_s, distances[:, i, j], color=colour_of(i, drones), gapcolor=colour_of(j, drones),
            linestyle=(0, (5, 5)), linewidth=1.1,
        )  # fmt: skip


def flock_lines(axes: Axes, time_s: FloatArray, values: FloatArray) -> None:
    """Draws values (S, K) over times (S,) s: a line for each of few drones, a band for many."""
    count = values.shape[1]
    if count <= FEW:
        for number in range(count):
            axes.plot(time_s, values[:, number], color=colour_of(number, count))
        return
    some = np.isfinite(values).any(axis=1)
    low, tenth, middle, ninetieth, high = np.nanpercentile(values[some], (0, 10, 50, 90, 100), axis=1)
    axes.fill_between(time_s[some], low, high, color=BAND, alpha=0.18, linewidth=0)
    axes.fill_between(time_s[some], tenth, ninetieth, color=BAND, alpha=0.35, linewidth=0)
    axes.plot(time_s[some], middle, color=BAND)


def flock_handles(drones: int) -> list[Line2D | Patch]:
    """Legend entries of what `flock_lines` draws."""
    if drones <= FEW:
        return [*drone_handles(drones)]
    return [
        Line2D([], [], color=BAND, label="median drone"),
        Patch(color=BAND, alpha=0.5, linewidth=0, label="10th to 90th percentile"),
        Patch(color=BAND, alpha=0.18, linewidth=0, label="all drones"),
    ]


def _legend(figure: Figure, log: FlightLog, *more: Line2D) -> None:
    handles = [*flock_handles(log.position.shape[1]), *more]
    if _circle_ends(log):
        handles.append(Line2D([], [], color=MUTED, linewidth=0.8, label="circle ends"))
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles), handlelength=1.8, columnspacing=1.4)


def account_curves(log: FlightLog) -> Figure:
    """Estimates and commands of one recorded drone: speed, course, and the distances of the neighbours it tracked."""
    time_s = log.time_s
    own, command = log.own_velocity_estimate[:, 0, :2], log.command_velocity[:, 0]
    drawn = (
        (own, {"color": colour_of(0, FEW), "label": "own, as estimated"}),
        (command, {"color": colour_of(3, FEW), "label": "commanded"}),
        (log.desired, {"label": "desired", **_DESIRED}),
    )
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 6.3), layout="constrained")
        speed, course, distance = figure.subplots(3, 1, sharex=True)
        for velocity, style in drawn:
            speed.plot(time_s, np.linalg.norm(velocity, axis=1), **style)
            course.plot(time_s, _unwrapped_deg(velocity), **style)
        _tracked_lines(distance, log)
        speed.set(ylabel="airspeed, m/s")
        course.set(ylabel="course, °")
        distance.set(ylabel="distance, m", xlabel="time, s")
        for axes in (speed, distance):
            axes.set_ylim(bottom=0)
        figure.align_ylabels([speed, course, distance])
        handles, labels = speed.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=len(handles))
    return figure


def _unwrapped_deg(velocity: FloatArray) -> FloatArray:
    """(S,) direction of (S, 2) velocities without jumps by a full turn; NaN where it is not known."""
    course = np.arctan2(velocity[:, 1], velocity[:, 0])
    known = np.isfinite(course)
    course[known] = np.unwrap(course[known])
    return np.degrees(course)


def _tracked_lines(axes: Axes, log: FlightLog) -> None:
    """Horizontal distance of each track, in its colour, and its number at its end."""
    steps, tracks = log.tracked[:, 0].astype(int), log.tracked[:, 2].astype(int)
    metres = np.linalg.norm(log.tracked[:, 3:5], axis=1)
    for track in np.unique(tracks):
        mine = tracks == track
        line = np.full(len(log.time_s), np.nan)
        line[steps[mine]] = metres[mine]
        axes.plot(log.time_s, line, color=colour_of(int(track), FEW), marker=".", markersize=3)
        last = steps[mine][-1]
        axes.annotate(
            f"#{track}", (log.time_s[last], line[last]), xytext=(3, 0), textcoords="offset points", va="center",
            fontsize=8,
        )  # fmt: skip
    if not len(tracks):
        axes.text(0.5, 0.5, "no neighbour was tracked", transform=axes.transAxes, ha="center", color=MUTED)


def error_curves(log: FlightLog) -> Figure | None:
    """Errors of the estimated own motion and of the distance to the tracked neighbours; None without any estimate."""
    errors = estimation_errors(log)
    if not log.metadata.by_sight or not any(np.isfinite(values).any() for values in errors.values()):
        return None
    drones = log.position.shape[1]
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 6.6), layout="constrained")
        panels = figure.subplots(2, 3, sharex=True)
        for axes, (column, title) in zip(panels.flat, _ERROR_TITLES.items(), strict=True):
            values = errors[column]
            axes.set_title(title)
            if not np.isfinite(values).any():
                axes.text(0.5, 0.5, "never estimated", transform=axes.transAxes, ha="center", color=MUTED)
                axes.set_axis_off()
                continue
            if drones <= FEW:
                _error_lines(axes, log.time_s, values)
            else:
                flock_lines(axes, log.time_s, values.reshape(len(values), -1))
            axes.axhline(0.0, color=MUTED, linewidth=0.7, zorder=1)
            _paper_maxima(axes, log, column)
            _mark_circle(axes, log)
        for axes in panels[-1]:
            axes.set_xlabel("time, s")
        _legend(figure, log, Line2D([], [], label="the paper’s maximum", **_REFERENCE))
    return figure


_ERROR_TITLES: Final = {
    "translation_x_m": "Translation x, m",
    "translation_y_m": "Translation y, m",
    "distance_m": "Relative distance, m",
    "yaw_deg": "Yaw, °",
    "pitch_deg": "Pitch, °",
    "roll_deg": "Roll, °",
}
_REFERENCE: Final[dict[str, Any]] = {"color": INK, "linestyle": (0, (1, 2)), "linewidth": 0.9}


def _paper_maxima(axes: Axes, log: FlightLog, column: str) -> None:
    """Table 2's limits, both ways, without widening the view for them."""
    view = axes.get_ylim()
    for window, steps in zip(("before", "after"), _windows(log), strict=True):
        if steps.any():
            span = log.time_s[steps][[0, -1]]
            for sign in (-1, 1):
                axes.plot(span, [sign * TABLE_2[window][column]] * 2, **_REFERENCE)
    axes.set_ylim(view)


def _windows(log: FlightLog) -> tuple[BoolArray, BoolArray]:
    """(S,) each: the steps on the circle, and those after it."""
    circling = log.time_s < log.metadata.circle_until_s
    return circling, ~circling


def _circle_ends(log: FlightLog) -> bool:
    """Whether the circle ends within the flight."""
    return all(bool(steps.any()) for steps in _windows(log))


def _mark_circle(axes: Axes, log: FlightLog) -> None:
    if _circle_ends(log):
        axes.axvline(log.metadata.circle_until_s, color=MUTED, linewidth=0.8)


def _error_lines(axes: Axes, time_s: FloatArray, values: FloatArray) -> None:
    """(S, N) of each drone, or (S, N, N) of each drone and neighbour: all in the colour of the one that estimates."""
    drones = values.shape[1]
    for number in range(drones):
        axes.plot(
            time_s, values[:, number], color=colour_of(number, drones),
            linewidth=0.9 if values.ndim == 2 else 0.7, alpha=0.9 if values.ndim == 2 else 0.6,
        )  # fmt: skip
