"""The report's line figures: paths and formation, the curves of the paper's Fig. 6 and 7, the errors of its Fig. 5.

Each function takes a flight log and returns a matplotlib figure in the light palette; :func:`save_png` and
:func:`inline_svg` turn it into what the report ships. Up to `FEW` drones have a line and a colour each; more are shown
as the band they fill.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from flockd.flight_log.log import FlightLog
from flockd.flocking.metrics import pair_distances
from flockd.messages import BoolArray, FloatArray
from flockd.report.paper_results import TABLE_2
from flockd.report.summary import estimation_errors, objective_sums

FEW: Final = 8
"""Up to this many drones are told apart by colour."""

NAMED: Final = 12
"""Up to this many have their number and their distances written into the formation."""

INK: Final = "#1b2430"
MUTED: Final = "#667382"
GRID: Final = "#dde3ea"
PAPER: Final = "#ffffff"

# Okabe and Ito's colours, which colour-blind readers can tell apart; yellow darkened and black made grey, so that all
# eight can be seen on white and on near-black.
_DRONES: Final = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#a39400", "#808890")

_ON_COLOUR: Final = "#fffffe"
"""White in either scheme, so not the paper's."""

STYLE: Final[dict[Any, Any]] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.labelsize": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "round",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.facecolor": PAPER,
    "figure.dpi": 150.0,
    "svg.fonttype": "none",
    "svg.image_inline": True,
}


def colour_of(number: int, count: int) -> str:
    """The colour of drone `number` (from 0) in a flock of `count`."""
    if count <= FEW:
        return _DRONES[number % FEW]
    return to_hex(colormaps["viridis"](0.2 + 0.65 * number / (count - 1)))


def drone_name(number: int) -> str:
    """Drones count from 0 in the log and from 1 in the report, as in the paper."""
    return f"drone {number + 1}"


# --------------------------------------------------------------------------------------------------- paths, formation


def companion(log: FlightLog) -> tuple[FloatArray, FloatArray] | None:
    """Positions and velocities of the flight with exact states; None without one, and beside a flight that is one."""
    if not len(log.truth_position) or not log.metadata.by_sight:
        return None
    return log.truth_position, log.truth_velocity


def trajectories(log: FlightLog) -> Figure:
    """All true paths seen from above, north up, with the formation at the start and at the end."""
    drones = log.position.shape[1]
    exact = companion(log)
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 7.4), layout="constrained")
        paths, *formations = figure.subplot_mosaic(
            [["paths", "start"], ["paths", "end"]] if drones > 1 else [["paths"]],
            width_ratios=(1.9, 1.0) if drones > 1 else (1.0,),
        ).values()
        if exact:
            for number in range(drones):
                _plan(paths, exact[0][:, number], **_COMPANION)
        for number in range(drones):
            colour = colour_of(number, drones)
            track = log.position[:, number]
            _plan(paths, track, color=colour, linewidth=1.4 if drones <= FEW else 0.8)
            _plan(paths, track[:1], color=colour, marker="o", markersize=5, markerfacecolor=PAPER, zorder=4)
            _plan(paths, track[-1:], color=colour, marker="o", markersize=6, markeredgecolor=PAPER, zorder=5)
        paths.set_aspect("equal", adjustable="datalim")
        paths.set(xlabel="east, m", ylabel="north, m", title="Paths")
        paths.legend(handles=_path_handles(drones, exact=exact is not None), loc="best")

        reach = 1.15 * max(np.abs(_centred(log.position[step])).max() for step in (0, -1)) + 1.2
        for axes, step, name in zip(formations, (0, -1), ("start", "end"), strict=False):
            axes.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="east of the middle, m", ylabel="north, m")
            axes.set_aspect("equal")
            axes.set_title(f"Formation at the {name}, t = {log.time_s[step]:g} s")
            for ticks in (axes.xaxis, axes.yaxis):
                ticks.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
            _formation(axes, log.position[step], log.velocity[step])
        if exact and formations:
            ideal = _centred(exact[0][-1])
            ring: dict[str, Any] = {
                "color": MUTED,
                "markerfacecolor": "none",
                "markersize": 11 if drones <= NAMED else 7,
            }
            formations[-1].plot(ideal[:, 1], ideal[:, 0], "o", **ring)
    return figure


_COMPANION: Final[dict[str, Any]] = {"color": MUTED, "linestyle": (0, (3, 2)), "linewidth": 0.9, "alpha": 0.8}


def _plan(axes: Axes, track: FloatArray, **style: object) -> None:
    axes.plot(track[:, 1], track[:, 0], **style)  # type: ignore[arg-type]


