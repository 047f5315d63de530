"""The finding of a check, its way out of the virtual machine, and what all checks use; standard library only."""

from __future__ import annotations

import json
import subprocess
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

UNIT = "flockd.service"
PATIENCE_S = 180.0
"""Limit of each wait; an emulated processor is slow."""


@dataclass(frozen=True)
class Finding:
    """One row of the table."""

    check: str
    passed: bool
    measured: str
    wanted: str
    row: int | None = None
    """Row of the list of faults (`tests/faults/faults.yaml`), where it is one of those."""


Check = Callable[[], Iterator[Finding]]


def run_checks(path: Path, checks: Iterable[Check]) -> None:
    """Write a line of JSON for each finding as it comes; a check without one has failed.

    A check that breaks has failed, and the next one runs.
    """

    def write(line: dict[str, object]) -> None:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    for check in checks:
        try:
            for finding in check():
                write(asdict(finding))
        except Exception as error:  # noqa: BLE001 - whatever it is, the other checks still have something to say
            traceback.print_exc()
            measured = f"{type(error).__name__}: {error}"
            write(asdict(Finding(check.__name__, passed=False, measured=measured, wanted="to run to its end")))
    write({"done": True})


def soon(check: str, took_s: float, limit_s: float, row: int | None = None) -> Finding:
    """Whether something happened in time."""
    return Finding(check, took_s <= limit_s, f"{took_s:.2f} s", f"within {limit_s:g} s", row)


def until(condition: Callable[[], bool], what: str, *, look_s: float = 0.1) -> float:
    """Wait for the condition; the time on the monotonic clock. Raises TimeoutError, which names ``what``."""
    begun_s = time.monotonic()
    while not condition():
        if time.monotonic() - begun_s > PATIENCE_S:
            raise TimeoutError(f"waited {PATIENCE_S:g} s for {what}")
        time.sleep(look_s)
    return time.monotonic()


def run(*command: str) -> str:
    """What a command prints on both streams. Raises RuntimeError with the end of it where the command fails."""
    result = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if result.returncode:
        raise RuntimeError(f"{' '.join(command)}: {result.stdout.strip()[-400:]}")
    return result.stdout


def shown(what: str) -> str:
    """A property of the unit."""
    return run("systemctl", "show", UNIT, "--value", "-p", what).strip()
