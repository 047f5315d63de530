"""The drawings of a campaign's report, in the style of a flight's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flockd.campaign.figures import MEASURES, mean_interval
from flockd.campaign.figures import Figure as FigureName
from flockd.campaign.flight_plan import CASE
from flockd.campaign.results import Results
from flockd.review.report.style import BAND, DRONE_COLOURS, MUTED, STYLE

BINS: Final = 8
"""How many bins a drawn parameter's flights are put into: flights with neighbouring values are taken together."""
MOST_PAIRS: Final = 6
"""The most pairs of parameters that get heat maps."""
_DECADES: Final = 30.0
"""A parameter whose largest value is so many times its smallest gets a logarithmic axis."""
_COLUMNS: Final = 3
_PANEL_IN: Final = (3.6, 2.5)
Points = list[tuple[Any, Sequence[float]]]
"""Values of a parameter, each with a figure's value of each seed."""


def parameter_curves(results: Results, figure: FigureName) -> Figure:
    """One panel a parameter: the figure's mean over its values, with the 95 % confidence interval of the mean.

    With cases, one line a case.
    """
    parameters = [name for name in results.parameters if name != CASE] or [CASE]
    cases: Sequence[str | None] = (None,)
    if CASE in results.parameters and parameters != [CASE]:
        cases = results.values_of(CASE)
    columns = min(len(parameters), _COLUMNS)
    rows = -(-len(parameters) // columns)
    with rc_context(STYLE):
        drawing = Figure(figsize=(_PANEL_IN[0] * max(columns, 2), _PANEL_IN[1] * rows), layout="constrained")
        panels = drawing.subplots(rows, columns, sharey=True, squeeze=False)
        for axes, parameter in zip(panels.flat, parameters, strict=False):
            for number, case in enumerate(cases):
                colour = BAND if case is None else DRONE_COLOURS[number % len(DRONE_COLOURS)]
                points = _points(results, figure, parameter, case)
                _band(axes, points, colour, case, is_share=MEASURES[figure].is_share)
            axes.set_xlabel(parameter)
            if parameter not in results.plan.drawn:
                _spread_out(axes, results.values_of(parameter))
        for axes in panels.flat[len(parameters) :]:
            axes.set_axis_off()
        for axes in panels[:, 0]:
            axes.set_ylabel(label_of(figure))
        if len(cases) > 1:
            drawing.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=len(cases))
    return drawing


