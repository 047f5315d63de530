"""The folder of a flight: its log, its summary and its report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flockd.errors import UsageError
from flockd.flight_log.key_frames import KeyFrame, save_key_frames
from flockd.flight_log.log import FlightLog
from flockd.report.page import write_report
from flockd.report.summary import summarise, write_summary

LOG_NAME = "flight.npz"
KEY_FRAMES_NAME = "filmstrip.npz"
SUMMARY_NAME = "summary.json"
REPORT_NAME = "report.html"
FLEET_LOGS = "logs"
"""Logs and configurations of the processes of a fleet."""


def prepare_folder(directory: Path) -> None:
    """Makes the folder; raises UsageError when it holds something else than an earlier flight."""
    check_folder(directory)
    directory.mkdir(parents=True, exist_ok=True)


def check_folder(directory: Path) -> None:
    """Raises UsageError when a folder holds something else than an earlier flight."""
    if directory.exists() and not directory.is_dir():
        raise UsageError(f"{directory}: is a file; name a folder with --out")
    marks = (directory / LOG_NAME, directory / FLEET_LOGS / "drone1.yaml")  # the second of a fleet that never took off
    if directory.is_dir() and any(directory.iterdir()) and not any(mark.is_file() for mark in marks):
        raise UsageError(f"{directory}: holds other files than a flight's; name a new or empty folder with --out")


def save_flight(directory: Path, log: FlightLog, key_frames: Sequence[KeyFrame]) -> None:
    """Writes the flight's log, and its key frames if there are any, over those of an earlier flight."""
    log.save(directory / LOG_NAME)
    (directory / KEY_FRAMES_NAME).unlink(missing_ok=True)
    if key_frames:
        save_key_frames(directory / KEY_FRAMES_NAME, key_frames)


def write_report_files(directory: Path, log: FlightLog) -> dict[str, Any]:
    """Writes the summary and the report beside the flight's log, and returns the summary."""
    summary = summarise(log)
    write_summary(summary, directory / SUMMARY_NAME)
    write_report(directory)
    return summary
