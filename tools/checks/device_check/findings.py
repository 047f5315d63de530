"""What a check found, and how it gets out of the virtual machine: a line of JSON each, in the order of the checks."""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path


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


class Notebook:
    """Writes findings down as they come: what the machine does not live to write has failed."""

    def __init__(self, path: Path, only: Sequence[str]) -> None:
        """``only``: the groups to run; none for all."""
        self._path, self._only = path, only

    def run(self, group: str, checks: Sequence[Check]) -> None:
        """Runs one group; a check that breaks has failed, and the next one runs."""
        if self._only and group not in self._only:
            return
        begun_s = time.monotonic()
        for check in checks:
            try:
                for finding in check():
                    self._write(asdict(finding))
            except Exception as error:  # noqa: BLE001 - whatever it is, the other checks still have something to say
                traceback.print_exc()
                measured = f"{type(error).__name__}: {error}"
                self._write(
                    asdict(Finding(check.__name__, passed=False, measured=measured, wanted="to run to its end"))
                )
        self._write({"group": group, "took_s": round(time.monotonic() - begun_s, 1)})

    def close(self) -> None:
        """All checks have run."""
        self._write({"done": True})

    def _write(self, line: dict[str, object]) -> None:
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
