"""Where flights are flown: in processes of this computer, with the executor that joblib brings along, or by Ray."""

from __future__ import annotations

import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from typing import Any, Literal, Protocol, Self

import cv2
from joblib.externals.loky import ProcessPoolExecutor

from flockd.campaign.flight_kinds import FlownRun, fly_task
from flockd.campaign.flight_plan import Run, Task
from flockd.core.errors import UnavailableError
from flockd.sim.sitl.bound_to_parent import bind, with_package

EngineName = Literal["processes", "ray"]
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
"""Environment of a process that flies: a library that starts threads of its own takes the others' processors."""
MAX_TRIES = 3
"""How often a flight may end the process that flies it."""


class Engine(Protocol):
    """Flies tasks side by side, in any order. What a task gives is what `fly_task` gives, wherever it is flown."""

    @property
    def room(self) -> int:
        """How many more tasks it takes now."""
        ...

    def submit(self, task: Task) -> None:
        """Takes a task."""
        ...

    def wait(self) -> Sequence[FlownRun]:
        """What of the submitted is finished since the last call; waits for one at least, if there is one."""
        ...


class ProcessEngine:
    """Between ``__enter__`` and ``__exit__``. Its processes end with this one, however that ends.

    When a process dies, the executor cannot say which task it flew, and all that it had begun are lost. Each of them is
    then flown by itself, which shows whose flight it was; the processes are new.
    """

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._executor = self._started()
        self._flying: dict[Future[FlownRun], Task] = {}
        self._suspects: deque[Task] = deque()
        """Were in an executor that broke."""
        self._tries: Counter[Run] = Counter()
        """How often a flight was the only one in an executor that broke."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown(wait=True, kill_workers=True)

    @property
    def room(self) -> int:
        """For each process one that it flies and one that it goes on with; none while suspects fly by themselves."""
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
        """What is finished; waits for one at least."""
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
        """With a new executor. Gives the results of tasks that have ended too many processes."""
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
        environment = {**with_package(os.environ), **ONE_THREAD}
        return ProcessPoolExecutor(self._workers, env=environment, initializer=_begin, initargs=(os.getpid(),))


class RayEngine:
    """Between ``__enter__`` and ``__exit__``. The nodes need the same flockd, installed.

    Each task takes one processor. When its process or its node dies, Ray flies it again elsewhere. Nodes may join
    and leave meanwhile.
    """

    def __init__(self, workers: int, address: str | None) -> None:
        """A new cluster of this computer with so many ``workers``, or the one at ``address``.

        Raises UnavailableError where there is none.
        """
        import ray  # noqa: PLC0415 - an extra

        environment = {**ONE_THREAD, "PYTHONPATH": with_package(os.environ).get("PYTHONPATH", "")}
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        where: dict[str, Any] = {"num_cpus": workers, "include_dashboard": False}
        if address is not None:
            where = {"address": address}
        try:
            ray.init(**where, runtime_env={"env_vars": environment}, log_to_driver=False, logging_level="ERROR")
        except (ConnectionError, RuntimeError, ValueError) as error:
            there = "here" if address is None else f"at {address}"
            raise UnavailableError(f"no Ray cluster can be used {there} ({error}); see `ray status`") from error
        self._ray = ray
        self._fly = ray.remote(num_cpus=1, max_retries=MAX_TRIES - 1)(fly_task)
        self._flying: dict[Any, Task] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()

    @property
    def room(self) -> int:
        """By the processors that the cluster has now: for each a task that it flies, and one that it goes on with."""
        return 2 * max(int(self._ray.cluster_resources().get("CPU", 1)), 1) - len(self._flying)

    def submit(self, task: Task) -> None:
        """Takes a task."""
        self._flying[self._fly.remote(task)] = task

    def wait(self) -> list[FlownRun]:
        """What is finished; waits for one at least."""
        finished: list[FlownRun] = []
        for reference in self._ray.wait(list(self._flying), num_returns=1)[0] if self._flying else ():
            task = self._flying.pop(reference)
            try:
                finished.append(self._ray.get(reference))
            except self._ray.exceptions.RayError:  # of its process: what a flight raises is in its result
                finished.append(_ended(task))
        return finished


ENGINES: dict[EngineName, Callable[[int, str | None], AbstractContextManager[Engine]]] = {
    "processes": lambda workers, _: ProcessEngine(workers),
    "ray": RayEngine,
}
"""From the number of workers, and the address of a cluster. Each raises ModuleNotFoundError without its extra."""


def _ended(task: Task) -> FlownRun:
    """The result of a task whose process did not live to its end."""
    reason = f"the process that flew it ended, {MAX_TRIES} times; run it by itself to see why, and watch the memory"
    return FlownRun(task.run, reason=reason)


def _begin(parent: int) -> None:
    """In a new process: it ends with its parent, Ctrl-C is for the parent alone, and OpenCV starts no threads."""
    bind(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(0)
