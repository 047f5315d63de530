"""A run of PX4 SITL that leaves nothing behind, and PX4's shell."""

from __future__ import annotations

import os
import subprocess
from abc import ABC, abstractmethod
from contextlib import ExitStack
from typing import Self

from flockd.core.errors import UnavailableError
from flockd.sim.sitl.autopilots import px4_folder


class SitlRun(ABC):
    """One PX4 and what runs beside it, all on ``_stack``, between ``__enter__`` and ``__exit__``."""

    def __init__(self, instance: int = 0) -> None:
        self._instance = instance
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        try:
            self._come_up()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @abstractmethod
    def _come_up(self) -> None:
        """Starts everything. Raises UnavailableError."""

    def shell(self, *command: str) -> None:
        """Runs a command in PX4's shell. Raises UnavailableError."""
        program = px4_folder(os.environ) / f"bin/px4-{command[0]}"
        done = subprocess.run(
            [program, "--instance", str(self._instance), *command[1:]],
            capture_output=True, text=True, check=False, timeout=60.0,
        )  # fmt: skip
        if done.returncode != 0:
            raise UnavailableError(f"PX4 refused `{' '.join(command)}`: {(done.stdout + done.stderr).strip()}")
