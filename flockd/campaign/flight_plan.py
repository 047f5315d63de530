"""A campaign's flights: its cells, checked before anything flies, and what each flight is made of."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from pydantic import ValidationError

from flockd import __version__
from flockd.campaign.campaign_file import DRONES, CampaignConfig, Variation, load_campaign
from flockd.core.choices import ROLES
from flockd.core.config.document import KeyPath, Place, key_text
from flockd.core.config.loader import PATHS
from flockd.core.config.validation_messages import problems_of
from flockd.core.errors import ConfigError, ConfigProblem, UsageError
from flockd.flight.inference.manifest_file import model_hashes
from flockd.sim.flock.start import scattered, with_drones
from flockd.sim.scenario import MAX_DRONES, ScenarioConfig, load_with_places

Values = dict[str, Any]


@dataclass(frozen=True, order=True)
class Run:
    """One flight: a cell, and which of its seeds, both from 0."""

    cell: int
    number: int

    @property
    def name(self) -> str:
        """Its name in results and commands."""
        return f"c{self.cell}-s{self.number}"


@dataclass(frozen=True)
class Task:
    """One flight as it is sent to a process: a scenario's own values, and values that override them."""

    run: Run
    config: CampaignConfig
    base: Mapping[str, Any]
    overrides: Mapping[str, Any]
    """By dotted key."""

    def scenario(self, *, scatter: bool = True) -> ScenarioConfig:
        """The flight's scenario. Raises ValidationError for values that cannot be flown, UsageError for starts."""
        values = merged(self.base, {**self.overrides, "seed": self.config.seed_of(self.run.cell, self.run.number)})
        count = values.pop(DRONES, None)
        scenario = ScenarioConfig.model_validate(values)
        if count is not None:
            scenario = with_drones(scenario, count)
        return scattered(scenario, self.config.scatter_m) if scatter and self.config.scatter_m else scenario


