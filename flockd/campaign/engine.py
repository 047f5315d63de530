"""Where flights are flown: in processes of this computer, with the executor that joblib brings along."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections import Counter, deque
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Self

import cv2
from joblib.externals.loky import ProcessPoolExecutor

from flockd.campaign.flight_kinds import FlownRun, fly_task
from flockd.campaign.flight_plan import Run, Task

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
"""Environment of a process that flies: a library that starts threads of its own takes the others' processors."""
PR_SET_PDEATHSIG = 1
"""Of prctl(2): Linux sends a signal when the parent ends."""
MAX_TRIES = 3
"""How often a flight may end the process that flies it."""


class ProcessEngine:
    """Flies tasks side by side in ``workers`` processes, in any order, between ``__enter__`` and ``__exit__``.

    The processes end with this one, however that ends. When a process dies, the executor cannot say which task it
    flew, and all tasks that it had begun are lost. Each of them is then flown alone in new processes, which shows the
    flight that ends its process.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._executor = self._started()
        self._flying: dict[Future[FlownRun], Task] = {}
        self._suspects: deque[Task] = deque()
        """Tasks that were in an executor that broke."""
        self._tries: Counter[Run] = Counter()
        """How often a flight was the only one in an executor that broke."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown(wait=True, kill_workers=True)

    @property
    def room(self) -> int:
        """How many more tasks it takes now: two a process, one to fly and one to go on with; none while suspects fly
        alone."""
        return 0 if self._suspects else 2 * self._workers - len(self._flying)

    def submit(self, task: Task) -> None:
        """Takes a task."""
        try:
            self._flying[self._executor.submit(fly_task, task)] = task
        except BrokenProcessPool:  # a process died a moment ago
            self._suspects.append(task)
            if not self._flying:
                self._restarted()

    def wait(self) -> list[FlownRun]:
        """Results of the tasks that have finished since the last call. Waits for one, if any task is submitted."""
        finished: list[FlownRun] = []
        while not finished and (self._flying or self._suspects):
            if not self._flying:
                self.submit(self._suspects.popleft())
            done, _ = wait(self._flying, return_when=FIRST_COMPLETED)
            broken = False
            for future in done:
                try:
                    finished.append(future.result())
                    del self._flying[future]
                except BrokenProcessPool:
                    broken = True
            if broken:
                finished += self._restarted()
        return finished

    def _restarted(self) -> list[FlownRun]:
        """Starts a new executor. Returns results that are known, of tasks that ended too many processes too."""
        wait(self._flying)  # all of them break
        lost = [task for future, task in self._flying.items() if future.exception() is not None]
        finished = [future.result() for future in self._flying if future.exception() is None]
        self._flying.clear()
        self._executor.shutdown(wait=True, kill_workers=True)
        self._executor = self._started()
        if len(lost) == 1:
            self._tries[lost[0].run] += 1
            if self._tries[lost[0].run] >= MAX_TRIES:
                return [*finished, _ended(lost[0])]
        self._suspects.extend(lost)
        return finished

    def _started(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(
            self._workers, env={**os.environ, **ONE_THREAD}, initializer=_begin, initargs=(os.getpid(),)
        )


def _ended(task: Task) -> FlownRun:
    """The result of a task whose process ended before it did."""
    reason = f"the process that flew it ended, {MAX_TRIES} times; run it by itself to see why, and watch the memory"
    return FlownRun(task.run, reason=reason)


def _begin(parent: int) -> None:
    """In a new process: it ends with its parent, Ctrl-C is for the parent alone, and OpenCV starts no threads."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(128 + signal.SIGTERM)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(0)