def _path_handles(drones: int, *, exact: bool) -> list[Line2D]:
    handles = []
    if drones <= FEW:
        handles += [Line2D([], [], color=colour_of(i, drones), label=drone_name(i)) for i in range(drones)]
    else:
        handles += [
            Line2D([], [], color=colour_of(0, drones), label="drone 1"),
            Line2D([], [], color=colour_of(drones // 2, drones), label="…"),
            Line2D([], [], color=colour_of(drones - 1, drones), label=f"drone {drones}"),
        ]
    handles.append(Line2D([], [], color=MUTED, marker="o", markerfacecolor=PAPER, linestyle="", label="start"))
    handles.append(Line2D([], [], color=MUTED, marker="o", linestyle="", label="end"))
    if exact:
        handles.append(Line2D([], [], label="with exact states", **_COMPANION))
    return handles


def _centred(position: FloatArray) -> FloatArray:
    """(n, 2) north and east from the flock's middle."""
    plan: FloatArray = position[:, :2] - position[:, :2].mean(axis=0)
    return plan


def _formation(axes: Axes, position: FloatArray, velocity: FloatArray) -> None:
    """The flock from above around its middle, with the distances between those that have nobody between them."""
    plan = _centred(position)
    drones = len(plan)
    for i, j in np.argwhere(np.triu(gabriel_edges(plan))):
        axes.plot(plan[[i, j], 1], plan[[i, j], 0], color=MUTED, linewidth=0.9, zorder=1)
        if drones <= NAMED:
            _length(axes, plan[i], plan[j])
    colours = [colour_of(number, drones) for number in range(drones)]
    axes.quiver(
        plan[:, 1], plan[:, 0], velocity[:, 1], velocity[:, 0],
        color=colours, angles="xy", scale_units="xy", scale=1.0, width=0.006 if drones <= NAMED else 0.003, zorder=2,
    )  # fmt: skip
    axes.scatter(plan[:, 1], plan[:, 0], s=90 if drones <= NAMED else 22, c=colours, zorder=3)
    if drones <= NAMED:
        for number in range(drones):
            axes.text(
                plan[number, 1], plan[number, 0], str(number + 1),
                color=_ON_COLOUR, ha="center", va="center_baseline", fontsize=7.5, fontweight="bold", zorder=4,
            )  # fmt: skip


def _length(axes: Axes, one: FloatArray, other: FloatArray) -> None:
    """The length of a side written on it, or beside it where the two drones' marks leave no room."""
    metres = float(np.linalg.norm(other - one))
    north, east = (one + other) / 2
    short = metres < 0.15 * np.ptp(axes.get_ylim())
    if short:
        away = np.array([one[1] - other[1], other[0] - one[0]]) / max(metres, 1e-9)
        away *= 1 if away @ (north, east) > 0 else -1  # outwards from the flock's middle
        north, east = (north, east) + 0.09 * np.ptp(axes.get_ylim()) * away
    axes.text(
        east, north, f"{metres:.2f}", ha="center", va="center", fontsize=8,
        bbox={"facecolor": PAPER, "edgecolor": "none", "pad": 1.0},
    )  # fmt: skip


def gabriel_edges(plan: FloatArray) -> BoolArray:
    """(n, n): pairs whose diameter circle holds nobody else; the sides of a pentagon, not its diagonals."""
    squared = pair_distances(plan) ** 2
    # k is inside the circle over i and j where the angle at k is obtuse: |ik|^2 + |jk|^2 < |ij|^2.
    inside = squared[:, None, :] + squared[None, :, :] < squared[:, :, None] - 1e-9
    return np.asarray(~inside.any(axis=2) & ~np.eye(len(plan), dtype=bool))


# ------------------------------------------------------------------------------------------- curves of Fig. 6 and 7


def flight_curves(log: FlightLog) -> Figure:
    """Airspeed, course, distances, and the sums of obj1 and obj2, the flight beside its exact-state companion.

    One drone has no distances and no shape.
    """
    flights = [(_flight_title(log), log.position, log.velocity)]
    exact = companion(log)
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


_CURVES: Final = ("airspeed, m/s", "course, °", "distance, m", "Σ obj1", "Σ obj2")
_CURVES_OF_PAIRS: Final = ("distance, m", "Σ obj2")


def _flight_title(log: FlightLog) -> str:
    """What the flight steered by."""
    return "By sight" if log.metadata.by_sight else "With exact states"


_DESIRED: Final[dict[str, Any]] = {"color": INK, "linestyle": (0, (4, 3)), "linewidth": 1.0}


def _flight_column(axes: Mapping[str, Axes], log: FlightLog, position: FloatArray, velocity: FloatArray) -> None:
    time_s, desired = log.time_s, log.desired
    speed, course = axes["airspeed, m/s"], axes["course, °"]
    sums = objective_sums(log, position, velocity)

    _flock_lines(speed, time_s, np.linalg.norm(velocity[..., :2], axis=2))
    speed.plot(time_s, np.linalg.norm(desired, axis=1), **_DESIRED)
    speed.set_ylim(bottom=0)

    asked_deg = np.degrees(np.unwrap(np.arctan2(desired[:, 1], desired[:, 0])))
    course_deg = np.degrees(np.arctan2(velocity[..., 1], velocity[..., 0]))
    # The turn of the course nearest to the desired one, so that no line jumps by 360.
    _flock_lines(course, time_s, asked_deg[:, None] + (course_deg - asked_deg[:, None] + 180) % 360 - 180)
    course.plot(time_s, asked_deg, **_DESIRED)
    course.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 3, 4.5, 9, 10]))

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
    """Horizontal distance of each pair in both drones' colours; of many drones, each one's distance to its nearest."""
    drones = position.shape[1]
    plan = position[..., :2]
    distances = np.linalg.norm(plan[:, :, None] - plan[:, None], axis=3)
    if drones > FEW:
        nearest = np.where(np.eye(drones, dtype=bool), np.inf, distances).min(axis=2)
        _flock_lines(axes, time_s, nearest)
        return
    for i, j in combinations(range(drones), 2):
        axes.plot(
            time_s, distances[:, i, j], color=colour_of(i, drones), gapcolor=colour_of(j, drones),
            linestyle=(0, (5, 5)), linewidth=1.1,
        )  # fmt: skip


