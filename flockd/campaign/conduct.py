"""Flies a campaign: what is missing in its folder, on an engine, each flight kept as soon as it is finished."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from flockd.campaign.engine import Engine
from flockd.campaign.flight_kinds import FLIGHT_KINDS, Task
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.folder import CampaignFolder
from flockd.campaign.schedule import Schedule

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

    The folder is merged at the end, and when this is interrupted.
    """
    schedule = Schedule(plan)
    figure = None if plan.config.stop is None else plan.config.stop.figure
    done_before = list(folder.finished(figure))
    schedule.finished(done_before)
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
                schedule.finished((one.run, one.figures.get(figure) if figure else None) for one in results)
                flown += len(results)
                failed += sum(one.reason is not None for one in results)
                progress(flown, flown + schedule.most_left)
    finally:
        folder.merge()
    return Conducted(flown, failed, len(done_before))


def task_of(plan: Plan, runs: tuple[Run, ...]) -> Task:
    """The task that flies these flights of one cell."""
    recipes = tuple(plan.recipe(plan.cells[run.cell], run.number) for run in runs)
    return Task(plan.config.perception, plan.wanted, runs, recipes, plan.control)
