"""Flies one flight of a campaign, and keeps its figures and where they come from."""

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
    """The result of one flight."""

    run: Run
    figures: Figures = field(default_factory=dict)
    reason: str | None = None
    """Why it failed."""
    scenario_sha256: str = ""
    """Of all values of its scenario, defaults included."""
    networks: str = ""
    """SHA-256 of each network, as `name=hash`."""
    wall_s: float = 0.0
    began: str = ""
    """Wall time, ISO 8601."""
    host: str = ""
    process: int = 0


def fly_task(task: Task) -> FlownRun:
    """Flies one flight. An error of any kind becomes the reason of its result."""
    begin_s, began = time.perf_counter(), datetime.now(UTC).isoformat(timespec="seconds")
    figures, reason, sha256, networks = Figures(), None, "", ""
    try:
        scenario = _single_threaded(task.scenario())
        figures = figures_flown(scenario, task)
        networks = _networks(scenario.drone.perception) if task.config.perception == "sight" else ""
        sha256 = hashlib.sha256(scenario.model_dump_json().encode()).hexdigest()
    except Exception as error:  # noqa: BLE001 - whatever it is, it is one flight's result
        reason = _reason(error)
    wall_s = time.perf_counter() - begin_s
    return FlownRun(task.run, figures, reason, sha256, networks, wall_s, began, platform.node(), os.getpid())


def _single_threaded(scenario: ScenarioConfig) -> ScenarioConfig:
    """With networks on one thread: a campaign flies as many flights at once as there are processors."""
    perception = scenario.drone.perception.model_copy(update={"threads": 1})
    return scenario.model_copy(update={"drone": scenario.drone.model_copy(update={"perception": perception})})


def _reason(error: Exception) -> str:
    """The sentence of an expected error; of another one also its type and the line that raised it."""
    if isinstance(error, FlockdError):
        return str(error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({os.path.basename(place.filename)}:{place.lineno})"  # noqa: PTH119


@lru_cache(maxsize=64)
def _networks(perception: PerceptionConfig) -> str:
    return ", ".join(f"{name}={sha256}" for name, sha256 in sorted(model_hashes(perception).items()))
