"""The report's figure of the flight from above: paths, and the formation at the start and at the end."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Affine2D

from flockd.core.messages import BoolArray, FloatArray
from flockd.review.flight_log.log import FlightLog
from flockd.review.metrics import pair_distances
from flockd.review.report.curves import flock_handles, flock_lines
from flockd.review.report.style import (
    FEW,
    GRID,
    INK,
    MUTED,
    NAMED,
    ON_COLOUR,
    PAPER,
    STYLE,
    colour_of,
    drone_handles,
)
from flockd.review.report.summary import SAME_GOAL_M


def trajectories(log: FlightLog) -> Figure:
    """All true paths seen from above, north up, with the formation at the start and at the end."""
    drones = log.position.shape[1]
    exact = log.companion
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 7.4), layout="constrained")
        mosaic = figure.subplot_mosaic(
            [["paths", "start"], ["paths", "end"]] if drones > 1 else [["paths"]],
            width_ratios=(1.9, 1.0) if drones > 1 else (1.0,),
        )
        paths, *formations = mosaic.values()
        if exact:
            for number in range(drones):
                _plan(paths, exact[0][:, number], **_COMPANION)
        for number in range(drones):
            colour = colour_of(number, drones)
            track = log.position[:, number]
            _plan(paths, track, color=colour, linewidth=1.4 if drones <= FEW else 0.8)
            _plan(paths, track[:1], color=colour, marker="o", markersize=5, markerfacecolor=PAPER, zorder=4)
            _plan(paths, track[-1:], color=colour, marker="o", markersize=6, markeredgecolor=PAPER, zorder=5)
        add_obstacles(paths, log)
        goals = _goals(log)
        paths.plot(goals[:, 1], goals[:, 0], **_GOAL)
        paths.set_aspect("equal", adjustable="datalim")
        paths.set(xlabel="east, m", ylabel="north, m", title="Paths")
        handles = _path_handles(drones, exact=exact is not None, goals=len(goals) > 0)
        if len(log.obstacles):
            handles.append(Line2D([], [], color=IN_THE_WAY, marker="s", linestyle="", label="obstacle"))
        paths.legend(handles=handles, **(LEGEND if len(log.obstacles) else {"loc": "best"}))

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
            size = 11 if drones <= NAMED else 7
            formations[-1].plot(ideal[:, 1], ideal[:, 0], "o", color=MUTED, markerfacecolor="none", markersize=size)
    return figure


_COMPANION: Final[dict[str, Any]] = {"color": MUTED, "linestyle": (0, (3, 2)), "linewidth": 0.9, "alpha": 0.8}


_GOAL: Final[dict[str, Any]] = {"color": INK, "marker": "x", "markersize": 8, "linestyle": "", "zorder": 6}


def _goals(log: FlightLog) -> FloatArray:
    """(n, 2) metres north and east: each place that the mission led to, in order."""
    known = log.goal[np.isfinite(log.goal).all(axis=1)]
    changes = np.linalg.norm(np.diff(known, axis=0), axis=1) > SAME_GOAL_M
    places: FloatArray = known[np.concatenate([[True], changes])] if len(known) else known
    return places


def _plan(axes: Axes, track: FloatArray, **style: object) -> None:
    axes.plot(track[:, 1], track[:, 0], **style)  # type: ignore[arg-type]


def _path_handles(drones: int, *, exact: bool, goals: bool) -> list[Line2D]:
    handles = drone_handles(drones)
    if drones > FEW:
        handles = [handles[0], Line2D([], [], color=colour_of(drones // 2, drones), label="…"), handles[-1]]
    handles.append(Line2D([], [], color=MUTED, marker="o", markerfacecolor=PAPER, linestyle="", label="start"))
    handles.append(Line2D([], [], color=MUTED, marker="o", linestyle="", label="end"))
    handles += [Line2D([], [], label="with exact states", **_COMPANION)] * exact
    return handles + [Line2D([], [], label="goal", **_GOAL)] * goals


def _centred(position: FloatArray) -> FloatArray:
    """(n, 2) north and east from the flock's middle."""
    plan: FloatArray = position[:, :2] - position[:, :2].mean(axis=0)
    return plan


def _formation(axes: Axes, position: FloatArray, velocity: FloatArray) -> None:
    """The flock from above around its middle, with the distances of the pairs that `gabriel_edges` names."""
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
                color=ON_COLOUR, ha="center", va="center_baseline", fontsize=7.5, fontweight="bold", zorder=4,
            )  # fmt: skip


def _length(axes: Axes, one: FloatArray, other: FloatArray) -> None:
    """Write the length of an edge on it, or beside it where the two drones' markers leave no room."""
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
    """(n, n) Gabriel graph: pairs whose diameter circle holds no other; the sides of a pentagon, not its diagonals."""
    squared = pair_distances(plan) ** 2
    # k is inside the circle over i and j where the angle at k is obtuse: |ik|^2 + |jk|^2 < |ij|^2.
    inside = squared[:, None, :] + squared[None, :, :] < squared[:, :, None] - 1e-9
    return np.asarray(~inside.any(axis=2) & ~np.eye(len(plan), dtype=bool))


IN_THE_WAY: Final = "#8a7355"
"""Colour of obstacles at the heights that were flown; the others are pale."""
LEGEND: Final[dict[str, Any]] = {
    "loc": "upper right", "frameon": True, "facecolor": PAPER, "edgecolor": "none", "framealpha": 0.85,
}  # fmt: skip
"""Over obstacles."""
_FLOWN_BAND_M = 0.75
"""Obstacles this far above and below the flown heights count as in the way."""


def add_obstacles(axes: Axes, log: FlightLog) -> None:
    """The obstacles seen from above, east to the right; what is in the way of the flown heights is darker."""
    for chosen, colour, order in ((~in_the_way(log), GRID, 0.6), (in_the_way(log), IN_THE_WAY, 0.7)):
        shapes = [_outline(row) for row in log.obstacles[chosen]]
        axes.add_collection(PatchCollection(shapes, facecolor=colour, edgecolor="none", zorder=order), autolim=False)


def in_the_way(log: FlightLog) -> BoolArray:
    """(K,): which obstacles reach into the heights that were flown."""
    heights = -log.position[..., 2]
    low, high = heights.min() - _FLOWN_BAND_M, heights.max() + _FLOWN_BAND_M
    return np.asarray((log.obstacles[:, 5] <= high) & (log.obstacles[:, 6] >= low))


def obstacle_figure(log: FlightLog) -> Figure | None:
    """Each drone's clearance over time; None of a flight without obstacles."""
    radius_m = log.metadata.drone_radius_m
    if not len(log.clearance) or radius_m is None:
        return None
    drones, free_m = log.clearance.shape[1], log.clearance - radius_m
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 4.4), layout="constrained")
        axes = figure.subplots()
        flock_lines(axes, log.time_s, free_m)
        axes.axhline(0.0, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
        axes.set(xlabel="time, s", ylabel="clearance, m", title="Distance to the nearest obstacle")
        axes.set_ylim(min(-0.2, float(free_m.min()) - 0.2), min(10.0, float(free_m.max()) + 0.5))
        axes.legend(handles=flock_handles(drones), loc="upper right", ncols=2)
    return figure


def _outline(row: Any) -> Circle | Rectangle:
    north, east, half_length, half_width, heading = row[:5]
    if half_width == 0:
        return Circle((east, north), half_length)
    # Its length points along the heading, clockwise from north, which is up.
    turned = Affine2D().rotate(math.pi / 2 - heading).translate(east, north)
    return Rectangle((-half_length, -half_width), 2 * half_length, 2 * half_width, transform=turned)
