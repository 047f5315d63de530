"""What commands write: text and JSON on stdout, progress on stderr."""

from __future__ import annotations

import argparse
import functools
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from flockd.core.errors import ExitCode
from flockd.core.printable import printable

if TYPE_CHECKING:
    from flockd.review.flight_log.log import FlightLog
    from flockd.sim.flock.swarm import Flight

PLAIN_LINE_EVERY_S = 10.0
CELL_CHARACTERS = 300
PIPED_COLUMNS = 1000
"""Width of tables that are not on a terminal, which has none: no column is cut."""


def tables_console() -> Console:
    """Where tables are printed. Not on a terminal there is no width to fit; rich would assume 80 columns and cut."""
    return Console(markup=False, highlight=False, width=None if sys.stdout.isatty() else PIPED_COLUMNS)


def say_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Prints rows below their heads, if they have any."""
    from rich.table import Table

    table = Table(*heads, box=None, pad_edge=False, show_header=bool(heads))
    for row in rows:
        table.add_row(*row)
    tables_console().print(table)


def noted_table(heads: Sequence[str], rows: Sequence[tuple[Sequence[str], Sequence[str]]]) -> Text:
    """Rows of short cells, each with sentences in full width below it: nothing is squeezed into a narrow column."""
    cells = [heads, *(cells for cells, _ in rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(heads))]
    text = Text(no_wrap=False)
    for row, notes in [(heads, ()), *rows]:
        line = "  ".join(one.ljust(width) for one, width in zip(row, widths, strict=True)).rstrip()
        text.append(f"{line}\n", style="bold" if row is heads else "")
        for note in notes:
            text.append(f"    {note}\n")
    text.right_crop(1)
    return text


def say(text: str) -> None:
    """Writes lines on stdout; what would steer a terminal is escaped, as in all that these functions write."""
    sys.stdout.write(f"{printable(text)}\n")


def complain(text: str) -> None:
    """Writes lines on stderr."""
    sys.stderr.write(f"{printable(text)}\n")


def cell(text: str) -> str:
    """A text from outside as it may stand in a table: one line that is not endless."""
    shown = printable(text, lines=False)
    return shown if len(shown) <= CELL_CHARACTERS else f"{shown[:CELL_CHARACTERS]}..."


def say_json(value: object) -> None:
    """Writes one JSON document on stdout."""
    say(json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False))


def say_result(args: argparse.Namespace, facts: object, *lines: str) -> int:
    """Writes a command's result: its facts as --json says, or else lines for people."""
    if args.json:
        say_json(facts)
    else:
        for line in lines:
            say(line)
    return ExitCode.DONE


def say_facts(args: argparse.Namespace, facts: object, *lines: str) -> int:
    """Writes a command's facts: as --json says, or else as YAML with four digits, and then the lines."""
    if not args.json:
        import yaml

        text = yaml.safe_dump(_shown(facts), sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
        say(text.rstrip())
    return say_result(args, facts, *lines)


def _shown(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(key): _shown(inner) for key, inner in value.items() if inner is not None}
    if isinstance(value, list | tuple):
        return [_shown(inner) for inner in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


@contextmanager
def progress(label: str, unit: str, clock: Callable[[], float] = monotonic) -> Iterator[Callable[[int, int], None]]:
    """Gives a function that tells how many of how many are done: a bar on a terminal, else a line now and then."""
    with Phases(clock=clock) as phases:
        yield phases.of(label, unit)


class Phases:
    """Progress of phases one after the other, with a unit and the time left: a bar on a terminal, else lines.

    ``quiet``: nothing.
    """

    def __init__(self, *, quiet: bool = False, clock: Callable[[], float] = monotonic) -> None:
        self._quiet, self._clock = quiet, clock
        self._bar: Progress | None = None
        self._label = ""
        self._task: TaskID | None = None
        self._began_s = self._told_s = 0.0

    def __enter__(self) -> Self:
        if sys.stderr.isatty() and not self._quiet:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[unit]}"),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
            )
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
        self._end_phase()

    def say(self, sentence: str) -> None:
        """One line, unless quiet."""
        if not self._quiet:
            complain(sentence)

    def of(self, label: str, unit: str) -> Callable[[int, int], None]:
        """Gives a function that tells how many of how many are done in this phase; its first call begins it."""
        return functools.partial(self._tell, label, unit)

    def _tell(self, label: str, unit: str, done: int, total: int) -> None:
        if self._quiet:
            return
        if label != self._label:
            self._end_phase()
            self._label = label
            self._began_s = self._told_s = self._clock()
            if self._bar is not None:
                self._task = self._bar.add_task(label, total=total, unit=unit)
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, total=total)
            return
        now_s = self._clock()
        if now_s - self._told_s >= PLAIN_LINE_EVERY_S:
            self._told_s = now_s
            left = _duration((now_s - self._began_s) * (total - done) / done) if done else "unknown"
            complain(f"{label}: {done} of {total} {unit}, {left} left")

    def _end_phase(self) -> None:
        if self._bar is not None and self._task is not None:
            self._bar.remove_task(self._task)
        self._label, self._task = "", None


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def report_flight(directory: Path, flight: Flight, args: argparse.Namespace) -> int:
    """Saves a flight, writes its report with progress, and shows its summary as --json and --quiet say."""
    from flockd.review.report.flight_folder import REPORT_NAME, save_flight, write_report_files

    with Phases(quiet=args.quiet) as phases:
        save_flight(directory, flight.log, flight.key_frames)
        summary = write_report_files(directory, flight.log, phases.of("writing the report", "figures"))
    if args.quiet and not args.json:
        say(f"{directory / REPORT_NAME}")
        return ExitCode.DONE
    return show_summary(directory, flight.log, summary, as_json=args.json)


def show_summary(directory: Path, log: FlightLog, summary: Mapping[str, Any], *, as_json: bool) -> int:
    """Prints the summary as JSON, or what stands above the report's figures, and where that is."""
    from flockd.review.report.flight_folder import REPORT_NAME
    from flockd.review.report.page_texts import facts, headline

    if as_json:
        say_json(summary)
        return ExitCode.DONE
    say(headline(summary))
    say_table((), [(one["name"], f"{one['value']} {one['unit']}", one["remark"]) for one in facts(summary, log)])
    say(f"report: {directory / REPORT_NAME}")
    return ExitCode.DONE
