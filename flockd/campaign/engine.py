"""Where flights are flown: what an engine can do, and what all of them share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from flockd.campaign.flight_kinds import FlownRun, Task

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
"""Environment of a process that flies: a library that starts threads of its own takes the others' processors."""
MAX_TRIES = 3
"""How often a flight may end the process that flies it."""
Flown = list[FlownRun]


class Engine(Protocol):
    """Flies tasks side by side, in any order. What a task gives is what `fly_task` gives, wherever it is flown."""

    @property
    def room(self) -> int:
        """How many more tasks it takes now: some wait in it, so that no worker does."""
        ...

    def submit(self, task: Task) -> None:
        """Takes a task."""
        ...

    def wait(self) -> Sequence[Flown]:
        """What of the submitted is finished since the last call; waits for one at least, if there is one."""
        ...


def ended(task: Task, times: int) -> Flown:
    """The result of a task whose process did not live to its end."""
    reason = f"the process that flew it ended, {times} times; run it by itself to see why, and watch the memory"
    return [FlownRun(run, reason=reason) for run in task.runs]
