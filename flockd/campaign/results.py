"""The results of a campaign by cell and seed, and two campaigns compared, figure by figure, by pairs of seeds."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flockd.campaign.campaign_file import DRONES
from flockd.campaign.figures import MEASURES, Figure, Interval, mean_interval
from flockd.campaign.flight_plan import Plan, merged
from flockd.campaign.folder import differences, flight_rows, flown_in, load_plan
from flockd.core.errors import UsageError
from flockd.core.messages import FloatArray
from flockd.sim.scenario import ScenarioConfig

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
        """Figures of which at least one flight has a value."""
        return tuple(figure for figure in self.plan.config.wanted if any(row[figure] is not None for row in self.rows))

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters that vary."""
        return tuple(self.plan.cells[0].parameters)

    def values_of(self, parameter: str) -> tuple[Any, ...]:
        """The values of a parameter of the grid, in its order."""
        return tuple(dict.fromkeys(_hashable(cell.parameters[parameter]) for cell in self.plan.cells))

    def cells_with(self, wanted: Mapping[str, Any]) -> tuple[int, ...]:
        """Numbers of the cells that have these values, by parameter."""
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


LEVEL = 0.05
"""Significance level for all figures together: at most this often, one is called different where none is."""
_DRAWS = 9_999


@dataclass(frozen=True)
class Verdict:
    """The comparison of one figure."""

    figure: Figure
    first: float
    second: float
    """Means."""
    difference: Interval
    """Second less first, with its 95 % confidence interval."""
    pairs: int
    """Seeds that both campaigns flew."""
    p: float
    """How often a difference so large would come up if there were none, times the number of figures (Bonferroni)."""

    @property
    def says(self) -> Literal["better", "worse", "no difference shown"]:
        """Whether the second campaign is better."""
        if self.p > LEVEL:
            return "no difference shown"
        return "better" if (self.difference.mean > 0) == (MEASURES[self.figure].better == "higher") else "worse"


@dataclass(frozen=True)
class Comparison:
    """Two campaigns compared."""

    first: Results
    second: Results
    cells: int
    """Cells that both campaigns have."""
    verdicts: tuple[Verdict, ...]
    changes: tuple[tuple[str, str, str], ...]
    """Keys whose values differ for all flights, with both values."""

    @property
    def sentence(self) -> str:
        """Whether the second is better, in words."""
        better = [MEASURES[verdict.figure].name for verdict in self.verdicts if verdict.says == "better"]
        worse = [MEASURES[verdict.figure].name for verdict in self.verdicts if verdict.says == "worse"]
        name = f"{self.second.path}"
        if better and worse:
            return f"{name} is better in {_listed(better)}, but worse in {_listed(worse)}"
        if better or worse:
            return f"{name} is {'better' if better else 'worse'} in {_listed(better or worse)}"
        return f"No difference is shown between {self.first.path} and {name}"


def compare(first: Results, second: Results) -> Comparison:
    """Compares flights of the same cell and seed as pairs. Raises UsageError if nothing can be compared."""
    theirs = {_key(cell.parameters): cell.number for cell in second.plan.cells}
    cells = [(c.number, theirs[_key(c.parameters)]) for c in first.plan.cells if _key(c.parameters) in theirs]
    figures = [figure for figure in first.figures if figure in second.figures]
    verdicts = [verdict for figure in figures if (verdict := _verdict(first, second, figure, cells)) is not None]
    if not verdicts:
        raise UsageError(
            f"{first.path} and {second.path} cannot be compared, without a cell and a figure that both have of two "
            "seeds alike; vary and measure the same in both, from the same `seed` on"
        )
    adjusted = tuple(replace(verdict, p=min(verdict.p * len(verdicts), 1.0)) for verdict in verdicts)
    return Comparison(first, second, len(cells), adjusted, tuple(differences(_values(first), _values(second))))


def _verdict(first: Results, second: Results, figure: Figure, cells: list[tuple[int, int]]) -> Verdict | None:
    mine = first.by_seed(figure, [one for one, _ in cells])
    theirs = second.by_seed(figure, [other for _, other in cells])
    # Flight n of both is a pair only where the seeds are the same.
    offset = first.plan.config.seed - second.plan.config.seed
    common = [number for number in mine if number + offset in theirs]
    a = np.array([mine[number] for number in common])
    b = np.array([theirs[number + offset] for number in common])
    difference = mean_interval((b - a).tolist())
    if difference is None:
        return None
    return Verdict(figure, float(a.mean()), float(b.mean()), difference, len(common), paired_p(b - a))


def paired_p(differences: FloatArray) -> float:
    """The p value of differences (n,) by a permutation test, which flips their signs.

    It is the share of all ways to give signs, or of `_DRAWS` random ones, whose mean is at least as far from zero.
    """
    from scipy.stats import permutation_test  # noqa: PLC0415 - heavy

    found = permutation_test(
        (differences,), np.mean, permutation_type="samples", n_resamples=_DRAWS, batch=100, rng=0, vectorized=True
    )
    return float(found.pvalue)


def _key(parameters: Mapping[str, Any]) -> str:
    return json.dumps(dict(parameters), sort_keys=True)


def _values(results: Results) -> Mapping[str, Any]:
    """What holds for all flights, with every default."""
    config = results.plan.config
    fixed = {key: value for key, value in config.fixed.items() if key != DRONES}
    scenario = ScenarioConfig.model_validate(merged(results.plan.base, fixed)).model_dump(mode="json")
    own: dict[str, Any] = {"perception": config.perception, "gated": config.gated, "scatter_m": config.scatter_m}
    own[DRONES] = config.fixed.get(DRONES)
    return {"campaign": own, **scenario}


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
