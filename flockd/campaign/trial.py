"""How long a campaign takes, by a short trial."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from flockd.campaign.conduct import task_of
from flockd.campaign.flight_kinds import FLIGHT_KINDS
from flockd.campaign.flight_plan import Plan, Run

SHORT_STEPS = 3
"""Steps of a cell's first trial flight. The second one is longer: the difference is what its steps take, the rest what
a flight takes before its first."""
LONG_S = 0.5
"""The second flight is twice as long until it takes so much more time than the first, or is a whole flight."""


@dataclass(frozen=True)
class Estimate:
    """What a campaign will take."""

    cells: int
    flights: int
    """At most."""
    core_hours: float
    """Hours of one processor core, at most."""
    flight_s: float
    """Mean processor time of a flight."""


def estimate(plan: Plan, progress: Callable[[int, int], None]) -> Estimate:
    """By short flights of the first, the middle and the last cell, on this thread. Raises what flying raises."""
    cells = sorted({0, len(plan.cells) // 2, len(plan.cells) - 1})
    progress(0, len(cells))
    _trial(plan, cells[0], SHORT_STEPS)  # compiles and loads what later flights find ready
    times = []
    for done, cell in enumerate(cells, 1):
        times.append(_whole_flight(plan, cell))
        progress(done, len(cells))
    flight_s = sum(times) / len(times)
    return Estimate(len(plan.cells), plan.most_flights, plan.most_flights * flight_s / 3600, flight_s)


def _whole_flight(plan: Plan, cell: int) -> float:
    """Seconds of processor time."""
    whole, steps = _steps(plan, cell), SHORT_STEPS
    short_s = long_s = _trial(plan, cell, SHORT_STEPS)
    while steps < whole and long_s - short_s < LONG_S:
        steps = min(2 * steps, whole)
        long_s = _trial(plan, cell, steps)
    if steps == whole:
        return long_s
    step_s = (long_s - short_s) / (steps - SHORT_STEPS)
    return max(short_s - SHORT_STEPS * step_s, 0.0) + whole * step_s


def _steps(plan: Plan, cell: int) -> int:
    scenario = plan.recipe(plan.cells[cell], 0).scenario()
    return round(scenario.duration_s / scenario.drone.step_s)


def _trial(plan: Plan, cell: int, steps: int) -> float:
    """Seconds of processor time of a flight of so many steps."""
    kind = FLIGHT_KINDS[plan.config.perception]
    recipes = task_of(plan, tuple(Run(cell, number) for number in range(min(kind.at_once, plan.config.seeds)))).recipes
    scenarios = [recipe.scenario() for recipe in recipes]
    scenarios = [one.model_copy(update={"duration_s": steps * one.drone.step_s}) for one in scenarios]
    begin_s = time.process_time()
    kind.fly(scenarios, plan.wanted, plan.control)
    return (time.process_time() - begin_s) / len(scenarios)
