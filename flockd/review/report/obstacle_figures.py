"""The report's figures of obstacles: where they stood, how near the drones came, and what a drone knew of them."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Rectangle, Wedge
from matplotlib.transforms import Affine2D

from flockd.core.messages import BoolArray
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.style import BAND, FEW, GRID, INK, PAPER, STYLE, colour_of, drone_name

IN_THE_WAY: Final = "#8a7355"
"""Colour of obstacles at the heights that were flown; the others are pale."""
_FREE: Final = "#cfe6f5"
LEGEND: Final[dict[str, Any]] = {
    "loc": "upper right", "frameon": True, "facecolor": PAPER, "edgecolor": "none", "framealpha": 0.85,
}  # fmt: skip
"""Over obstacles."""
_FLOWN_BAND_M = 0.75
"""Obstacles this far above and below the flown heights count as in the way."""
_MAP_M = 12.0
"""Half the side of the local map's figure."""


def add_obstacles(axes: Axes, log: FlightLog) -> None:
    """The obstacles seen from above, east to the right; what is in the way of the flown heights is darker."""
    for chosen, colour, order in ((~in_the_way(log), GRID, 0.6), (in_the_way(log), IN_THE_WAY, 0.7)):
        shapes = [_outline(row) for row in log.obstacles[chosen]]
        axes.add_collection(PatchCollection(shapes, facecolor=colour, edgecolor="none", zorder=order), autolim=False)


def in_the_way(log: FlightLog) -> BoolArray:
    """(K,) which obstacles reach into the heights that were flown."""
    heights = -log.position[..., 2]
    low, high = heights.min() - _FLOWN_BAND_M, heights.max() + _FLOWN_BAND_M
    return np.asarray((log.obstacles[:, 5] <= high) & (log.obstacles[:, 6] >= low))


def obstacle_figure(log: FlightLog) -> Figure | None:
    """Each drone's clearance over time and, of the drone that came nearest, its map of the obstacles just then.

    None of a flight without obstacles.
    """
    radius_m = log.metadata.drone_radius_m
    if not len(log.clearance) or radius_m is None:
        return None
    step, drone = np.unravel_index(int(np.argmin(log.clearance)), log.clearance.shape)
    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 4.4), layout="constrained")
        curves, local = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
        _clearance_curves(curves, log, radius_m)
        _local_map(local, log, int(step), int(drone), radius_m)
    return figure


def _clearance_curves(axes: Axes, log: FlightLog, radius_m: float) -> None:
    drones = log.clearance.shape[1]
    free_m = log.clearance - radius_m
    if drones <= FEW:
        for number in range(drones):
            axes.plot(log.time_s, free_m[:, number], color=colour_of(number, drones), label=drone_name(number))
    else:
        axes.fill_between(log.time_s, free_m.min(axis=1), free_m.max(axis=1), color=BAND, alpha=0.25, linewidth=0)
        axes.plot(log.time_s, free_m.min(axis=1), color=BAND, label="the nearest drone")
    axes.axhline(0.0, color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set(xlabel="time, s", ylabel="clearance, m", title="Distance to the nearest obstacle")
    axes.set_ylim(min(-0.2, float(free_m.min()) - 0.2), min(10.0, float(free_m.max()) + 0.5))
    axes.legend(loc="upper right", ncols=2)


def _local_map(axes: Axes, log: FlightLog, step: int, drone: int, radius_m: float) -> None:
    drones = log.clearance.shape[1]
    north, east = log.position[step, drone, :2]
    knew = bool(len(log.obstacle_range)) and bool(np.isfinite(log.obstacle_range[step, drone]).any())
    if knew:
        _add_free_sectors(axes, log, step, drone)
    add_obstacles(axes, log)
    for other in range(drones):
        place = log.position[step, other]
        style: dict[str, Any] = {"color": colour_of(other, drones), "zorder": 4}
        axes.add_patch(Circle((place[1], place[0]), radius_m, **style))
    if knew:
        _add_ranges(axes, log, step, drone)
    axes.set(
        xlim=(east - _MAP_M, east + _MAP_M), ylim=(north - _MAP_M, north + _MAP_M),
        xlabel="east, m", ylabel="north, m",
        title=f"{drone_name(drone).capitalize()} at its nearest, t = {log.time_s[step]:g} s",
    )  # fmt: skip
    axes.set_aspect("equal")
    handles = [Patch(color=IN_THE_WAY, label="obstacle"), Patch(color=GRID, label="above or below")]
    if knew:
        handles += [Patch(color=_FREE, label="known free"), Patch(color=INK, label="range it knew")]
    axes.legend(handles=handles, **LEGEND)


def _add_free_sectors(axes: Axes, log: FlightLog, step: int, drone: int) -> None:
    for begin_deg, end_deg, range_m in _sectors(log, step, drone):
        reach = min(range_m, 2 * _MAP_M)
        east, north = log.position[step, drone, 1], log.position[step, drone, 0]
        axes.add_patch(Wedge((east, north), reach, begin_deg, end_deg, color=_FREE, linewidth=0.6, zorder=0.5))


def _add_ranges(axes: Axes, log: FlightLog, step: int, drone: int) -> None:
    for begin_deg, end_deg, range_m in _sectors(log, step, drone):
        if math.isfinite(range_m):
            angles = np.radians([begin_deg, end_deg])
            east = log.position[step, drone, 1] + range_m * np.cos(angles)
            north = log.position[step, drone, 0] + range_m * np.sin(angles)
            axes.plot(east, north, color=INK, linewidth=1.6, zorder=3)


def _sectors(log: FlightLog, step: int, drone: int) -> list[tuple[float, float, float]]:
    """Begin and end in degrees from east to north, as matplotlib counts them, and the range of each known sector."""
    ranges = log.obstacle_range[step, drone]
    width = 360.0 / len(ranges)
    middles = 90.0 - width * np.arange(len(ranges))
    return [
        (middle - width / 2, middle + width / 2, float(range_m))
        for middle, range_m in zip(middles, ranges, strict=True)
        if not np.isnan(range_m)
    ]


def _outline(row: Any) -> Circle | Rectangle:
    north, east, half_length, half_width, heading = row[:5]
    if half_width == 0:
        return Circle((east, north), half_length)
    # Its length points along the heading, clockwise from north, which is up.
    turned = Affine2D().rotate(math.pi / 2 - heading).translate(east, north)
    return Rectangle((-half_length, -half_width), 2 * half_length, 2 * half_width, transform=turned)
