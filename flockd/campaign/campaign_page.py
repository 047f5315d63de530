"""The report of a campaign, and of two compared: one self-contained page each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup
from matplotlib.figure import Figure as Drawing

from flockd.campaign.campaign_figures import heat_maps, label_of, parameter_curves, shown
from flockd.campaign.conduct import is_known
from flockd.campaign.figures import MEASURES, Interval
from flockd.campaign.results import Results, Row
from flockd.campaign.verdicts import LEVEL, Comparison, Verdict
from flockd.review.report.style import inline_svg, page_template

MOST_ROWS = 200
"""The most rows of a table; the Parquet files have all."""
NEAREST = 5
"""Flights with the smallest distances are named."""


@dataclass(frozen=True)
class TableCell:
    """One cell of a table's row."""

    text: str = ""
    kind: str = ""
    """Class in the style sheet."""
    code: str = ""
    """A command instead of a text."""


@dataclass(frozen=True)
class Part:
    """A section of a page."""

    title: str
    note: str = ""
    drawings: Sequence[Markup] = ()
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[str | TableCell]] = ()


def write_campaign_page(results: Results, path: Path) -> None:
    """Writes the report of one campaign."""
    config = results.plan.config
    flown = len(results.rows) - len(results.failures)
    cells = _count(len(results.plan.cells), "cell")
    _write(
        path,
        title=f"flockd campaign: {config.campaign}",
        eyebrow=f"Campaign report · {config.campaign} · flockd {results.rows[0]['flockd_version']}",
        headline=f"{_count(len(results.rows), 'flight')} of {results.plan.base['scenario']} in {cells}",
        lead=_lead(results),
        facts=[
            _fact("Flights", f"{flown}", "", f"of at most {results.plan.most_flights}"),
            _fact("Failed", f"{len(results.failures)}", "", "see below" if results.failures else "none"),
            *_known_cells(results),
            _fact("Flown in", f"{results.core_s / 3600:.2g}", "hours", "on one core, all flights together"),
        ],
        sections=_parts(results),
    )


def write_comparison_page(comparison: Comparison, path: Path) -> None:
    """Writes the report of two campaigns."""
    first, second = comparison.first, comparison.second
    figures = [verdict for verdict in comparison.verdicts if verdict.says != "no difference shown"]
    _write(
        path,
        title=f"flockd campaigns: {first.path.name} and {second.path.name}",
        eyebrow=f"Comparison of two campaigns · {first.path} and {second.path}",
        headline=comparison.sentence,
        lead=(
            f"Over {_count(comparison.cells, 'cell')} that both flew. {second.path} is compared with {first.path}: a "
            "difference is its figure less the other’s."
        ),
        facts=[
            _fact("Figures that differ", f"{len(figures)}", f"of {len(comparison.verdicts)}", "all tests together"),
            _fact("Pairs", f"{max(v.pairs for v in comparison.verdicts)}", "", "seeds that both flew"),
        ],
        sections=_comparison_parts(comparison),
    )


def _write(path: Path, **texts: Any) -> None:
    page = page_template(Path(__file__).with_name("campaign.html")).render(**texts)
    path.write_text(page, encoding="utf-8")


def _lead(results: Results) -> str:
    config = results.plan.config
    varied = ", ".join(results.parameters)
    how = {"truth": "on exact states", "sight": "by sight", "control": "at control level"}[config.perception]
    how += "" if config.gated else ", without safety gates"
    unheld = "" if config.perception != "control" else "No supervisor flies along: wind slows and holds nobody. "
    return f"Each flight lasts {_durations(results)} {how}. {unheld}" + (f"What varies: {varied}." if varied else "")


def _durations(results: Results) -> str:
    base = {**results.plan.base, **results.plan.config.fixed}
    return (
        f"{base.get('duration_s', 110.0):g} s" if "duration_s" not in results.parameters else "as long as its cell says"
    )


def _known_cells(results: Results) -> list[dict[str, str]]:
    """How many cells the stop rule is content with."""
    stop = results.plan.config.stop
    if stop is None:
        return []
    known = sum(
        is_known([row[stop.figure] for row in results.rows if row["cell"] == cell.number], stop)
        for cell in results.plan.cells
    )
    wanted = f"± {stop.half_width:g} of the {MEASURES[stop.figure].name}"
    return [_fact("Known well enough", f"{known}", f"of {_count(len(results.plan.cells), 'cell')}", wanted)]