def heat_maps(results: Results, figure: FigureName) -> Figure | None:
    """One map for each pair of parameters of the grid: the figure's mean; None with fewer than two."""
    grid = [name for name in results.parameters if name not in results.plan.drawn and len(results.values_of(name)) > 1]
    pairs = list(combinations(grid, 2))[:MOST_PAIRS]
    if not pairs:
        return None
    columns = min(len(pairs), 2)
    rows = -(-len(pairs) // columns)
    with rc_context({**STYLE, "axes.grid": False}):
        drawing = Figure(figsize=(5.4 * columns, 3.6 * rows), layout="constrained")
        panels = drawing.subplots(rows, columns, squeeze=False)
        for axes, (across, up) in zip(panels.flat, pairs, strict=False):
            _heat_map(drawing, axes, results, figure, across, up)
        for axes in panels.flat[len(pairs) :]:
            axes.set_axis_off()
    return drawing


def label_of(figure: FigureName) -> str:
    """Its name and unit."""
    measure = MEASURES[figure]
    return f"{measure.name}, {measure.unit}" if measure.unit else measure.name


def shown(value: Any) -> str:
    """A parameter's value."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _points(results: Results, figure: FigureName, parameter: str, case: str | None) -> Points:
    of_case: Mapping[str, Any] = {} if case is None else {CASE: case}
    if parameter in results.plan.drawn:
        return _drawn_points(results, figure, parameter, results.cells_with(of_case))
    return [
        (value, list(results.by_seed(figure, results.cells_with({**of_case, parameter: value})).values()))
        for value in results.values_of(parameter)
    ]


def _drawn_points(results: Results, figure: FigureName, parameter: str, cells: tuple[int, ...]) -> Points:
    """Flights of neighbouring drawn values together: each is at the mean of what they drew."""
    seeds = results.by_seed(figure, cells)
    drawn = {row["number"]: row[parameter] for row in results.rows if row["number"] in seeds}
    numbers = sorted(seeds, key=lambda number: drawn[number])
    parts = np.array_split(np.array(numbers, dtype=int), min(BINS, max(len(numbers) // 4, 1)))
    return [
        (float(np.mean([drawn[int(n)] for n in part])), [seeds[int(n)] for n in part]) for part in parts if len(part)
    ]


def _band(axes: Axes, points: Points, colour: str, label: str | None, *, is_share: bool) -> None:
    known = [(value, seeds) for value, seeds in points if len(seeds)]
    if not known:
        axes.text(0.5, 0.5, "no numbers to draw", transform=axes.transAxes, ha="center", color=MUTED)
        return
    values = [value for value, _ in known]
    numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    places = np.array(values if numeric else range(len(values)), dtype=float)
    intervals = [mean_interval(s, is_share=is_share and set(s) <= {0.0, 1.0}) for _, s in known]
    means = np.array([np.mean(seeds) for _, seeds in known])
    ends = np.array([(np.nan, np.nan) if i is None else (i.low, i.high) for i in intervals])
    if numeric and len(places) > 1:
        axes.plot(places, means, color=colour, marker="o", markersize=3.5, label=label)
        axes.fill_between(places, ends[:, 0], ends[:, 1], color=colour, alpha=0.2, linewidth=0)
    else:
        reach = np.abs(ends.T - means)
        axes.errorbar(places, means, reach, color=colour, fmt="o", capsize=4, label=label)
    if not numeric:
        axes.set_xticks(places, [shown(value) for value in values])
        axes.set_xlim(-0.5, len(values) - 0.5)


def _spread_out(axes: Axes, values: Sequence[Any]) -> None:
    """Sets a logarithmic axis for numbers over decades, with a tick at every value that has room."""
    if not all(isinstance(value, int | float) and not isinstance(value, bool) and value > 0 for value in values):
        return
    if max(values) < _DECADES * min(values):
        return
    ticks: list[Any] = []
    for value in sorted(values):
        if not ticks or value >= 1.9 * ticks[-1]:
            ticks.append(value)
    axes.set_xscale("log")
    axes.set_xticks(ticks, [shown(value) for value in ticks])
    axes.minorticks_off()


_MOST_COLUMNS = 8
"""Of a heat map, in which numbers and names have room beside each other."""


def _heat_map(drawing: Figure, axes: Axes, results: Results, figure: FigureName, across: str, up: str) -> None:
    columns, rows = results.values_of(across), results.values_of(up)
    means = np.full((len(rows), len(columns)), np.nan)
    for row, high in enumerate(rows):
        for column, right in enumerate(columns):
            seeds = results.by_seed(figure, results.cells_with({across: right, up: high}))
            means[row, column] = np.mean(list(seeds.values())) if seeds else np.nan
    image = axes.imshow(means, origin="lower", aspect="auto", cmap="viridis")
    drawing.colorbar(image, ax=axes, label=label_of(figure))
    crowded = len(columns) > _MOST_COLUMNS
    axes.set_xticks(range(len(columns)), [shown(value) for value in columns], rotation=90.0 if crowded else 0.0)
    axes.set_yticks(range(len(rows)), [shown(value) for value in rows])
    axes.set(xlabel=across, ylabel=up)
    if means.size <= 100 and not crowded:
        middle = np.nanmean(means) if np.isfinite(means).any() else 0.0
        for (row, column), mean in np.ndenumerate(means):
            text = f"{mean:.3g}" if np.isfinite(mean) else ""
            axes.text(column, row, text, ha="center", va="center", fontsize=8, color="w" if mean < middle else "k")
