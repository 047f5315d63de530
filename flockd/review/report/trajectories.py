"""The report's figure of the flight from above: paths, and the formation at the start and at the end."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.flocking.metrics import pair_distances
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.obstacle_figures import IN_THE_WAY, LEGEND, add_obstacles
from flockd.review.report.style import FEW, INK, MUTED, NAMED, ON_COLOUR, PAPER, STYLE, colour_of, drone_name
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
            ring: dict[str, Any] = {
                "color": MUTED,
                "markerfacecolor": "none",
                "markersize": 11 if drones <= NAMED else 7,
            }
            formations[-1].plot(ideal[:, 1], ideal[:, 0], "o", **ring)
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
    if goals:
        handles.append(Line2D([], [], label="goal", **_GOAL))
    return handles


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
