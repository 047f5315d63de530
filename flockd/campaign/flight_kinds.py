"""How the flight of a task is flown, and what is kept of it."""

from __future__ import annotations

import hashlib
import os
import platform
import time
import traceback
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache

from flockd.campaign.campaign_file import FlightKindName
from flockd.campaign.figures import Figures, figures_of
from flockd.campaign.flight_plan import Run, Task
from flockd.core.choices import SimulatedPerception
from flockd.core.config.perception import PerceptionConfig
from flockd.core.errors import FlockdError
from flockd.flight.inference.manifest_file import model_hashes
from flockd.sim.flock.swarm import fly
from flockd.sim.scenario import ScenarioConfig

PERCEPTIONS: dict[FlightKindName, SimulatedPerception] = {"truth": "truth", "sight": "learned"}
"""The `--perception` of `flockd sim` for each kind of flight."""


def figures_flown(scenario: ScenarioConfig, task: Task) -> Figures:
    """Flies a task's scenario, on this thread alone and without key frames, and gives the wanted figures."""
    perception, gated = PERCEPTIONS[task.config.perception], task.config.gated
    log = fly(scenario, perception=perception, gated=gated, threads=0, pictured=False).log
    return figures_of(log, task.config.wanted)


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
    cpu_s: float = 0.0
    began: str = ""
    host: str = ""
    process: int = 0


def fly_task(task: Task) -> FlownRun:
    """Flies it. A flight that cannot be flown has its reason."""
    wall_s, cpu_s, began = time.perf_counter(), time.process_time(), datetime.now(UTC).isoformat(timespec="seconds")
    try:
        scenario = _single_threaded(task.scenario())
        figures = figures_flown(scenario, task)
        networks = _networks(scenario.drone.perception) if task.config.perception == "sight" else ""
    except Exception as error:  # noqa: BLE001 - whatever it is, it is one flight's result
        return _failed(task.run, error, began, time.perf_counter() - wall_s)
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    sha256 = hashlib.sha256(scenario.model_dump_json().encode()).hexdigest()
    return FlownRun(task.run, figures, None, sha256, networks, wall_s, cpu_s, began, platform.node(), os.getpid())


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