def _flock_lines(axes: Axes, time_s: FloatArray, values: FloatArray) -> None:
    """(S, K) values: a line for each of few drones, a band for many."""
    count = values.shape[1]
    if count <= FEW:
        for number in range(count):
            axes.plot(time_s, values[:, number], color=colour_of(number, count))
        return
    some = np.isfinite(values).any(axis=1)
    low, tenth, middle, ninetieth, high = np.nanpercentile(values[some], (0, 10, 50, 90, 100), axis=1)
    axes.fill_between(time_s[some], low, high, color=_BAND, alpha=0.18, linewidth=0)
    axes.fill_between(time_s[some], tenth, ninetieth, color=_BAND, alpha=0.35, linewidth=0)
    axes.plot(time_s[some], middle, color=_BAND)


_BAND: Final = _DRONES[0]


def _flock_handles(drones: int) -> list[Line2D | Patch]:
    if drones <= FEW:
        return [Line2D([], [], color=colour_of(i, drones), label=drone_name(i)) for i in range(drones)]
    return [
        Line2D([], [], color=_BAND, label="median drone"),
        Patch(color=_BAND, alpha=0.5, linewidth=0, label="10th to 90th percentile"),
        Patch(color=_BAND, alpha=0.18, linewidth=0, label="all drones"),
    ]


def _legend(figure: Figure, log: FlightLog, *more: Line2D) -> None:
    handles = [*_flock_handles(log.position.shape[1]), *more]
    if _circle_ends(log):
        handles.append(Line2D([], [], color=MUTED, linewidth=0.8, label="circle ends"))
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles), handlelength=1.8, columnspacing=1.4)


# ---------------------------------------------------------------------------------------------------- without truth


def account_curves(log: FlightLog) -> Figure:
    """What one recorded drone itself knew and wanted: speed, course, and the distances of the neighbours it tracked."""
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


# -------------------------------------------------------------------------------------------------- errors of Fig. 5


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
                _flock_lines(axes, log.time_s, values.reshape(len(values), -1))
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


# ------------------------------------------------------------------------------------------------------------ output

# What the page's style sheet turns with the reader's light or dark scheme.
_THEMED: Final = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    GRID: "var(--grid)",
    PAPER: "var(--paper)",
    _BAND: "var(--blue)",
}


def save_png(figure: Figure, path: Path) -> None:
    """Write the figure in the light palette at its own resolution."""
    figure.savefig(path, format="png")


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """The figure as an `<svg>` element for a page that sets --ink, --muted, --grid, --paper, --blue and --sans.

    `name` keeps its ids apart from those of other figures in the same page; `description` is for readers who hear it.
    """
    buffer = io.StringIO()
    with rc_context({**STYLE, "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    text = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in used else "", text)
    text = re.sub(r' width="[\d.]+pt" height="[\d.]+pt"', "", text, count=1)
    text = re.sub(r' xmlns(:xlink)?="[^"]*"', "", text)
    text = text.replace("xlink:href=", "href=").replace("<svg", f'<svg role="img" aria-label="{description}"', 1)
    text = re.sub(r"font: ((?:bold )?[\d.]+px) [^;\"]*", r"font: \1 var(--sans)", text)
    for colour, variable in _THEMED.items():
        text = text.replace(colour, variable)
    return re.sub(r"\n\s*", "\n", text).strip()
