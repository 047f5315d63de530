"""The report of a campaign: one self-contained page."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from flockd.campaign.figures import MEASURES, Figure, Interval, Measure, mean_interval
from flockd.campaign.flight_plan import CASE
from flockd.campaign.results import Results, Row
from flockd.core.data import written_whole
from flockd.review.report.style import BAND, DRONE_COLOURS, MUTED, STYLE, inline_svg, page_template

MOST_ROWS = 200
"""The most rows of a table; `flights.csv` has all."""
REASON, AGAIN = "reason", "fly it again"
"""Columns of text, not of figures."""
NEAREST = 5
"""Flights with the smallest distances are named."""


class Part(NamedTuple):
    """A section of a page."""

    title: str
    note: str = ""
    drawings: Sequence[Markup] = ()
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


def write_campaign_page(results: Results, path: Path) -> None:
    """Writes the report of one campaign."""
    config = results.plan.config
    flown = len(results.rows) - len(results.failures)
    cells = _count(len(results.plan.cells), "cell")
    page = page_template(Path(__file__).with_name("campaign.html")).render(
        title=f"flockd campaign: {config.campaign}",
        eyebrow=f"Campaign report · {config.campaign} · flockd {results.rows[0]['flockd_version']}",
        headline=f"{_count(len(results.rows), 'flight')} of {results.plan.base['scenario']} in {cells}",
        lead=_lead(results),
        facts=[
            ("Flights", flown, "", f"of {results.plan.flights}"),
            ("Failed", len(results.failures), "", "see below" if results.failures else "none"),
            ("Flown in", f"{results.core_s / 60:.2g}", "minutes", "on one core, all flights together"),
        ],
        sections=_parts(results),
        text_columns=(REASON, AGAIN),
    )
    with written_whole(path) as draft:
        draft.write_text(page, encoding="utf-8")


def _lead(results: Results) -> str:
    config, varied = results.plan.config, results.parameters
    base = {**results.plan.base, **config.fixed}
    lasts = "as long as its cell says" if "duration_s" in varied else f"{base.get('duration_s', 110.0):g} s"
    how = {"truth": "on exact states", "sight": "by sight"}[config.perception]
    if not config.gated:
        how += ", without safety gates"
    return f"Each flight lasts {lasts} {how}. " + (f"What varies: {', '.join(varied)}." if varied else "")


_CURVES = (
    "How to read this: the mean over the seeds, at each value the mean of all cells with it; the band is the 95 % "
    "confidence interval of that mean."
)
_CELLS = "How to read this: mean over the seeds, and half the width of its 95 % confidence interval."
_NEAREST = "The flights in which two drones came nearest; the command flies one again, with its full report."


def _parts(results: Results) -> list[Part]:
    curves = [
        Markup(inline_svg(parameter_curves(results, one), f"{one}-curves", f"{label_of(one)} over the parameters"))
        for one in (results.figures if results.parameters else ())
    ]
    drawn = [Part("Figures over the parameters", _CURVES, curves)] if curves else []
    tables = [_nearest(results), _cells(results), _failures(results)]
    return [*drawn, *(part for part in tables if part.rows)]


def _cells(results: Results) -> Part:
    names, rows = results.parameters, []
    for cell in results.plan.cells[:MOST_ROWS]:
        count = sum(row["cell"] == cell.number and row["status"] == "flown" for row in results.rows)
        figures = (_interval(results.interval(figure, [cell.number])) for figure in results.figures)
        rows.append([f"c{cell.number}", *(shown(cell.parameters[name]) for name in names), f"{count}", *figures])
    left_out = len(results.plan.cells) - MOST_ROWS
    note = f"{_CELLS} {left_out} more cells are in flights.csv." if left_out > 0 else _CELLS
    return Part("All cells", note, (), ["cell", *names, "flights", *map(label_of, results.figures)], rows)


def _nearest(results: Results) -> Part:
    """The flights that were most dangerous."""
    measured = [row for row in results.rows if row.get("min_distance_m") is not None]
    near = sorted(measured, key=lambda row: float(row["min_distance_m"]))[:NEAREST]
    rows = [[row["run"], f"{row['min_distance_m']:.2f} m", _rerun(results, row)] for row in near]
    return Part("Nearest flights", _NEAREST, (), ["flight", "nearest distance", AGAIN], rows)


def _failures(results: Results) -> Part:
    rows = [[row["run"], row["reason"], _rerun(results, row)] for row in results.failures[:MOST_ROWS]]
    return Part("Flights that failed", "", (), ["flight", REASON, AGAIN], rows)


def _rerun(results: Results, row: Row) -> Markup:
    return Markup("<code>flockd campaign rerun {}</code>").format(results.path / row["run"])


def _interval(interval: Interval | None) -> str:
    return "" if interval is None else f"{interval.mean:.4g} ± {interval.half_width:.2g}"


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"


_COLUMNS: Final = 3
_PANEL_IN: Final = (3.6, 2.5)
_LETTERS: Final = 44
"""As many letters as fit below a panel; longer names of values stand upright."""
Points = list[tuple[Any, Sequence[float]]]
"""Values of a parameter, each with a figure's value of each seed."""


