"""The folder of a campaign: every finished flight is in it at once, and it can be gone on with after any end.

`campaign.json` is the plan. `flights.jsonl` gets a line for each finished flight; of several of one flight the first
counts, and a last line that was cut off is none. `flights.csv` is written from it at the end, in order of cells and
seeds, with what is the same whatever flew it.
"""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import TypeAdapter, ValidationError

from flockd import __version__
from flockd.campaign.flight_kinds import FlownRun
from flockd.campaign.flight_plan import Plan, Run
from flockd.core.errors import UnavailableError, UsageError
from flockd.onboard.message_json import parsed

PLAN_NAME = "campaign.json"
LINES_NAME = "flights.jsonl"
FLIGHTS_NAME = "flights.csv"
REPORT_NAME = "report.html"
RERUNS = "reruns"
_LOCK = ".lock"
_OURS = {PLAN_NAME, LINES_NAME, FLIGHTS_NAME, REPORT_NAME, RERUNS, _LOCK}
_FLOWN = TypeAdapter(FlownRun)


class CampaignFolder:
    """Between ``__enter__`` and ``__exit__`` for this process alone."""

    def __init__(self, path: Path, plan: Plan) -> None:
        """Raises UsageError for a folder of another campaign, or with other files."""
        self.path, self._plan = path, plan
        self._stack = ExitStack()
        _check(path, plan)

    def __enter__(self) -> Self:
        """Makes the folder, and tidies it. Raises UsageError where another process flies it."""
        self.path.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            lock = stack.enter_context(_ordinary(self.path / _LOCK).open("w", encoding="utf-8"))
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                fault = "another process is flying this campaign; wait, or end that one"
                raise UsageError(f"{self.path}: {fault}") from None
            _write(self.path / PLAN_NAME, self._plan.to_json().encode())
            lines = stack.enter_context(_ordinary(self.path / LINES_NAME).open("ab"))
            lines.truncate(sum(map(len, _whole_lines(self.path / LINES_NAME))))
            self._lines = lines
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, flown: Sequence[FlownRun]) -> None:
        """Keeps finished flights: on the disk when this returns."""
        self._lines.write(b"".join(_FLOWN.dump_json(one) + b"\n" for one in flown))
        self._lines.flush()
        os.fsync(self._lines.fileno())

    def write_table(self) -> None:
        """Writes the table anew. Raises UnavailableError where a line cannot be read."""
        rows = flight_rows(self._plan, flown_in(self.path, self._plan))
        text = io.StringIO()
        table = csv.DictWriter(text, list(rows[0]) if rows else (), lineterminator="\n")
        table.writeheader()
        table.writerows({name: _shown(value) for name, value in row.items()} for row in rows)
        _write(self.path / FLIGHTS_NAME, text.getvalue().encode())


def _shown(value: Any) -> str:
    """As JSON; texts as they are, None as nothing."""
    return value if isinstance(value, str) else "" if value is None else json.dumps(value)


def flown_in(path: Path, plan: Plan) -> list[FlownRun]:
    """The finished flights of a campaign's folder, in order of cells and seeds.

    Raises UnavailableError where a line cannot be read or is another campaign's.
    """
    lines, found = _ordinary(path / LINES_NAME), dict[Run, FlownRun]()
    for number, line in enumerate(_whole_lines(lines), 1):
        try:
            one = _FLOWN.validate_json(line)
        except ValidationError as error:
            why = error.errors()[0]["msg"]
            raise UnavailableError(
                f"{lines}:{number}: cannot be read ({why}); delete the line, and its flight is flown again"
            ) from error
        if not (0 <= one.run.cell < len(plan.cells) and 0 <= one.run.number < plan.config.seeds):
            raise UnavailableError(f"{lines}:{number}: is a flight of another campaign; delete the line")
        found.setdefault(one.run, one)
    return [found[run] for run in sorted(found)]


def flight_rows(plan: Plan, flown: Sequence[FlownRun]) -> list[dict[str, Any]]:
    """One row for each flight, of what is the same whatever flew it."""
    origin = {"perception": plan.config.perception, "flockd_version": __version__}
    origin |= {"numpy_version": np.__version__, "campaign_sha256": plan.sha256}
    return [
        {
            "run": one.run.name,
            "cell": one.run.cell,
            "number": one.run.number,
            "seed": plan.config.seed_of(one.run.cell, one.run.number),
            **plan.cells[one.run.cell].parameters,
            "status": "flown" if one.reason is None else "failed",
            "reason": one.reason,
            **{figure: one.figures.get(figure) for figure in plan.config.wanted},
            **origin,
            "scenario_sha256": one.scenario_sha256,
            "networks_sha256": one.networks,
        }
        for one in flown
    ]


def _whole_lines(path: Path) -> list[bytes]:
    """The last line is none where a kill has cut it off."""
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    return lines[:-1] if lines and not lines[-1].endswith(b"\n") else lines


def _ordinary(path: Path) -> Path:
    if path.exists() and not path.is_file():
        raise UsageError(f"{path}: is not an ordinary file; delete it")
    return path


def load_plan(path: Path) -> Plan:
    """The plan of a campaign's folder. Raises UsageError where there is none."""
    try:
        return Plan.from_values(_plan_values(path))
    except ValueError as error:
        raise _no_plan(path, error) from error


def _plan_values(path: Path) -> Any:
    """What the plan's file holds. Raises UsageError."""
    file = path / PLAN_NAME
    if not file.exists():
        raise UsageError(f"{path}: holds no campaign, as it has no {PLAN_NAME}; name another folder")
    try:
        if not file.is_file():
            raise ValueError("it is not an ordinary file")  # noqa: TRY301 - wrapped below
        return parsed(file.read_bytes())
    except (OSError, ValueError) as error:
        raise _no_plan(path, error) from error


def _no_plan(path: Path, why: Exception) -> UsageError:
    return UsageError(f"{path / PLAN_NAME}: is not a plan of this flockd ({why}); restore it, or name another folder")


def _check(path: Path, plan: Plan) -> None:
    if path.exists() and not path.is_dir():
        raise UsageError(f"{path}: is a file; name a folder with --out")
    if not path.is_dir() or not any(path.iterdir()):
        return
    others = {entry.name for entry in path.iterdir() if entry.suffix != ".part"}
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


def differences(first: Any, second: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Keys, dotted, whose values differ, each with both values as JSON; of a key that only one has, `null`."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        for name in dict.fromkeys([*first, *second]):
            yield from differences(first.get(name), second.get(name), f"{key}.{name}" if key else name)
    elif json.dumps(first) != json.dumps(second):
        yield key, json.dumps(first), json.dumps(second)


def _write(path: Path, data: bytes) -> None:
    """At once or not at all, and on the disk."""
    temporary = path.with_name(f".{path.name}.part")
    with temporary.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
