"""The results of a campaign, as its report takes them: values of each figure by cell and seed."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from flockd.campaign.figures import MEASURES, Figure, Interval, mean_interval
from flockd.campaign.flight_plan import Plan
from flockd.campaign.folder import flight_rows, flown_in, load_plan
from flockd.core.errors import UsageError

Row = Mapping[str, Any]
Seeds = dict[int, float]
"""A figure's value for each seed number, from one or several cells."""


@dataclass(frozen=True)
class Results:
    """The results of a campaign, finished or not."""

    path: Path
    plan: Plan
    rows: tuple[Row, ...]
    """In order of cells and seeds."""
    core_s: float
    """What all flights took together, of one core."""

    @classmethod
    def load(cls, path: Path) -> Results:
        """The results in a campaign's folder. Raises UsageError where nothing is in it."""
        plan = load_plan(path)
        flown = flown_in(path, plan)
        if not flown:
            raise UsageError(f"{path}: no flight is finished; run `flockd campaign` first")
        return cls(path, plan, tuple(flight_rows(plan, flown)), sum(one.wall_s for one in flown))

    @property
    def failures(self) -> tuple[Row, ...]:
        """Flights without figures."""
        return tuple(row for row in self.rows if row["status"] == "failed")

    @property
    def figures(self) -> tuple[Figure, ...]:
        """Those that a flight has a value of."""
        return tuple(figure for figure in self.plan.wanted if any(row[figure] is not None for row in self.rows))

    @property
    def parameters(self) -> tuple[str, ...]:
        """What varies: the grid's first, then what each flight draws."""
        grid = self.plan.cells[0].parameters if self.plan.cells else {}
        return (*grid, *self.plan.drawn)

    def values_of(self, parameter: str) -> tuple[Any, ...]:
        """The values of a parameter of the grid, in its order."""
        return tuple(dict.fromkeys(_hashable(cell.parameters[parameter]) for cell in self.plan.cells))

    def cells_with(self, wanted: Mapping[str, Any]) -> tuple[int, ...]:
        """Cells that have these values of the grid."""
        return tuple(
            cell.number
            for cell in self.plan.cells
            if all(_hashable(cell.parameters[key]) == value for key, value in wanted.items())
        )

    def by_seed(self, figure: Figure, cells: Iterable[int]) -> Seeds:
        """For each seed that all these cells flew, the figure's mean over the cells; failed flights are left out."""
        wanted = tuple(cells)
        found: defaultdict[int, list[float]] = defaultdict(list)
        for row in (row for cell in wanted for row in self._by_cell.get(cell, ())):
            if row[figure] is not None:
                found[row["number"]].append(row[figure])
        return {number: float(np.mean(values)) for number, values in found.items() if len(values) == len(wanted)}

    def interval(self, figure: Figure, cells: Iterable[int]) -> Interval | None:
        """The mean over the seeds, with its 95 % confidence interval."""
        cells = tuple(cells)
        is_share = MEASURES[figure].is_share and len(cells) == 1
        return mean_interval(list(self.by_seed(figure, cells).values()), is_share=is_share)

    @cached_property
    def _by_cell(self) -> dict[int, list[Row]]:
        found: defaultdict[int, list[Row]] = defaultdict(list)
        for row in self.rows:
            found[row["cell"]].append(row)
        return found


def _hashable(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, dict | list | tuple) else value
