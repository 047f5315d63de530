"""Campaigns for the tests: short files, and flights that cost nothing."""

from __future__ import annotations

import os
import random
import signal
from pathlib import Path

from flockd.campaign.conduct import Conducted, conduct
from flockd.campaign.engine import ProcessEngine
from flockd.campaign.figures import Figures
from flockd.campaign.flight_kinds import FlownRun, fly_task
from flockd.campaign.flight_plan import Plan, Run, Task
from flockd.campaign.folder import CampaignFolder
from flockd.core.data import data_path
from flockd.sim.scenario import ScenarioConfig

PAPER = data_path("config") / "paper_flight.yaml"
HEAD = f"""\
campaign: test
scenario: {PAPER}
seeds: 6
scatter_m: 0.5
"""


def campaign_file(folder: Path, text: str, head: str = HEAD) -> Path:
    """A campaign's file with these lines below its first ones."""
    path = folder / "test.yaml"
    path.write_text(head + text, encoding="utf-8")
    return path


class Shuffled(ProcessEngine):
    """An engine that flies in this process, one task after the other, in an order drawn from a seed."""

    def __init__(self, seed: int, room: int = 5, until: int | None = None) -> None:
        """After ``until`` tasks it is interrupted."""
        self._random, self._room, self._left = random.Random(seed), room, until
        self._waiting: list[Task] = []

    @property
    def room(self) -> int:
        return self._room - len(self._waiting)

    def submit(self, task: Task) -> None:
        self._waiting.append(task)

    def wait(self) -> list[FlownRun]:
        if self._left == 0:
            raise KeyboardInterrupt
        if self._left is not None:
            self._left -= 1
        self._random.shuffle(self._waiting)
        return [fly_task(self._waiting.pop())]


def flown(plan: Plan, folder: Path, engine: ProcessEngine) -> Conducted:
    with CampaignFolder(folder, plan) as campaign:
        return conduct(plan, campaign, engine, lambda done, total: None)


def fly_or_end(task: Task) -> FlownRun:
    """Flies a task in a process of its own, which the second flight ends."""
    if task.run == Run(0, 1):
        os.kill(os.getpid(), signal.SIGKILL)
    return fly_task(task)


def made_up(scenario: ScenarioConfig, task: Task) -> Figures:
    """Figures that follow from a flight's scenario alone, in no time; seed 3 cannot be flown."""
    if scenario.seed == 3:
        raise ArithmeticError("no flight today")
    law, north_m = scenario.drone.flocking, scenario.vehicles[0].position_m[0]
    return dict.fromkeys(task.config.wanted, law.cohesion + north_m + 0.01 * scenario.seed + 0.1 * law.separation)
