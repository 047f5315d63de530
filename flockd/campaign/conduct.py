"""Flies a campaign: which flights come next, each kept as soon as it is finished; and how long all of it takes."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from flockd.campaign.campaign_file import StopRule
from flockd.campaign.engine import Engine
from flockd.campaign.figures import MEASURES, Figure, mean_interval
from flockd.campaign.flight_kinds import FLIGHT_KINDS, FlownRun, Task
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.folder import CampaignFolder


class Schedule:
    """Without a stop rule all flights; with one a batch of a cell's seeds, and the next once all of these are done."""

    def __init__(self, plan: Plan) -> None:
        self._seeds, self._stop = plan.config.seeds, plan.config.stop
        self._batch = self._seeds if self._stop is None else self._stop.batch
        self._values: dict[int, dict[int, float | None]] = {cell.number: {} for cell in plan.cells}
        """What the stop rule is about, for each cell by number of the seed."""
        self._until = dict.fromkeys(self._values, 0)
        """How many seeds of each cell are to be flown."""
        self._open = set(self._values)
        """Cells that may need more."""
        self._waiting: deque[tuple[int, Iterator[int]]] = deque()
        """Cells, each with seeds that are to be flown."""
        for cell in self._values:
            self._decide(cell)

    def finished(self, runs: Iterable[tuple[Run, float | None]]) -> None:
        """Takes note of flights, each with its value of the stop rule's figure; None where it has none."""
        for run, value in runs:
            self._values[run.cell][run.number] = value
            self._decide(run.cell)

    def next(self, count: int) -> tuple[Run, ...]:
        """Up to ``count`` flights of one cell that are to be flown; empty where there are none now."""
        found: list[Run] = []
        while self._waiting and not found:
            cell, numbers = self._waiting[0]
            missing = (Run(cell, number) for number in numbers if number not in self._values[cell])
            found = list(itertools.islice(missing, count))
            if len(found) < count:
                self._waiting.popleft()
        return tuple(found)

    @property
    def most_left(self) -> int:
        """Flights that are not done, if no open cell is known well enough before its last seed."""
        needed = sum(self._seeds if cell in self._open else self._until[cell] for cell in self._values)
        return needed - sum(len(values) for values in self._values.values())

    def _decide(self, cell: int) -> None:
        """Once all flights so far are done: whether the cell needs more."""
        values = self._values[cell]
        while cell in self._open:
            begin = self._until[cell]
            if len(values) < begin or not all(number in values for number in range(begin)):
                return
            known = self._stop is not None and is_known([values[number] for number in range(begin)], self._stop)
            if begin == self._seeds or known:
                self._open.remove(cell)
            else:
                self._until[cell] = min(begin + self._batch, self._seeds)
                self._waiting.append((cell, iter(range(begin, self._until[cell]))))


def is_known(values: Iterable[float | None], stop: StopRule) -> bool:
    """Whether a cell with these values is known well enough."""
    known = [value for value in values if value is not None]
    interval = mean_interval(known, stop.confidence, is_share=MEASURES[stop.figure].is_share)
    return interval is not None and interval.half_width <= stop.half_width


Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Conducted:
    """What was flown now."""

    flown: int
    failed: int
    before: int
    """Flights that were done already."""


def conduct(plan: Plan, folder: CampaignFolder, engine: Engine, progress: Progress) -> Conducted:
    """Flies until every cell has all its seeds, or is known well enough. ``progress`` gets (done now, at most).

    The tables are written at the end, and when this is interrupted.
    """
    schedule = Schedule(plan)
    figure = None if plan.config.stop is None else plan.config.stop.figure
    done_before = list(folder.finished())
    schedule.finished(_values(done_before, figure))
    at_once = FLIGHT_KINDS[plan.config.perception].at_once
    flying = flown = failed = 0
    progress(0, schedule.most_left)
    try:
        while True:
            while engine.room > 0 and (runs := schedule.next(at_once)):
                engine.submit(task_of(plan, runs))
                flying += 1
            if not flying:
                break
            for results in engine.wait():
                flying -= 1
                folder.add(results)
                schedule.finished(_values(results, figure))
                flown += len(results)
                failed += sum(one.reason is not None for one in results)
                progress(flown, flown + schedule.most_left)
    finally:
        folder.write_tables()
    return Conducted(flown, failed, len(done_before))


def _values(flown: Iterable[FlownRun], figure: Figure | None) -> Iterator[tuple[Run, float | None]]:
    """Flights, each with its value of a figure."""
    return ((one.run, one.figures.get(figure) if figure else None) for one in flown)


def task_of(plan: Plan, runs: tuple[Run, ...]) -> Task:
    """The task that flies these flights of one cell."""
    recipes = tuple(plan.recipe(plan.cells[run.cell], run.number) for run in runs)
    return Task(plan.config.perception, plan.wanted, runs, recipes, plan.config.gated, plan.errors)


SHORT_STEPS = 3
"""Steps of a cell's first trial flight. The second one is longer: the difference is what its steps take, the rest what
a flight takes before its first."""
LONG_S = 0.5
"""The second flight is twice as long until it takes so much more time than the first, or is a whole flight."""


def estimate(plan: Plan, progress: Callable[[int, int], None]) -> float:
    """Mean processor time of a flight, s, by short ones of the first, the middle and the last cell, on this thread.

    Raises what flying raises.
    """
    cells = sorted({0, len(plan.cells) // 2, len(plan.cells) - 1})
    progress(0, len(cells))
    _trial(plan, cells[0], SHORT_STEPS)  # compiles and loads what later flights find ready
    times = []
    for done, cell in enumerate(cells, 1):
        times.append(_whole_flight(plan, cell))
        progress(done, len(cells))
    return sum(times) / len(times)


def _whole_flight(plan: Plan, cell: int) -> float:
    """Seconds of processor time."""
    scenario, steps = plan.recipe(plan.cells[cell], 0).scenario(), SHORT_STEPS
    whole = round(scenario.duration_s / scenario.drone.step_s)
    short_s = long_s = _trial(plan, cell, SHORT_STEPS)
    while steps < whole and long_s - short_s < LONG_S:
        steps = min(2 * steps, whole)
        long_s = _trial(plan, cell, steps)
    if steps == whole:
        return long_s
    step_s = (long_s - short_s) / (steps - SHORT_STEPS)
    return max(short_s - SHORT_STEPS * step_s, 0.0) + whole * step_s


def _trial(plan: Plan, cell: int, steps: int) -> float:
    """Seconds of processor time of a flight of so many steps."""
    kind = FLIGHT_KINDS[plan.config.perception]
    task = task_of(plan, tuple(Run(cell, number) for number in range(min(kind.at_once, plan.config.seeds))))
    scenarios = [recipe.scenario() for recipe in task.recipes]
    scenarios = [one.model_copy(update={"duration_s": steps * one.drone.step_s}) for one in scenarios]
    begin_s = time.process_time()
    kind.fly(scenarios, task)
    return (time.process_time() - begin_s) / len(scenarios)
