"""The folder of a campaign: it holds each flight as soon as that has ended, and a campaign goes on after any end.

`campaign.json` is the plan. `flights.jsonl` gets a line for each finished flight; of several lines of one flight the
first counts, and a last line that was cut off does not. `flights.csv` is written from it at the end, in order of cells
and seeds, without what depends on the computer.
"""

from __future__ import annotations

import csv
import fcntl
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
from flockd.core.data import written_whole
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
    """The folder, open for writing by this process alone between ``__enter__`` and ``__exit__``."""

    def __init__(self, path: Path, plan: Plan) -> None:
        """Raises UsageError for a folder of another campaign, or with other files."""
        self.path, self._plan = path, plan
        self._stack = ExitStack()
        _check(path, plan)

    def __enter__(self) -> Self:
        """Makes the folder, and removes a cut-off line. Raises UsageError if another process flies this campaign."""
        self.path.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            lock = stack.enter_context(_ordinary(self.path / _LOCK).open("w", encoding="utf-8"))
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                fault = "another process is flying this campaign; wait, or end that one"
                raise UsageError(f"{self.path}: {fault}") from None
            with written_whole(self.path / PLAN_NAME) as draft:
                draft.write_text(self._plan.to_json(), encoding="utf-8")
            lines = stack.enter_context(_ordinary(self.path / LINES_NAME).open("ab"))
            lines.truncate(sum(map(len, _whole_lines(self.path / LINES_NAME))))
            self._lines = lines
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, flown: Sequence[FlownRun]) -> None:
        """Writes finished flights; they are on the disk when this returns."""
        self._lines.write(b"".join(_FLOWN.dump_json(one) + b"\n" for one in flown))
        self._lines.flush()
        os.fsync(self._lines.fileno())

    def write_table(self) -> None:
        """Writes `flights.csv` again. Raises UnavailableError if a line of `flights.jsonl` cannot be read."""
        rows = flight_rows(self._plan, flown_in(self.path, self._plan))
        with written_whole(self.path / FLIGHTS_NAME) as draft, draft.open("w", encoding="utf-8", newline="") as file:
            table = csv.DictWriter(file, list(rows[0]) if rows else (), lineterminator="\n")
            table.writeheader()
            table.writerows({name: _shown(value) for name, value in row.items()} for row in rows)


def _shown(value: Any) -> str:
    """As JSON; texts as they are, None as nothing."""
    return value if isinstance(value, str) else "" if value is None else json.dumps(value)


def flown_in(path: Path, plan: Plan) -> list[FlownRun]:
    """The finished flights in a campaign's folder, in order of cells and seeds.

    Raises UnavailableError for a line that cannot be read, or of another campaign.
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
    """One row of `flights.csv` for each flight: values that do not depend on the computer that flew it."""
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
    """Without a last line that a kill has cut off."""
    lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    return lines[:-1] if lines and not lines[-1].endswith(b"\n") else lines


def _ordinary(path: Path) -> Path:
    if path.exists() and not path.is_file():
        raise UsageError(f"{path}: is not an ordinary file; delete it")
    return path


def load_plan(path: Path) -> Plan:
    """The plan in a campaign's folder. Raises UsageError if it holds no valid one."""
    try:
        return Plan.from_values(_plan_values(path))
    except ValueError as error:
        raise _no_plan(path, error) from error


def _plan_values(path: Path) -> Any:
    """The plan's file as JSON. Raises UsageError."""
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
    others = {entry.name for entry in path.iterdir() if ".part" not in entry.suffixes}
    if others - _OURS:
        raise UsageError(f"{path}: holds other files than a campaign's; name a new or empty folder with --out")
    if not (path / PLAN_NAME).exists():
        return
    old, new = _plan_values(path), json.loads(plan.to_json())
    if not isinstance(old, dict):
        raise _no_plan(path, ValueError("it holds something else"))
    difference = next(differences(old, new), None)
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
    """Dotted keys whose values differ, each with both values as JSON; `null` where only one side has the key."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        for name in dict.fromkeys([*first, *second]):
            yield from differences(first.get(name), second.get(name), f"{key}.{name}" if key else name)
    elif json.dumps(first) != json.dumps(second):
        yield key, json.dumps(first), json.dumps(second)
