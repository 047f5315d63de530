"""A campaign's figures for a page of the documentation: a table, and the report's curves as pictures.

    flockd campaign config/campaigns/large_flocks.yaml
    python -m tools.docs.docs_campaign out/large_flocks min_level_distance_m order_tail drone_collisions
    python -m tools.docs.docs_campaign out/large_flocks min_level_distance_m --picture docs/pictures/large_flocks.webp

The campaign varies one parameter, in one or several cases. Each entry of the table is the mean of a figure over the
seeds, with half the width of its 95 % confidence interval where that is not zero in the digits shown.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flockd.campaign.campaign_figures import label_of, parameter_curves, shown
from flockd.campaign.campaign_file import Figure
from flockd.campaign.flight_plan import CASE
from flockd.campaign.results import Results
from flockd.core.errors import UsageError

DPI = 110
QUALITY = 85


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the campaign")
    parser.add_argument("figures", nargs="*", metavar="FIGURE", help="of its `measure`; default: all")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the first figure there instead")
    args = parser.parse_args()
    results = Results.load(args.folder)
    if unknown := set(args.figures) - set(results.figures):
        parser.error(f"{args.folder} has no {', '.join(sorted(unknown))}; choose from {', '.join(results.figures)}")
    figures = args.figures or results.figures
    if args.picture is None:
        print(table(results, figures))
    else:
        parameter_curves(results, figures[0]).savefig(args.picture, dpi=DPI, pil_kwargs={"quality": QUALITY})
        print(f"{args.picture}: {args.picture.stat().st_size / 1e3:.0f} kB")


def table(results: Results, figures: Sequence[Figure]) -> str:
    """In Markdown: a row for each value of the parameter that varies, a column for each case."""
    varied = [name for name in results.parameters if name != CASE]
    if len(varied) != 1 or varied[0] in results.plan.drawn:
        raise UsageError(f"{results.path}: varies {', '.join(varied) or 'nothing'}; a table is of one parameter's grid")
    cases = results.values_of(CASE) if CASE in results.parameters else (None,)
    lines = [
        f"Of each cell: {'; '.join(label_of(figure) for figure in figures)}.\n",
        f"| {varied[0]} | {' | '.join(case or 'all' for case in cases)} |",
        "|---" * (len(cases) + 1) + "|",
    ]
    for value in results.values_of(varied[0]):
        chosen = [{varied[0]: value} if case is None else {varied[0]: value, CASE: case} for case in cases]
        entries = ["; ".join(_entry(results, figure, one) for figure in figures) for one in chosen]
        lines.append(f"| {shown(value)} | {' | '.join(entries)} |")
    return "\n".join(lines)


def _entry(results: Results, figure: Figure, wanted: dict[str, Any]) -> str:
    cells = results.cells_with(wanted)
    seeds = results.by_seed(figure, cells)
    if not seeds:
        return "-"
    mean, interval = sum(seeds.values()) / len(seeds), results.interval(figure, cells)
    digits = 0 if abs(mean) >= 100 else 2
    reach = "" if interval is None else f"{interval.half_width:.{digits}f}"
    return f"{mean:.{digits}f}" + (f" ± {reach}" if reach.strip("0.") else "")


if __name__ == "__main__":
    main()