_CURVES = (
    "How to read this: the mean over the seeds, at each value the mean of all cells with it; the band is the 95 % "
    "confidence interval of that mean. All cells fly the same seeds."
)
_MAPS = "How to read this: the mean over the seeds and over all other parameters."
_CELLS = "How to read this: mean over the seeds, and half the width of its 95 % confidence interval."
_NEAREST = "The flights in which two drones came nearest; the command flies one again, with its full report."
_TEST = (
    "Flights with the same seed have the same starts, gusts and worlds, so they are pairs. The permutation test gives "
    "each pair’s difference either sign: p is the share of all ways in which the mean difference would be as large, if "
    f"it did not matter which campaign a flight is of. p is adjusted for the number of figures (Holm); below {LEVEL:g} "
    "a difference is called one."
)


def _parts(results: Results) -> list[Part]:
    curves, maps = [], []
    for figure in results.figures:
        if results.parameters:
            drawing = parameter_curves(results, figure)
            curves.append(_svg(drawing, f"{figure}-curves", f"{label_of(figure)} over the parameters"))
        if (two := heat_maps(results, figure)) is not None:
            maps.append(_svg(two, f"{figure}-map", f"{label_of(figure)} over two parameters"))
    drawn = [
        Part("Figures over the parameters", _CURVES, curves),
        Part("Two parameters at once", _MAPS, maps),
    ]
    tables = [_nearest(results), _cells(results), _failures(results)]
    return [*(part for part in drawn if part.drawings), *(part for part in tables if part.rows)]


def _cells(results: Results) -> Part:
    names = [name for name in results.parameters if name not in results.plan.drawn]
    rows: list[list[str | TableCell]] = []
    for cell in results.plan.cells[:MOST_ROWS]:
        count = sum(row["cell"] == cell.number and row["status"] == "flown" for row in results.rows)
        of_cell = [TableCell(_interval(results.interval(f, [cell.number]))) for f in results.figures]
        rows.append(
            [f"c{cell.number}", *(TableCell(shown(cell.parameters[n])) for n in names), TableCell(f"{count}"), *of_cell]
        )
    left_out = len(results.plan.cells) - MOST_ROWS
    note = f"{_CELLS} {left_out} more cells are in flights.parquet." if left_out > 0 else _CELLS
    return Part("All cells", note, (), ["cell", *names, "flights", *(label_of(f) for f in results.figures)], rows)


def _nearest(results: Results) -> Part:
    """The flights that were most dangerous."""
    measured = [row for row in results.rows if row.get("min_distance_m") is not None]
    near = sorted(measured, key=lambda row: float(row["min_distance_m"]))
    rows = [
        [row["run"], TableCell(f"{row['min_distance_m']:.2f} m"), TableCell(kind="text", code=_rerun(results, row))]
        for row in near[:NEAREST]
    ]
    return Part("Nearest flights", _NEAREST, (), ["flight", "nearest distance", "fly it again"], rows)


def _failures(results: Results) -> Part:
    rows = [
        [row["run"], TableCell(row["reason"], kind="text"), TableCell(kind="text", code=_rerun(results, row))]
        for row in results.failures[:MOST_ROWS]
    ]
    return Part("Flights that failed", "", (), ["flight", "reason", "fly it again"], rows)


def _rerun(results: Results, row: Row) -> str:
    return f"flockd campaign rerun {results.path / row['run']}"


def _comparison_parts(comparison: Comparison) -> list[Part]:
    names = [str(one.path) for one in (comparison.first, comparison.second)]
    columns = ["figure", *names, "difference", "95 % confidence", "pairs", "p", names[1]]
    parts = [
        Part("Differences", "", (), columns, [_verdict_row(verdict) for verdict in comparison.verdicts]),
        Part("The test", _TEST),
    ]
    if comparison.changes:
        rows: list[list[str | TableCell]] = [
            [key, TableCell(was, kind="text"), TableCell(now, kind="text")] for key, was, now in comparison.changes
        ]
        parts.append(Part("What differs for all flights", "", (), ["key", *names], rows))
    return parts


def _verdict_row(verdict: Verdict) -> list[str | TableCell]:
    difference = verdict.difference
    return [
        label_of(verdict.figure),
        TableCell(f"{verdict.first:.4g}"),
        TableCell(f"{verdict.second:.4g}"),
        TableCell(f"{difference.mean:+.3g}"),
        TableCell(f"{difference.low:+.3g} to {difference.high:+.3g}"),
        TableCell(f"{verdict.pairs}"),
        TableCell(f"{verdict.p:.2g}"),
        TableCell(verdict.says, kind="met" if verdict.says == "better" else ""),
    ]


def _interval(interval: Interval | None) -> str:
    return "" if interval is None else f"{interval.mean:.4g} ± {interval.half_width:.2g}"


def _svg(drawing: Drawing, name: str, description: str) -> Markup:
    return Markup(inline_svg(drawing, name, description))  # drawn here, from numbers


def _fact(name: str, value: str, unit: str, remark: str) -> dict[str, str]:
    return {"name": name, "value": value, "unit": unit, "remark": remark}


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}{'' if number == 1 else 's'}"
