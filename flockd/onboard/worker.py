"""A thread for one concern: nothing waits in asyncio's own executor, and a job that hangs costs only its thread."""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from typing import Any, TypeVar

from flockd.core.errors import UnavailableError

T = TypeVar("T")

GOLDEN_S = 8.0
"""Time limit of a network's run on its golden input, which takes less than a second on any computer that flies."""
_END_S = 1.0
"""Longest time for work to end when it is stopped; ONNX Runtime takes a few milliseconds."""


class LateError(UnavailableError):
    """A job missed its deadline; it may still be running."""


class BusyError(Exception):
    """A worker's queue is full."""


class Worker:
    """Does one job after the other; ``backlog`` of them may wait. Its thread never keeps the process from ending."""

    def __init__(self, name: str, backlog: int = 1) -> None:
        self._name = name
        self._jobs: queue.Queue[tuple[Future[Any], Callable[[], Any]] | None] = queue.Queue(backlog)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, job: Callable[..., T], *arguments: object) -> Future[T]:
        """Queues a job, from any thread. Raises BusyError if too many wait."""
        future: Future[T] = Future()
        try:
            self._jobs.put_nowait((future, lambda: job(*arguments)))
        except queue.Full as error:
            raise BusyError(f"{self._name}: too many jobs wait") from error
        return future

    async def do(self, deadline_s: float, job: Callable[..., T], *arguments: object) -> T:
        """Returns the job's result or raises its error. Raises LateError if the job takes too long, and BusyError."""
        try:
            async with asyncio.timeout(deadline_s) as deadline:
                return await asyncio.wrap_future(self.submit(job, *arguments))
        except TimeoutError as error:
            if not deadline.expired():
                raise
            raise LateError(f"{self._name}: not done within {deadline_s:g} s; check disk and load") from error

    def leave(self, timeout_s: float = 0.0) -> None:
        """Lets the thread end after its present job, and waits up to ``timeout_s``. If it hangs, the process ends it.

        Wait for threads that run foreign code: such code may crash if the process ends meanwhile.
        """
        with suppress(queue.Full):
            self._jobs.put_nowait(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (entry := self._jobs.get()) is not None:
            future, job = entry
            if not future.set_running_or_notify_cancel():
                continue
            try:
                result = job()
            except BaseException as error:  # noqa: BLE001 - the caller handles it
                future.set_exception(error)
            else:
                future.set_result(result)
            del entry, future, job  # or the last frames would stay in memory until the next


def within(seconds: float) -> Callable[[Callable[[], None], Callable[[], None]], None]:
    """A function that runs its first argument and, after that time, stops it by the second.

    It then raises TimeoutError, whether or not the work has ended; errors of the work pass through.
    """

    def run(work: Callable[[], None], stop: Callable[[], None]) -> None:
        worker = Worker("deadline")
        done = worker.submit(work)
        if not wait([done], seconds).done:
            stop()
            wait([done], _END_S)
            worker.leave()
            raise TimeoutError(f"more than {seconds:g} s")
        worker.leave()
        done.result()

    return run
