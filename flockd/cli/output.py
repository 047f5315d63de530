"""What commands write: text and JSON on stdout, progress on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

PLAIN_LINE_EVERY_S = 10.0


def say(text: str) -> None:
    """Writes lines on stdout."""
    sys.stdout.write(f"{text}\n")


def complain(text: str) -> None:
    """Writes lines on stderr."""
    sys.stderr.write(f"{text}\n")


def say_json(value: object) -> None:
    """Writes one JSON document on stdout."""
    say(json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False))


@contextmanager
def progress(label: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """Gives a function that tells how many of how many are done: a bar on a terminal, else a line now and then."""
    if sys.stderr.isatty():
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(label, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)
        return
    told_s = monotonic()

    def tell(done: int, total: int) -> None:
        nonlocal told_s
        now_s = monotonic()
        if now_s - told_s >= PLAIN_LINE_EVERY_S:
            told_s = now_s
            sys.stderr.write(f"{label}: {done} of {total} {unit}\n")

    yield tell
