"""The folder of a campaign: every finished flight is in it at once, and it can be gone on with after any end.

`campaign.json` is the plan. A finished task is a file in `parts/`, written beside and renamed; many parts become
`flights.parquet` and `timings.parquet`, likewise, and are deleted after that. A flight that is in both counts once.
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import pyarrow as pa

from flockd.campaign.differences import differences
from flockd.campaign.flight_kinds import FlownRun
from flockd.campaign.flight_plan import Plan, Run
from flockd.campaign.flight_table import FlightTable, read_table, sync_folder, write_table
from flockd.core.errors import UsageError
from flockd.core.json_file import read_json

PLAN_NAME = "campaign.json"
FLIGHTS_NAME = "flights.parquet"
TIMINGS_NAME = "timings.parquet"
REPORT_NAME = "report.html"
RERUNS = "reruns"
_PARTS = "parts"
_LOCK = ".lock"
_OURS = {PLAN_NAME, FLIGHTS_NAME, TIMINGS_NAME, REPORT_NAME, RERUNS, _PARTS, _LOCK}
MOST_PARTS = 500
"""More are merged: a folder of many small files is slow."""


class CampaignFolder:
    """Between ``__enter__`` and ``__exit__`` for this process alone."""

    def __init__(self, path: Path, plan: Plan) -> None:
        """Raises UsageError for a folder of another campaign, or with other files."""
        self.path, self._plan = path, plan
        self._table = FlightTable(plan)
        self._stack = ExitStack()
        self._parts = 0
        _check(path, plan)

    def __enter__(self) -> Self:
        """Makes the folder, and tidies it. Raises UsageError where another process flies it."""
        (self.path / _PARTS).mkdir(parents=True, exist_ok=True)
        if (self.path / _LOCK).exists() and not (self.path / _LOCK).is_file():
            raise UsageError(f"{self.path / _LOCK}: is not an ordinary file; delete it")
        with ExitStack() as stack:
            lock = stack.enter_context((self.path / _LOCK).open("w", encoding="utf-8"))
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                fault = "another process is flying this campaign; wait, or end that one"
                raise UsageError(f"{self.path}: {fault}") from None
            _write_text(self.path / PLAN_NAME, self._plan.to_json())
            for leftover in [*self.path.glob(".*.part"), *(self.path / _PARTS).glob(".*.part")]:
                leftover.unlink()
            self.merge()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, flown: Sequence[FlownRun]) -> None:
        """Keeps finished flights: on the disk when this returns."""
        write_table(self._table.rows(flown), self.path / _PARTS / f"{flown[0].run.name}.parquet")
        self._parts += 1
        if self._parts >= MOST_PARTS:
            self.merge()

    def merge(self) -> None:
        """Puts all parts into the two tables, in order of cells and seeds. Raises UnavailableError for other parts."""
        parts = sorted((self.path / _PARTS).glob("*.parquet"))
        tables = [self._whole(), *(read_table(part, self._table.schema) for part in parts)]
        whole = self._table.merged(tables)
        # Timings first: flights decide what is done, and a kill between the two leaves all parts.
        write_table(self._table.timings(whole), self.path / TIMINGS_NAME)
        write_table(self._table.flights(whole), self.path / FLIGHTS_NAME)
        for part in parts:
            part.unlink()
        self._parts = 0

    def finished(self, figure: str | None) -> Iterator[tuple[Run, float | None]]:
        """The flights that are done, each with its value of a figure. Call it before any is added."""
        columns = ["cell", "number", *([figure] if figure else [])]
        for row in read_table(self.path / FLIGHTS_NAME, self._table.flights_schema).select(columns).to_pylist():
            yield Run(row["cell"], row["number"]), row[figure] if figure else None

    def _whole(self) -> pa.Table:
        """Both files joined. Between writing one and the other: the rows of the shorter one."""
        flights, timings = self.path / FLIGHTS_NAME, self.path / TIMINGS_NAME
        if not flights.exists():
            return self._table.schema.empty_table()
        done = read_table(flights, self._table.flights_schema)
        times = read_table(timings, self._table.timings_schema)
        if len(times) != len(done):
            known = pa.compute.is_in(times["run"], value_set=done["run"].combine_chunks())
            times = times.filter(known)
        return self._table.joined(done, times)


def load_plan(path: Path) -> Plan:
    """The plan of a campaign's folder. Raises UsageError where there is none."""
    try:
        return Plan.from_values(_plan_values(path))
    except ValueError as error:
        raise _no_plan(path, error) from error


def _plan_values(path: Path) -> Any:
    """What the plan's file holds. Raises UsageError."""
    try:
        return read_json(path / PLAN_NAME)
    except FileNotFoundError as error:
        raise UsageError(f"{path}: holds no campaign, as it has no {PLAN_NAME}; name another folder") from error
    except ValueError as error:
        raise _no_plan(path, error) from error


def _no_plan(path: Path, why: Exception) -> UsageError:
    return UsageError(f"{path / PLAN_NAME}: is not a plan of this flockd ({why}); restore it, or name another folder")


def _check(path: Path, plan: Plan) -> None:
    if path.exists() and not path.is_dir():
        raise UsageError(f"{path}: is a file; name a folder with --out")
    if not path.is_dir() or not any(path.iterdir()):
        return
    others = {entry.name for entry in path.iterdir() if entry.suffix != ".part" and not entry.match("versus_*.html")}
    if others - _OURS:
        raise UsageError(f"{path}: holds other files than a campaign's; name a new or empty folder with --out")
    if not (path / PLAN_NAME).exists():
        return
    old, new = _plan_values(path), json.loads(plan.to_json())
    if not isinstance(old, dict):
        raise _no_plan(path, ValueError("it holds something else"))
    difference = next(differences(old, new), None) if old != new else None  # NaN is no difference
    if difference is not None:
        key, before, now = difference
        raise UsageError(
            f"{path}: was begun with other flights, as `{key}` was {before} and is {now} now; name another folder with "
            "--out, or put the file back as it was to go on"
        )
    for key in ("vary", "cases"):
        if list(old["campaign"][key]) != list(new["campaign"][key]):
            raise UsageError(
                f"{path}: was begun with the entries of `{key}` in another order, by which flights are numbered; name "
                "another folder with --out, or put them back to go on"
            )


def _write_text(path: Path, text: str) -> None:
    """At once or not at all."""
    if path.is_file() and path.read_text(encoding="utf-8") == text:
        return
    temporary = path.with_name(f".{path.name}.part")
    with temporary.open("w", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)
    sync_folder(path.parent)
