"""Processes of pilots end with the simulator; where one cannot begin or ends before, one sentence says so."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from multiprocessing import resource_tracker
from pathlib import Path

import pytest

from flockd.core.config import Overrides
from flockd.core.data import data_path
from flockd.core.errors import ModelError, UnavailableError
from flockd.sim.flock.pilot_pool import PilotPool
from flockd.sim.flock.swarm import fly
from flockd.sim.scenario import ScenarioConfig, load_scenario
from tests.sim.sitl.test_programs import _until_gone

FLIGHT = """\
import os, sys
from multiprocessing import active_children
from flockd.sim.scenario import load_scenario
from flockd.sim.flock.pilot_pool import PilotPool
with PilotPool(load_scenario(sys.argv[1]), frozenset(), 2) as pool:
    pool.wait_until_ready()
    print(*(child.pid for child in active_children()), flush=True)
    sys.stdin.read()
"""
PAPER = data_path("config") / "paper_flight.yaml"


def scenario(**overrides: float | str) -> ScenarioConfig:
    changes: Overrides = {"drone.perception.flow": "dis", **overrides}
    return load_scenario(PAPER, changes)


def test_what_a_configuration_lacks_is_told_as_in_one_process() -> None:
    lacking = scenario(**{"drone.perception.depth": "no_such_model"})
    told = []
    for processes in (1, 2):
        with PilotPool(lacking, frozenset(), processes) as pool, pytest.raises(ModelError) as refused:
            pool.wait_until_ready()
        told.append(str(refused.value))
    assert "no_such_model" in told[0]
    assert told[0] == told[1]


@pytest.mark.slow
def test_it_ends_with_a_simulator_that_was_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", FLIGHT, str(PAPER)],
        cwd=Path(__file__).parents[3], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as simulator:  # fmt: skip
        assert simulator.stdout is not None
        pids = [int(word) for word in simulator.stdout.readline().split()]
        assert len(pids) == 2
        simulator.kill()
    _until_gone(pids, timeout_s=60.0)


@pytest.mark.slow
def test_an_interrupted_flight_is_what_was_flown_and_leaves_no_process() -> None:
    before = _children()

    def interrupt(done: int, total: int) -> None:
        if done == 3:
            assert len(_children() - before) == 2
            raise KeyboardInterrupt

    log = fly(scenario(duration_s=5.0), processes=2, progress=interrupt).log
    assert (len(log.time_s), log.metadata.interrupted) == (3, True)
    assert _children() == before


@pytest.mark.slow
def test_a_flight_ends_in_one_sentence_when_a_process_of_its_pilots_is_killed() -> None:
    before = _children()

    def kill(done: int, total: int) -> None:
        if done == 1:
            os.kill(int(max(_children() - before, key=int)), signal.SIGKILL)

    with pytest.raises(UnavailableError, match="the process that flew drone2, drone4 has ended"):
        fly(scenario(duration_s=5.0), processes=2, progress=kill)
    assert _children() == before


def _children() -> set[str]:
    """Children of this process, started on its main thread, which is where a flight starts its own."""
    resource_tracker.ensure_running()  # it stays, and belongs to no flight
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text(encoding="ascii").split())
