"""How the flights of a campaign are flown: one entry a kind, and one function for a task of any kind."""

from __future__ import annotations

import hashlib
import os
import platform
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import lru_cache

from flockd.campaign.campaign_file import FlightKindName
from flockd.campaign.figures import Figure, Figures, figures_of
from flockd.campaign.flight_plan import Recipe, Run
from flockd.core.choices import SimulatedPerception
from flockd.core.config.perception import PerceptionConfig
from flockd.core.errors import FlockdError
from flockd.flight.inference.hashes import model_hashes
from flockd.sim.control_level import fly_flocks
from flockd.sim.flock.swarm import fly
from flockd.sim.scenario import ScenarioConfig
from flockd.sim.scenario.perceived import PerceivedErrors


@dataclass(frozen=True)
class Task:
    """What is sent to where it is flown: flights of one cell."""

    kind: FlightKindName
    wanted: tuple[Figure, ...]
    runs: tuple[Run, ...]
    recipes: tuple[Recipe, ...]
    """As many."""
    gated: bool = True
    """See `CampaignConfig.gated`."""
    errors: PerceivedErrors | None = None
    """Perception's, at control level; None: exact states."""


Fly = Callable[[Sequence[ScenarioConfig], Task], Sequence[Figures]]
"""Flies a task's scenarios, and gives the wanted figures of each."""


@dataclass(frozen=True)
class FlightKind:
    """A way to fly."""

    fly: Fly
    perception: SimulatedPerception
    """With which `flockd sim` flies such a flight, for its full report."""
    at_once: int = 1
    """Flights of one task."""


def _alone(perception: SimulatedPerception) -> Fly:
    """Flies one after the other, each on this thread alone, without key frames."""

    def flown(scenarios: Sequence[ScenarioConfig], task: Task) -> list[Figures]:
        logs = (fly(one, perception=perception, gated=task.gated, processes=0, pictured=False).log for one in scenarios)
        return [figures_of(log, task.wanted) for log in logs]

    return flown


def _at_control_level(scenarios: Sequence[ScenarioConfig], task: Task) -> list[Figures]:
    """All at once, on this thread."""
    flown = fly_flocks(scenarios, errors=task.errors)
    found = ({figure: one.get(figure) for figure in task.wanted} for one in flown)
    return [{figure: None if value is None else float(value) for figure, value in one.items()} for one in found]


FLIGHT_KINDS: dict[FlightKindName, FlightKind] = {
    "truth": FlightKind(_alone("truth"), "truth"),
    "sight": FlightKind(_alone("learned"), "learned"),
    "control": FlightKind(_at_control_level, "truth", at_once=16),
}


@dataclass(frozen=True)
class FlownRun:
    """What came of one flight."""

    run: Run
    figures: Figures = field(default_factory=dict)
    reason: str | None = None
    """Why it failed."""
    scenario_sha256: str = ""
    """Of all values of its scenario, defaults included."""
    networks: str = ""
    """SHA-256 of each network, as `name=hash`."""
    wall_s: float = 0.0
    """Its share of its task's time."""
    cpu_s: float = 0.0
    began: str = ""
    host: str = ""
    process: int = 0


def fly_task(task: Task) -> list[FlownRun]:
    """Flies them. A flight that cannot be flown has its reason; of several, each is then tried by itself."""
    wall_s, cpu_s, began = time.perf_counter(), time.process_time(), datetime.now(UTC).isoformat(timespec="seconds")
    try:
        scenarios = [_single_threaded(recipe.scenario()) for recipe in task.recipes]
        figures = FLIGHT_KINDS[task.kind].fly(scenarios, task)
        networks = _networks(scenarios[0].drone.perception) if task.kind == "sight" else ""
    except Exception as error:  # noqa: BLE001 - whatever it is, it is one flight's result
        if len(task.runs) > 1:
            singles = zip(task.runs, task.recipes, strict=True)
            alone = [replace(task, runs=(run,), recipes=(recipe,)) for run, recipe in singles]
            return [flown for one in alone for flown in fly_task(one)]
        return [_failed(task.runs[0], error, began, time.perf_counter() - wall_s)]
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    share = len(task.runs)
    hashes = (hashlib.sha256(scenario.model_dump_json().encode()).hexdigest() for scenario in scenarios)
    return [
        FlownRun(run, found, None, sha256, networks, wall_s / share, cpu_s / share, began, platform.node(), os.getpid())
        for run, sha256, found in zip(task.runs, hashes, figures, strict=True)
    ]


def _single_threaded(scenario: ScenarioConfig) -> ScenarioConfig:
    """With networks on one thread: a campaign flies as many flights at once as there are processors."""
    perception = scenario.drone.perception.model_copy(update={"threads": 1})
    return scenario.model_copy(update={"drone": scenario.drone.model_copy(update={"perception": perception})})


def _failed(run: Run, error: Exception, began: str, wall_s: float) -> FlownRun:
    """An expected error is its sentence; of another one the place says more."""
    reason = str(error) if isinstance(error, FlockdError) else f"{type(error).__name__}: {error}"
    if not isinstance(error, FlockdError):
        places = traceback.extract_tb(error.__traceback__)
        reason += f" ({os.path.basename(places[-1].filename)}:{places[-1].lineno})"  # noqa: PTH119 - no file is meant
    return FlownRun(run, reason=reason, began=began, wall_s=wall_s, host=platform.node(), process=os.getpid())


@lru_cache(maxsize=64)
def _networks(perception: PerceptionConfig) -> str:
    return ", ".join(f"{name}={sha256}" for name, sha256 in sorted(model_hashes(perception).items()))
