"""Pilots in processes of their own: what goes wrong there is told here, and none of them outlives its flight."""

from __future__ import annotations

import os
import signal

import pytest

from flockd.core.config.perception import PerceptionConfig
from flockd.core.errors import FlockdError, ModelError
from flockd.sim.flock.pilots import PilotProcesses
from tests import make

PERCEPTION = PerceptionConfig(flow="dis", detector="none", verification="none")


def test_a_model_that_is_missing_is_named_as_without_processes_and_the_place_in_the_code_travels() -> None:
    with pytest.raises(ModelError, match=r"perception\.depth: there is no model 'nothing'") as raised:
        PilotProcesses(PerceptionConfig(depth="nothing"), 2)
    assert "in serve\n" in raised.value.__notes__[0]


def test_ctrl_c_and_a_killed_process() -> None:
    """Ctrl-C reaches every process of a terminal, and is the flight's alone to answer."""
    pilots, configs = PilotProcesses(PERCEPTION, 2), dict.fromkeys(range(2), make.scenario({}, drones=2).drone)
    first, second = pilots.processes
    os.kill(first.pid, signal.SIGINT)
    pilots.begin(configs)
    second.kill()
    second.wait(10.0)
    with pytest.raises(FlockdError, match="a process with pilots ended; watch the memory"):
        pilots.begin(configs)


def test_processes_end_with_what_holds_them() -> None:
    pilots = PilotProcesses(PERCEPTION, 2)
    processes = pilots.processes
    del pilots
    assert [one.wait(10.0) for one in processes] == [0, 0]
