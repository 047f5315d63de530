"""Flies a campaign: which flights come next, each kept as soon as it is finished; and how long all of it takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from flockd.campaign.engine import ProcessEngine
from flockd.campaign.flight_kinds import figures_flown
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.folder import CampaignFolder, flown_in

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Conducted:
    """How many flights one call has flown."""

    flown: int
    failed: int
    before: int
    """Flights that were done already."""


def conduct(plan: Plan, folder: CampaignFolder, engine: ProcessEngine, progress: Progress) -> Conducted:
    """Flies the flights of a plan that its folder does not hold yet.

    ``progress`` is called with (flights done now, flights to do). The table is written at the end, and after an
    interruption.
    """
    done_before = {one.run for one in flown_in(folder.path, plan)}
    runs = ((cell, number) for cell in plan.cells for number in range(plan.config.seeds))
    tasks = (plan.task(cell, number) for cell, number in runs if Run(cell.number, number) not in done_before)
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


SHORT_STEPS, LONG_STEPS = 3, {"truth": 60, "sight": 9}
"""Of the two trial flights of a cell: the difference is what its steps take, the rest what a flight takes before."""


def estimate(plan: Plan, progress: Callable[[int, int], None]) -> float:
    """Mean processor time of a flight, s, from short trial flights of the first, middle and last cell on this thread.

    ``progress`` is called with (cells done, cells to try). Raises the errors of `flockd.sim.flock.swarm.fly`.
    """
    cells = sorted({0, len(plan.cells) // 2, len(plan.cells) - 1})
    progress(0, len(cells))
    _trial(plan, cells[0], SHORT_STEPS)  # compiles and loads what later flights find ready
    total_s = 0.0
    for done, cell in enumerate(cells, 1):
        scenario = plan.task(plan.cells[cell], 0).scenario()
        steps, more = round(scenario.duration_s / scenario.drone.step_s), LONG_STEPS[plan.config.perception]
        short_s, long_s = _trial(plan, cell, SHORT_STEPS), _trial(plan, cell, more)
        total_s += max(long_s + (steps - more) * (long_s - short_s) / (more - SHORT_STEPS), 0.0)
        progress(done, len(cells))
    return total_s / len(cells)


def _trial(plan: Plan, cell: int, steps: int) -> float:
    """Seconds of processor time of a flight of so many steps."""
    task = plan.task(plan.cells[cell], 0)
    scenario = task.scenario()
    scenario = scenario.model_copy(update={"duration_s": steps * scenario.drone.step_s})
    begin_s = time.process_time()
    figures_flown(scenario, task)
    return time.process_time() - begin_s
