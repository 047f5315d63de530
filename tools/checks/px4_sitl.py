"""What the checks with PX4 SITL share: a run that leaves nothing behind, PX4's shell, and the command line."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any, Protocol, Self, TypeVar

from flockd.core.errors import FlockdError, UnavailableError
from flockd.sim.autopilots import px4_folder


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


class Trial(Protocol):
    """Something that is tried with PX4."""

    @property
    def name(self) -> str:
        """For `--only`."""


class Outcome(Protocol):
    """A row of the table; a dataclass."""

    @property
    def kept(self) -> bool:
        """As it should be."""


T = TypeVar("T", bound=Trial)
R = TypeVar("R", bound=Outcome)


def run_trials(
    parser: argparse.ArgumentParser,
    trials: Sequence[T],
    run: Callable[[Sequence[T], argparse.Namespace, Callable[[R], None]], Sequence[R]],
    *,
    header: str,
    line: Callable[[R], str],
    rows: str,
    arguments: Sequence[str] | None = None,
) -> int:
    """Tries what the command line names, all by default, and prints a table or JSON; the exit code.

    ``run`` tries some of the trials, and calls its last argument with each row as it comes. In JSON, ``rows`` is the
    name of them all. ``arguments``: instead of the command line's.
    """
    parser.add_argument("--only", nargs="+", choices=[trial.name for trial in trials], help="these alone")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args(arguments)
    chosen = [trial for trial in trials if args.only is None or trial.name in args.only]
    try:
        if getattr(args, "autopilot", "px4") == "px4":
            px4_folder(os.environ)
        if not args.json:
            print(header, flush=True)
        results = run(chosen, args, lambda result: None if args.json else print(line(result), flush=True))
    except FlockdError as error:
        print(error, file=sys.stderr)
        return int(error.exit_code)
    if args.json:
        found: list[dict[str, Any]] = [{**vars(result), "kept": result.kept} for result in results]
        print(json.dumps({rows: found}, indent=2))
    return 0 if all(result.kept for result in results) else 1
