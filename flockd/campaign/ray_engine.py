"""Flies on a Ray cluster: the same tasks, wherever its nodes are."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, Self

import ray
from ray.exceptions import RayError

from flockd.campaign.engine import MAX_TRIES, ONE_THREAD, Flown, ended
from flockd.campaign.flight_kinds import Task, fly_task
from flockd.core.errors import UnavailableError
from flockd.core.side_process import with_package

_QUEUED = 2
"""Tasks for each processor of the cluster: one that it flies, and one that it goes on with."""


class RayEngine:
    """Between ``__enter__`` and ``__exit__``. The nodes need the same flockd, installed.

    Each task takes one processor. When its process or its node dies, Ray flies it again elsewhere. Nodes may join
    and leave meanwhile.
    """

    def __init__(self, workers: int, address: str | None) -> None:
        """A new cluster of this computer with so many ``workers``, or the one at ``address``.

        Raises UnavailableError where there is none.
        """
        environment = {**ONE_THREAD, "PYTHONPATH": with_package(os.environ).get("PYTHONPATH", "")}
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        options: dict[str, Any] = {
            "runtime_env": {"env_vars": environment},
            "include_dashboard": False,
            "log_to_driver": False,
            "logging_level": "ERROR",
        }
        try:
            if address is None:
                ray.init(num_cpus=workers, **options)
            else:
                del options["include_dashboard"]
                ray.init(address=address, **options)
        except (ConnectionError, RuntimeError, ValueError) as error:
            where = "here" if address is None else f"at {address}"
            raise UnavailableError(f"no Ray cluster can be used {where} ({error}); see `ray status`") from error
        self._fly = ray.remote(num_cpus=1, max_retries=MAX_TRIES - 1)(fly_task)
        self._flying: dict[Any, Task] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        ray.shutdown()

    @property
    def room(self) -> int:
        """By the processors that the cluster has now."""
        return _QUEUED * max(int(ray.cluster_resources().get("CPU", 1)), 1) - len(self._flying)

    def submit(self, task: Task) -> None:
        """Takes a task."""
        self._flying[self._fly.remote(task)] = task

    def wait(self) -> Sequence[Flown]:
        """What is finished; waits for one at least."""
        if not self._flying:
            return []
        done, _ = ray.wait(list(self._flying), num_returns=1)
        return [self._result(reference) for reference in done]

    def _result(self, reference: Any) -> Flown:
        task = self._flying.pop(reference)
        try:
            flown: Flown = ray.get(reference)
        except RayError:  # of its process: what a flight raises is in its result
            return ended(task, MAX_TRIES)
        return flown