def merged(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> Values:
    """The values with overrides by dotted key. Raises ValueError if a key leads into a list or a plain value."""
    values = dict(base)
    for key, value in overrides.items():
        *sections, last = key.split(".")
        inside = values
        for section in sections:
            inner = inside.get(section)
            if inner is not None and not isinstance(inner, Mapping):
                raise ValueError(f"`{section}` is not a section, so that it has no `{last}`; set `{section}` itself")
            inside[section] = dict(inner or {})
            inside = inside[section]
        inside[last] = value
    return values


CASE = "case"
"""The parameter whose values are the names of `cases`."""
MAX_CELLS = 10_000
Places = Mapping[KeyPath, Place]


@dataclass(frozen=True)
class Cell:
    """One combination of the values that vary."""

    number: int
    """From 0, in the order of the file; the last key of `vary` changes fastest."""
    parameters: Mapping[str, Any]
    """The value of each key of the grid, and of `case`."""


@dataclass(frozen=True)
class Plan:
    """All flights of a campaign, as values: nothing more is read from files."""

    config: CampaignConfig
    base: Mapping[str, Any]
    """The scenario's own values, its drone's within."""

    @classmethod
    def load(cls, path: Path) -> Self:
        """The plan that a campaign's file describes.

        Raises ConfigError with everything wrong with it, its scenario and each cell, and ModelError for networks that
        are not there.
        """
        config, places = load_campaign(path)
        scenario, of_scenario = load_with_places(path.parent / config.scenario)
        if not isinstance(scenario, ScenarioConfig):
            fault = f"names {config.scenario}, which is a drone's own file; name a scenario"
            raise ConfigError([places["scenario",].problem(fault)])
        config = _anchored(config, path.parent)
        _check_keys(config, places)
        plan = cls(config, scenario.model_dump(exclude_unset=True))
        if problems := {one for cell in plan.cells for one in _problems(plan, cell, places, of_scenario)}:
            raise ConfigError(sorted(problems))
        if idle := _idle_seeds(plan):
            raise ConfigError([places["seeds",].problem(idle)])
        if config.perception == "sight":
            for perception in {plan.task(cell, 0).scenario().drone.perception for cell in plan.cells}:
                model_hashes(perception)
        return plan

    @classmethod
    def from_values(cls, values: Any) -> Self:
        """The plan whose `to_json` these values were read from. Raises ValueError with the reason in a few words."""
        try:
            values = _with_tuples(values)
            config = CampaignConfig.model_validate(values["campaign"])
            ScenarioConfig.model_validate(base := values["scenario"])
        except ValidationError as error:
            first = error.errors()[0]
            raise ValueError(f"{key_text(first['loc']) or 'campaign'}: {first['msg']}") from error
        except KeyError as error:
            raise ValueError(f"it has no {error}") from error
        except (TypeError, AttributeError) as error:
            raise ValueError("it holds something else") from error
        if (cells := _count_of_cells(config)) > MAX_CELLS:
            raise ValueError(f"it has {cells} cells")
        return cls(config, base)

    def to_json(self) -> str:
        """The whole plan and the version of flockd: plans with the same text have the same flights.

        In the order of the file, by which the cells are numbered.
        """
        config = self.config.model_dump(mode="json")
        values = {"flockd": __version__, "campaign": config, "scenario": self.base}
        return json.dumps(values, indent=1) + "\n"

    @property
    def sha256(self) -> str:
        """The hash of what `to_json` writes."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """All cells, in order."""
        axes = {CASE: tuple(self.config.cases)} if self.config.cases else {}
        axes |= {key: variation.values for key, variation in self.config.vary.items()}
        combinations = enumerate(itertools.product(*axes.values()))
        return tuple(Cell(number, dict(zip(axes, values, strict=True))) for number, values in combinations)

    @property
    def flights(self) -> int:
        """Number of flights."""
        return len(self.cells) * self.config.seeds

    def task(self, cell: Cell, number: int) -> Task:
        """One flight of a cell, by its number from 0."""
        varied = {key: value for key, value in cell.parameters.items() if key != CASE}
        of_case = self.config.cases[cell.parameters[CASE]] if CASE in cell.parameters else {}
        return Task(Run(cell.number, number), self.config, self.base, {**self.config.fixed, **of_case, **varied})


def _count_of_cells(config: CampaignConfig) -> int:
    return max(len(config.cases), 1) * math.prod(len(one.values) for one in config.vary.values())


def _idle_seeds(plan: Plan) -> str | None:
    """What is wrong where all seeds of a cell fly exactly the same flight."""
    config = plan.config
    if config.seeds == 1 or config.perception == "sight" or config.scatter_m:
        return None
    for cell in plan.cells:
        scenario = plan.task(cell, 0).scenario()
        if scenario.vehicle.gust_m_s or scenario.world.obstacles is not None:
            return None
    return (
        "are all the same flight: on exact states without gusts and obstacles nothing depends on the seed; "
        "write `scatter_m: 0.5`, or `vehicle.gust_m_s: 0.3` in `fixed`, or `seeds: 1`"
    )


def _anchored(config: CampaignConfig, folder: Path) -> CampaignConfig:
    """With absolute paths in the place of those that count from the campaign's folder."""

    def anchored(key: str, value: Any) -> Any:
        path = tuple(key.split("."))
        is_path = path[-2:] in PATHS and isinstance(value, str) and (path[-1] not in ROLES or value.endswith(".yaml"))
        return str((folder / value).resolve()) if is_path else value

    def all_anchored(values: Mapping[str, Any]) -> Values:
        return {key: anchored(key, value) for key, value in values.items()}

    vary = {key: Variation(values=tuple(anchored(key, v) for v in one.values)) for key, one in config.vary.items()}
    cases = {case: all_anchored(values) for case, values in config.cases.items()}
    return config.model_copy(update={"fixed": all_anchored(config.fixed), "vary": vary, "cases": cases})


def _with_tuples(value: Any) -> Any:
    """JSON's lists as the tuples that a configuration holds."""
    if isinstance(value, dict):
        return {key: _with_tuples(inner) for key, inner in value.items()}
    return tuple(_with_tuples(inner) for inner in value) if isinstance(value, list) else value


def _check_keys(config: CampaignConfig, places: Places) -> None:
    """Raises ConfigError for what needs no scenario: sizes of flocks, how many cells, a wind without effect."""
    wrong = [
        places[path].problem(f"must be whole numbers from 1 to {MAX_DRONES}, as in `values: [5, 10]`")
        for path, values in _given(config, DRONES).items()
        if not all(isinstance(n, int) and not isinstance(n, bool) and 1 <= n <= MAX_DRONES for n in values)
    ]
    if (cells := _count_of_cells(config)) > MAX_CELLS:
        section = places.get(("vary",), places[()])
        wrong.append(section.problem(f"makes {cells} cells; write fewer values, for at most {MAX_CELLS}"))
    fault = (
        "changes nothing without images: a steady wind only tilts the drone, whose autopilot holds the velocity "
        "over ground; write `perception: sight`, or `vehicle.gust_m_s` for wind that carries it off, or delete it"
    )
    winds = {} if config.perception == "sight" else _given(config, "vehicle.wind_m_s")
    wrong += [places[path].problem(fault) for path in winds]
    if wrong:
        raise ConfigError(wrong)


def _given(config: CampaignConfig, key: str) -> dict[KeyPath, Sequence[Any]]:
    """The values that a campaign sets for a key, each with its path in the campaign's file."""
    found: dict[KeyPath, Sequence[Any]] = {("fixed", key): [config.fixed[key]]} if key in config.fixed else {}
    found |= {("cases", case, key): [values[key]] for case, values in config.cases.items() if key in values}
    return found | ({("vary", key): config.vary[key].values} if key in config.vary else {})


def _problems(plan: Plan, cell: Cell, given: Places, of_scenario: Places) -> list[ConfigProblem]:
    """What is wrong with the values that a campaign sets, each with its place in the campaign's file."""
    task, places = plan.task(cell, 0), _places_of(plan, cell, given, of_scenario)
    for key, value in task.overrides.items():
        try:
            merged(plan.base, {key: value})
        except ValueError as error:
            return [places[tuple(key.split("."))].problem(str(error))]
    try:
        task.scenario(scatter=False)
    except ValidationError as error:
        return problems_of(error.errors(), ScenarioConfig, places)
    except UsageError as error:
        return [places[()].problem(str(error))]
    return []


def _places_of(plan: Plan, cell: Cell, given: Places, of_scenario: Places) -> Places:
    """Where each value of the cell's scenario stands: in the campaign's file, or in the scenario's or drone's."""
    config, places = plan.config, dict(of_scenario)
    origins: dict[str, KeyPath] = {key: ("fixed", key) for key in config.fixed}
    if (case := cell.parameters.get(CASE)) is not None:
        origins |= {key: ("cases", case, key) for key in config.cases[case]}
    for key, variation in config.vary.items():
        origins[key] = ("vary", key, "values", variation.values.index(cell.parameters[key]))
    for key, origin in origins.items():
        path, depth = tuple(key.split(".")), len(origin)
        places |= {path[:length]: places.get(path[:length], given[origin]) for length in range(1, len(path))}
        places = {at: one for at, one in places.items() if at[: len(path)] != path}
        places |= {(*path, *at[depth:]): one for at, one in given.items() if at[:depth] == origin}
    return places
