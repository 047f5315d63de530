"""The folder of a flight: its log, its summary and its report; nothing in it is overwritten without being asked."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from flockd.core.errors import UsageError
from flockd.review.flight_log.key_frames import KeyFrame
from flockd.review.flight_log.log import FlightLog
from flockd.review.report.filmstrip import load_plates, save_plates
from flockd.review.report.page import write_report
from flockd.review.report.summary import summarise

LOG_NAME = "flight.npz"
KEY_FRAMES_NAME = "filmstrip.npz"
SUMMARY_NAME = "summary.json"
REPORT_NAME = "report.html"
FIGURES = "figures"
FLEET_LOGS = "logs"
"""Logs and configurations of the processes of a fleet."""
RECORDINGS = "recordings"
OF_A_FLIGHT = (
    LOG_NAME,
    KEY_FRAMES_NAME,
    SUMMARY_NAME,
    REPORT_NAME,
    FIGURES,
    FLEET_LOGS,
    RECORDINGS,
)
"""All that a flight leaves in its folder."""
INTERRUPTED = "interrupted"

Progress = Callable[[int, int], None]


def new_folder(base: Path) -> Path:
    """Makes ``base``, or ``base-2``, ``base-3``, ... where there is something already; returns which."""
    folder = base if base.is_dir() and not any(base.iterdir()) else _free_name(base)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def prepare_folder(directory: Path, *, force: bool = False) -> Path | None:
    """Makes the folder of a new flight.

    What an interrupted flight left there is moved to a folder beside it, which is returned. A finished flight is
    removed with ``force`` only. Raises UsageError where it is in the way, or where the folder holds other files.
    """
    _check_no_other_files(directory)
    moved = None
    if _holds_something(directory):
        if force:
            _remove_flight(directory)
        elif _was_interrupted(directory):
            moved = _free_name(directory.with_name(f"{directory.name}-{INTERRUPTED}"))
            directory.rename(moved)
        else:
            raise _in_the_way(directory)
    directory.mkdir(parents=True, exist_ok=True)
    return moved


@contextmanager
def prepare_report_folder(directory: Path, *, force: bool = False) -> Iterator[None]:
    """Makes the folder for a report of recordings, after the body of the ``with`` statement has succeeded.

    A flight or report that is there is removed with ``force`` only. Raises UsageError at once for a folder in the way.
    """
    _check_no_other_files(directory)
    held = _holds_something(directory)
    if held and not force:
        raise _in_the_way(directory)
    yield
    if held:
        _remove_flight(directory)
    directory.mkdir(parents=True, exist_ok=True)


def _holds_something(directory: Path) -> bool:
    return directory.is_dir() and any(directory.iterdir())


def _check_no_other_files(directory: Path) -> None:
    if directory.exists() and not directory.is_dir():
        raise UsageError(f"{directory}: is a file; name a folder with --out")
    if not directory.is_dir():
        return
    recordings = directory / RECORDINGS
    found = recordings.iterdir() if recordings.is_dir() else ()
    kept = [path for path in found if re.fullmatch(r"drone\d+([.-].*)?\.mcap", path.name) is None]
    if {path.name for path in directory.iterdir()} - set(OF_A_FLIGHT) or kept:
        raise UsageError(f"{directory}: holds other files than a flight's; name a new or empty folder with --out")


def _in_the_way(directory: Path) -> UsageError:
    return UsageError(f"{directory}: holds a flight; name another folder with --out, or overwrite it with --force")


def save_flight(directory: Path, log: FlightLog, key_frames: Sequence[KeyFrame]) -> None:
    """Writes the flight's log, and the plates of its key frames if there are any."""
    log.save(directory / LOG_NAME)
    if key_frames:
        save_plates(directory / KEY_FRAMES_NAME, key_frames)


def write_report_files(
    directory: Path, log: FlightLog, progress: Progress = lambda done, total: None
) -> dict[str, Any]:
    """Writes the summary and the report beside the flight's log, and returns the summary. A NaN raises ValueError."""
    summary = summarise(log)
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    (directory / SUMMARY_NAME).write_text(text, encoding="utf-8")
    write_report(directory, log, summary, load_plates(directory / KEY_FRAMES_NAME), progress)
    return summary


def _was_interrupted(directory: Path) -> bool:
    """Whether what a flight left there says so, or is no whole flight."""
    path = directory / LOG_NAME
    if not path.is_file():
        return True
    try:
        return FlightLog.load(path).metadata.interrupted
    except (OSError, ValueError, EOFError, BadZipFile):
        return False


def _remove_flight(directory: Path) -> None:
    for name in OF_A_FLIGHT:
        path = directory / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _free_name(path: Path) -> Path:
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.name}-{number}")
    return free