def parameter_curves(results: Results, figure: Figure) -> Drawing:
    """A panel for each parameter: the figure's mean over its values, with the 95 % confidence interval of the mean.

    With cases, one line a case.
    """
    parameters = [name for name in results.parameters if name != CASE] or [CASE]
    cases: Sequence[str | None] = (None,)
    if CASE in results.parameters and parameters != [CASE]:
        cases = results.values_of(CASE)
    columns = min(len(parameters), _COLUMNS)
    rows = -(-len(parameters) // columns)
    letters = _LETTERS if len(parameters) > 1 else 2 * _LETTERS
    high = {name: _names_height_in(results.values_of(name), letters) for name in parameters}
    with rc_context(STYLE):
        size = (_PANEL_IN[0] * max(columns, 2), (_PANEL_IN[1] + max(high.values())) * rows)
        drawing = Drawing(figsize=size, layout="constrained")
        panels = drawing.subplots(rows, columns, sharey=True, squeeze=False)
        for axes, parameter in zip(panels.flat, parameters, strict=False):
            for number, case in enumerate(cases):
                colour = BAND if case is None else DRONE_COLOURS[number % len(DRONE_COLOURS)]
                of_case = {} if case is None else {CASE: case}
                points: Points = [
                    (value, list(results.by_seed(figure, results.cells_with({**of_case, parameter: value})).values()))
                    for value in results.values_of(parameter)
                ]
                _band(axes, points, colour, case, MEASURES[figure], beside=(number + 1) / (len(cases) + 1) - 0.5)
            axes.set_xlabel(parameter)
            axes.tick_params(axis="x", labelrotation=90 if high[parameter] else 0)
        for axes in panels.flat[len(parameters) :]:
            axes.set_axis_off()
        for axes in panels[:, 0]:
            axes.set_ylabel(textwrap.fill(label_of(figure), 30))
            low, top = axes.get_ylim()
            if top - low < 0.2 and np.ptp(axes.dataLim.intervaly) == 0.0:  # a constant, which is no scatter of 0.04
                axes.set_ylim(max(low - 0.5, min(low, 0.0)), min(top + 0.5, max(MEASURES[figure].highest + 0.05, top)))
        if len(cases) > 1:
            drawing.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=len(cases))
    return drawing


def label_of(figure: Figure) -> str:
    """A figure's name and unit."""
    measure = MEASURES[figure]
    return f"{measure.name}, {measure.unit}" if measure.unit else measure.name


def shown(value: Any) -> str:
    """A parameter's value as text."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _band(axes: Axes, points: Points, colour: str, label: str | None, measure: Measure, *, beside: float) -> None:
    """One line of a panel; where values are no numbers, points that stand ``beside`` those of other cases."""
    known = [(value, seeds) for value, seeds in points if len(seeds)]
    if not known:
        axes.text(0.5, 0.5, "no numbers to draw", transform=axes.transAxes, ha="center", color=MUTED)
        return
    values = [value for value, _ in known]
    numeric = _are_numbers(values)
    places = np.array(values if numeric else range(len(values)), dtype=float)
    intervals = [mean_interval(s, is_share=measure.is_share and set(s) <= {0.0, 1.0}) for _, s in known]
    means = np.array([np.mean(seeds) for _, seeds in known])
    ends = np.array([(np.nan, np.nan) if i is None else (i.low, i.high) for i in intervals])
    ends = np.clip(ends, measure.lowest, measure.highest)
    if numeric and len(places) > 1:
        axes.plot(places, means, color=colour, marker="o", markersize=3.5, label=label)
        axes.fill_between(places, ends[:, 0], ends[:, 1], color=colour, alpha=0.2, linewidth=0)
    else:
        reach = np.abs(ends.T - means)
        axes.errorbar(places + 0.5 * beside, means, reach, color=colour, fmt="o", capsize=4, label=label)
    if not numeric:
        axes.set_xticks(places, [shown(value) for value in values])
        axes.set_xlim(-0.5, len(values) - 0.5)


def _are_numbers(values: Sequence[Any]) -> bool:
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)


def _names_height_in(values: Sequence[Any], letters: int) -> float:
    """How high the names of values stand below a panel, inches: 0 if they fit beside each other."""
    lengths = [len(shown(value)) for value in values]
    return 0.0 if _are_numbers(values) or max(lengths) * len(lengths) <= letters else 0.07 * max(lengths)
