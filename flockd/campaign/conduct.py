"""Flies a campaign: which flights come next, each kept as soon as it is finished; and how long all of it takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

from flockd.campaign.engine import Engine
from flockd.campaign.flight_kinds import FLIGHT_KINDS, Task
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.folder import CampaignFolder, flown_in

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Conducted:
    """What was flown now."""

    flown: int
    failed: int
    before: int
    """Flights that were done already."""


def conduct(plan: Plan, folder: CampaignFolder, engine: Engine, progress: Progress) -> Conducted:
    """Flies what is missing. ``progress`` gets (done now, of how many).

    The table is written at the end, and when this is interrupted.
    """
    done_before = {one.run for one in flown_in(folder.path, plan)}
    tasks = _tasks(plan, done_before)
    total = plan.flights - len(done_before)
    waiting = next(tasks, None)
    flying = flown = failed = 0
    progress(0, total)
    try:
        while flying or waiting:
            while engine.room > 0 and waiting:
                engine.submit(waiting)
                flying += 1
                waiting = next(tasks, None)
            results = engine.wait()
            folder.add(results)
            flying, flown = flying - len(results), flown + len(results)
            failed += sum(one.reason is not None for one in results)
            progress(flown, total)
    finally:
        folder.write_table()
    return Conducted(flown, failed, len(done_before))


def _tasks(plan: Plan, done: Collection[Run]) -> Iterator[Task]:
    """Of the flights that are not done."""
    runs = (Run(cell.number, number) for cell in plan.cells for number in range(plan.config.seeds))
    return (task_of(plan, run) for run in runs if run not in done)


def task_of(plan: Plan, run: Run) -> Task:
    """The task that flies a flight."""
    recipe = plan.recipe(plan.cells[run.cell], run.number)
    return Task(plan.config.perception, plan.wanted, run, recipe, plan.config.gated)


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
    task = task_of(plan, Run(cell, 0))
    scenario = task.recipe.scenario()
    scenario = scenario.model_copy(update={"duration_s": steps * scenario.drone.step_s})
    begin_s = time.process_time()
    FLIGHT_KINDS[task.kind].fly(scenario, task)
    return time.process_time() - begin_s
