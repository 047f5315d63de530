"""Which engines there are: one entry each."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Literal

from flockd.campaign.engine import Engine

EngineName = Literal["processes", "ray"]


def _processes(workers: int, _: str | None) -> AbstractContextManager[Engine]:
    from flockd.campaign.process_engine import ProcessEngine  # noqa: PLC0415 - an extra

    return ProcessEngine(workers)


def _ray(workers: int, address: str | None) -> AbstractContextManager[Engine]:
    from flockd.campaign.ray_engine import RayEngine  # noqa: PLC0415 - an extra

    return RayEngine(workers, address)


ENGINES: dict[EngineName, Callable[[int, str | None], AbstractContextManager[Engine]]] = {
    "processes": _processes,
    "ray": _ray,
}
"""From the number of workers, and the address of a cluster. Each raises ModuleNotFoundError without its extra."""
